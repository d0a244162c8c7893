// Camera images in a headset: rectangles in the direction in which the operator looked at the start.

import { headingOf } from "/static/pose.js";

const DISTANCE_M = 1.2, WIDTH_M = 0.7, GAP_M = 0.05;
const VERTEX = `#version 300 es
uniform mat4 projection, view, model;
in vec2 corner;
out vec2 at;
void main() { at = vec2(corner.x + 0.5, 0.5 - corner.y); gl_Position = projection * view * model * vec4(corner, 0.0, 1.0); }`;
const FRAGMENT = `#version 300 es
precision mediump float;
uniform sampler2D image;
in vec2 at;
out vec4 colour;
void main() { colour = vec4(texture(image, at).rgb, 1.0); }`;

export class Screens {
  constructor() {
    this.images = new Map(); // camera -> newest ImageBitmap that is not uploaded yet
    this.textures = new Map();
  }

  begin(gl) {
    this.gl = gl;
    this.placed = null;
    this.textures.clear();
    const program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.bindAttribLocation(program, 0, "corner");
    gl.linkProgram(program);
    this.program = program;
    this.at = Object.fromEntries(["projection", "view", "model"].map((name) => [name, gl.getUniformLocation(program, name)]));
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([-0.5, -0.5, 0.5, -0.5, -0.5, 0.5, 0.5, 0.5]), gl.STATIC_DRAW);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 2, gl.FLOAT, false, 0, 0);
  }

  show(camera, bitmap) {
    this.images.get(camera)?.close();
    this.images.set(camera, bitmap);
  }

  draw(session, viewer, isPhone) {
    const { gl } = this;
    const layer = session.renderState.baseLayer;
    gl.bindFramebuffer(gl.FRAMEBUFFER, layer.framebuffer);
    gl.clearColor(0, 0, 0, session.environmentBlendMode === "opaque" ? 1 : 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    if (isPhone) return; // the page shows them
    this.upload();
    this.placed ??= viewer.transform;
    gl.useProgram(this.program);
    for (const view of viewer.views) {
      const { x, y, width, height } = layer.getViewport(view);
      gl.viewport(x, y, width, height);
      gl.uniformMatrix4fv(this.at.projection, false, view.projectionMatrix);
      gl.uniformMatrix4fv(this.at.view, false, view.transform.inverse.matrix);
      [...this.textures.keys()].sort().forEach((camera, place) => {
        const { texture, ratio } = this.textures.get(camera);
        gl.uniformMatrix4fv(this.at.model, false, this.model(place, this.textures.size, ratio));
        gl.bindTexture(gl.TEXTURE_2D, texture);
        gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
      });
    }
  }

  upload() {
    const { gl } = this;
    for (const [camera, bitmap] of this.images) {
      const known = this.textures.get(camera) ?? { texture: gl.createTexture() };
      gl.bindTexture(gl.TEXTURE_2D, known.texture);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, bitmap);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
      this.textures.set(camera, { texture: known.texture, ratio: bitmap.height / bitmap.width });
      bitmap.close();
    }
    this.images.clear();
  }

  // Scale, rotation and place of a screen, by columns.
  model(place, count, ratio) {
    const { position, orientation } = this.placed;
    const heading = headingOf([orientation.x, orientation.y, orientation.z, orientation.w]);
    const [sin, cos] = [Math.sin(heading), Math.cos(heading)];
    const right = (place - (count - 1) / 2) * (WIDTH_M + GAP_M);
    return new Float32Array([
      WIDTH_M * cos, 0, -WIDTH_M * sin, 0,
      0, WIDTH_M * ratio, 0, 0,
      sin, 0, cos, 0,
      position.x + right * cos - DISTANCE_M * sin, position.y, position.z - right * sin - DISTANCE_M * cos, 1,
    ]);
  }
}
