// Draws triangles and lines with WebGL 2: flat faces in one light, opaque first, then transparent ones.


const VERTEX = `#version 300 es
in vec3 position;
uniform mat4 view, projection, model;
out vec3 seen;
void main() {
  vec4 at = view * model * vec4(position, 1.0);
  seen = at.xyz;
  gl_Position = projection * at;
}`;
// The face's normal follows from the neighbouring pixels, so that meshes need none.
const FRAGMENT = `#version 300 es
precision highp float;
in vec3 seen;
uniform vec4 color;
uniform bool lit;
out vec4 result;
void main() {
  float light = 1.0;
  if (lit) {
    vec3 normal = normalize(cross(dFdx(seen), dFdy(seen)));
    light = 0.42 + 0.38 * max(0.0, dot(normal, normalize(vec3(0.4, 0.7, 0.6)))) + 0.25 * normal.z;
  }
  result = vec4(color.rgb * light, color.a);
}`;

// Whether WebGL draws without a graphics card: smooth edges then take most of the time.
function isSoftware() {
  const gl = new OffscreenCanvas(1, 1).getContext("webgl2");
  const known = gl?.getExtension("WEBGL_debug_renderer_info");
  return /swiftshader|llvmpipe|software/i.test(known ? gl.getParameter(known.UNMASKED_RENDERER_WEBGL) : "");
}

export class Canvas3D {
  constructor(canvas) {
    this.slow = isSoftware();
    const gl = canvas.getContext("webgl2", { antialias: !this.slow, powerPreference: "high-performance" });
    if (!gl) throw new Error("this browser offers no WebGL 2 here");
    this.gl = gl;
    this.canvas = canvas;
    const program = this.program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.bindAttribLocation(program, 0, "position");
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    this.at = Object.fromEntries(["view", "projection", "model", "color", "lit"].map(
      (name) => [name, gl.getUniformLocation(program, name)]));
    gl.enable(gl.DEPTH_TEST);
    // Where nothing is drawn, the page's own background shows: a change of theme need not wait for a drawing.
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.clearColor(0, 0, 0, 0);
  }

  // Triangles, {vertices, faces}, as something to draw.
  mesh({ vertices, faces }) {
    const { gl } = this;
    const shape = this.vertices(vertices);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, Uint32Array.from(faces), gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    return { ...shape, count: faces.length, kind: gl.TRIANGLES, indexed: true };
  }

  // A line through points, or separate lines between pairs of points.
  line(vertices, pairs = false) {
    const shape = this.vertices(vertices);
    this.gl.bindVertexArray(null);
    return { ...shape, count: vertices.length / 3, kind: pairs ? this.gl.LINES : this.gl.LINE_STRIP, indexed: false };
  }

  vertices(values) {
    const { gl } = this;
    const array = gl.createVertexArray(), buffer = gl.createBuffer();
    gl.bindVertexArray(array);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, Float32Array.from(values), gl.DYNAMIC_DRAW);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
    return { array, buffer };
  }

  change(line, vertices) {
    const { gl } = this;
    gl.bindBuffer(gl.ARRAY_BUFFER, line.buffer);
    gl.bufferData(gl.ARRAY_BUFFER, Float32Array.from(vertices), gl.DYNAMIC_DRAW);
    line.count = vertices.length / 3;
  }

  // Items: {shape, matrix, color (rgba), lit, above (drawn over everything)}.
  draw(items, view, projection) {
    const { gl, at } = this;
    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.useProgram(this.program);
    gl.uniformMatrix4fv(at.view, false, view);
    gl.uniformMatrix4fv(at.projection, false, projection);
    const order = ({ color, above }) => (above ? 2 : color[3] < 1 ? 1 : 0);
    for (const item of [...items].sort((a, b) => order(a) - order(b))) {
      const see = order(item);
      gl[see ? "enable" : "disable"](gl.BLEND);
      gl[item.above ? "disable" : "enable"](gl.DEPTH_TEST);
      gl.depthMask(!see);
      gl.uniformMatrix4fv(at.model, false, item.matrix);
      gl.uniform4fv(at.color, item.color);
      gl.uniform1i(at.lit, item.lit ? 1 : 0);
      gl.bindVertexArray(item.shape.array);
      if (item.shape.indexed) gl.drawElements(item.shape.kind, item.shape.count, gl.UNSIGNED_INT, 0);
      else gl.drawArrays(item.shape.kind, 0, item.shape.count);
    }
    gl.depthMask(true);
  }
}

// A surface of revolution about z: rings of (radius, height) from bottom to top.
function revolved(rings, sides) {
  const vertices = [], faces = [];
  rings.forEach(([radius, height], ring) => {
    for (let side = 0; side < sides; side += 1) {
      const angle = 2 * Math.PI * side / sides;
      vertices.push(radius * Math.cos(angle), radius * Math.sin(angle), height);
      if (!ring) continue;
      const next = (side + 1) % sides, low = (ring - 1) * sides, high = ring * sides;
      faces.push(low + side, low + next, high + next, low + side, high + next, high + side);
    }
  });
  return { vertices, faces };
}

function arc(radius, from, to, shift) {
  return Array.from({ length: 9 }, (_, i) => {
    const angle = from + (to - from) * i / 8;
    return [radius * Math.cos(angle), shift + radius * Math.sin(angle)];
  });
}

// The primitives of MuJoCo, with its sizes.
export function primitive(type, [a, b, c]) {
  const quarter = Math.PI / 2;
  if (type === "cylinder") return revolved([[0, -b], [a, -b], [a, b], [0, b]], 28);
  if (type === "capsule") return revolved([...arc(a, -quarter, 0, -b), ...arc(a, 0, quarter, b)], 20);
  if (type === "box") {
    const vertices = [];
    for (const z of [-c, c]) for (const [x, y] of [[-a, -b], [a, -b], [a, b], [-a, b]]) vertices.push(x, y, z);
    return { vertices, faces: [0, 2, 1, 0, 3, 2, 4, 5, 6, 4, 6, 7, 0, 1, 5, 0, 5, 4, 1, 2, 6, 1, 6, 5, 2, 3, 7, 2, 7, 6, 3, 0, 4, 3, 4, 7] };
  }
  const ball = revolved([...arc(1, -quarter, 0, 0), ...arc(1, 0, quarter, 0).slice(1)], 24);
  const scale = type === "sphere" ? [a, a, a] : [a, b, c];
  return { ...ball, vertices: ball.vertices.map((value, i) => value * scale[i % 3]) };
}

