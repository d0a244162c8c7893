// Draws the robot. Poses of bodies follow from the positions of joints here, so that states stay small.

import { Canvas3D, primitive } from "./canvas3d.js";
import {
  add, dot, framed, identity, length, looking, multiply, perspective, placed, shifted, subtract, transform, turned,
} from "./matrix.js";

const PATH_POINTS = 300;
const HANDLE_PX = 26, HANDLE_M = 0.012;
const REACH_M = 0.05; // distance at which dragging the tool reaches full speed
const GHOST_RAD = 0.03; // a command this close to the measured position has no ghost
const FIELD_DEG = 40;
const WIDE = 1.3; // width by height of a picture below which it counts as narrow
const FRUSTUM_M = 0.05;
const NEAR = [0.93, 0.33, 0.2, 1]; // what the guard keeps apart
const OBJECT = [0.55, 0.6, 0.66, 0.75];
const GRID = [0.47, 0.54, 0.6, 0.5]; // on a light and on a dark page
const FRAME_MS = 40; // 25 frames a second leave a small machine time for the rest
const SLOW_FRAME_MS = 100; // without a graphics card, each costs processor time that control may need
const COMMANDED = [0.18, 0.5, 0.83, 0.3], PLANNED = [0.12, 0.62, 0.33, 0.3];

let screen, bodies = [], joints = [], tips = {}, tip = null, extras = [];
let measured = null, commanded = null, planned = null;
let trail = [], path, future, grid, ball;
let dirty = true, stamp = 0, drawn = 0, size = [1, 1], jogs = false, view = null;
let cameras = [];
let fresh = false; // a new model before its first state: the extent in its file is for joints at 0
let near = []; // names of bodies and objects that the guard keeps apart
const shapes = new Map(); // of objects, by type and size
let goals = false, goal = null, kept = false, begun = 0;
const orbit = { azimuth: -0.9, elevation: 0.45, distance: 1, target: [0.1, 0, 0.15] };
const grip = { mode: null, at: [0, 0], through: [0, 0, 0], target: [0, 0, 0] };

function start({ canvas }) {
  try {
    screen = new Canvas3D(canvas);
  } catch (error) {
    postMessage({ problem: `No 3D: ${error.message}.` });
    return;
  }
  path = screen.line([]);
  future = screen.line([]);
  ball = screen.mesh(primitive("sphere", [HANDLE_M]));
  const lines = [];
  for (let i = -10; i <= 10; i += 1) lines.push(i / 10, -1, 0, i / 10, 1, 0, -1, i / 10, 0, 1, i / 10, 0);
  grid = screen.line(lines, true);
  requestAnimationFrame(draw);
}

function unpacked(text, Kind) {
  return new Kind(Uint8Array.from(atob(text), (character) => character.charCodeAt(0)).buffer);
}

function load({ scene }) {
  postMessage({ problem: scene.problem ? `No 3D: ${scene.problem}` : "" });
  if (!screen || !scene.bodies.length) return;
  const meshes = scene.meshes.map(({ vertices, faces }) => screen.mesh({
    vertices: unpacked(vertices, Float32Array), faces: unpacked(faces, Uint32Array),
  }));
  bodies = scene.bodies.map((body) => ({
    ...body, rest: placed(body.pos, body.quat),
    // The ground of a file is the page's grid.
    shapes: body.geoms.filter(({ type }) => type !== "plane").map((geom) => ({
      shape: geom.type === "mesh" ? meshes[geom.mesh] : screen.mesh(primitive(geom.type, geom.size)),
      local: placed(geom.pos, geom.quat), color: geom.rgba,
    })),
  }));
  postMessage({ slides: bodies.flatMap(({ joints: own }) => own.filter(({ type }) => type === "slide").map(({ name }) => name)) });
  tips = scene.tips;
  tip = Object.values(tips)[0] ?? null;
  cameras = (scene.cameras ?? []).map(({ body, pos, quat, fovy }) => (
    { body, local: placed(pos, quat), shape: screen.line(frustum(fovy), true) }));
  orbit.distance = Math.max(0.45, 1.5 * scene.extent);
  orbit.target = scene.centre;
  fresh = true;
  dirty = true;
}

// Half the height of what is seen at a distance of 1: more in a narrow picture, so that its width shows as much.
function half() { return Math.tan(FIELD_DEG * Math.PI / 360) * Math.max(1, WIDE * size[1] / size[0]); }

// The view of a camera, which looks along its -z: lines from it to the corners of its picture, and the picture's edge.
function frustum(fovy) {
  const high = FRUSTUM_M * Math.tan(fovy * Math.PI / 360), wide = high * 4 / 3;
  const corners = [[-wide, -high], [wide, -high], [wide, high], [-wide, high]].map(([x, y]) => [x, y, -FRUSTUM_M]);
  return corners.flatMap((corner, i) => [0, 0, 0, ...corner, ...corner, ...corners[(i + 1) % 4]]);
}

// Where all bodies are, for positions of the joints.
function posed(positions) {
  const values = new Map(joints.map((name, i) => [name, positions[i]]));
  const frames = [];
  for (const body of bodies) {
    let frame = body.parent < 0 ? body.rest : multiply(frames[body.parent], body.rest);
    for (const joint of body.joints) {
      const moved = (values.get(joint.name) ?? joint.ref) - joint.ref;
      frame = multiply(frame, joint.type === "hinge" ? turned(joint.axis, moved, joint.pos)
        : shifted(joint.axis.map((value) => value * moved)));
    }
    frames.push(frame);
  }
  return frames;
}

const tipOf = (frames) => (tip ? transform(frames[tip.body], tip.pos) : null);

function items(frames, color = null) {
  return bodies.flatMap((body, i) => body.shapes.map(({ shape, local, color: own }) => (
    { shape, matrix: multiply(frames[i], local), color: color ?? (near.includes(body.name) ? NEAR : own), lit: true })));
}

function state({ state: message }) {
  if (!bodies.length || !joints.length) return;
  measured = posed(message.position);
  if (fresh) Object.assign(orbit, framed(measured.map((frame) => transform(frame, [0, 0, 0])), orbit.target, orbit.distance, half()));
  fresh = false;
  stamp = message.stamp / 1e6;
  const away = message.command.some((value, i) => Math.abs(value - message.position[i]) > GHOST_RAD);
  commanded = away ? posed(message.command) : null;
  const at = tipOf(measured);
  if (at && (!trail.length || length(subtract(at, trail.at(-1))) > 0.002)) {
    trail = [...trail.slice(1 - PATH_POINTS), at];
    screen.change(path, trail.flat());
  }
  if (grip.mode === "tool") steer();
  dirty = true;
}

function plan({ plan: message, positions, kept: keeps = false }) {
  if (!bodies.length || (kept && !keeps && !message.rows.length)) return;
  kept = keeps;
  const poses = message.rows.map((row) => {
    const values = positions.slice();
    message.joints.forEach((joint, i) => { values[joint] = row[i]; });
    return posed(values);
  });
  planned = poses.at(-1) ?? null;
  screen.change(future, tip ? poses.map(tipOf).flat() : []);
  dirty = true;
}

function objects({ objects: found }) {
  extras = found.map(({ name, type, size: sizes, pos, quat, color }) => {
    const kind = `${type} ${sizes}`;
    if (!shapes.has(kind)) shapes.set(kind, screen.mesh(primitive(type, sizes)));
    return { name, shape: shapes.get(kind), matrix: placed(pos, quat), color: color?.length ? color : OBJECT, lit: true };
  });
  dirty = true;
}

function look() {
  const { azimuth, elevation, distance, target } = orbit;
  const flat = distance * Math.cos(elevation);
  const from = add(target, [flat * Math.cos(azimuth), flat * Math.sin(azimuth), distance * Math.sin(elevation)]);
  view = { from, ...looking(from, target), projection: perspective(360 / Math.PI * Math.atan(half()), size[0] / size[1], 0.02 * distance, 50 * distance) };
}

function draw(now = 0) {
  requestAnimationFrame(draw);
  if (!dirty || size[0] < 2 || now - begun < (screen.slow ? SLOW_FRAME_MS : FRAME_MS) - 5) return;
  begun = now;
  dirty = false;
  look();
  // A transparent object stays transparent, since it may hide the arm.
  const things = extras.map((each) => (near.includes(each.name) ? { ...each, color: [...NEAR.slice(0, 3), each.color[3] ?? 1] } : each));
  const shown = [{ shape: grid, matrix: identity(), color: GRID }, ...things];
  if (measured) shown.push(...items(measured), { shape: path, matrix: identity(), color: [0.08, 0.47, 0.78, 1] });
  if (measured) {
    shown.push(...cameras.map(({ body, local, shape }) => (
      { shape, matrix: multiply(measured[body], local), color: [0.75, 0.35, 0.7, 1] })));
  }
  if (commanded) shown.push(...items(commanded, COMMANDED));
  if (planned) shown.push(...items(planned, PLANNED), { shape: future, matrix: identity(), color: [0.12, 0.62, 0.33, 1] });
  if ((jogs || goals) && measured && tip) {
    shown.push({ shape: ball, matrix: shifted((goals && goal) || tipOf(measured)), color: [0.9, 0.45, 0.1, 0.85], lit: true, above: true });
  }
  screen.draw(shown, view.matrix, view.projection);
  const here = measured && tip ? seen((goals && goal) || tipOf(measured)) : null;
  if (stamp !== drawn) postMessage({ drawn: stamp, handle: here });
  drawn = stamp;
}

function turn(by) {
  orbit.azimuth -= by[0];
  orbit.elevation = Math.min(1.5, Math.max(-1.5, orbit.elevation + by[1]));
  dirty = true;
}

function pan(dx, dy) {
  const scale = 2 * orbit.distance * half() / size[1];
  orbit.target = add(add(orbit.target, view.right, -dx * scale), view.up, dy * scale);
  dirty = true;
}

function zoom(factor) {
  orbit.distance = Math.min(50, Math.max(0.05, orbit.distance * factor));
  dirty = true;
}

// A point in pixels, or null behind the camera.
function seen(point) {
  const [x, y, z] = transform(view.matrix, point);
  if (z > -1e-6) return null;
  const f = size[1] / (2 * half());
  return [size[0] / 2 - f * x / z, size[1] / 2 + f * y / z];
}

// The point under a pixel, on the plane through a point that faces the camera.
function under(at, point) {
  const f = 2 * half() / size[1];
  const ray = add(add(view.ahead, view.right, (at[0] - size[0] / 2) * f), view.up, (size[1] / 2 - at[1]) * f);
  const depth = dot(subtract(point, view.from), view.ahead);
  return add(view.from, ray, depth);
}

function down({ at, pan: pans, fingers, press }) {
  grip.at = at;
  if (fingers > 1 || pans) {
    release();
    grip.mode = "pan";
    return;
  }
  grip.mode = "turn";
  const here = measured && tip && (jogs || goals) ? (goals && goal) || tipOf(measured) : null;
  const shown = here && view ? seen(here) : null;
  if (!shown || Math.hypot(shown[0] - at[0], shown[1] - at[1]) > HANDLE_PX) return;
  grip.mode = goals ? "goal" : "tool";
  grip.through = grip.target = here;
  if (!goals) steer(press);
}

function move({ at }) {
  const dx = at[0] - grip.at[0], dy = at[1] - grip.at[1];
  grip.at = at;
  if (grip.mode === "turn") turn([dx * 0.006, dy * 0.006]);
  else if (grip.mode === "pan") pan(dx, dy);
  else if (grip.mode === "tool" || grip.mode === "goal") {
    grip.target = under(at, grip.through);
    if (grip.mode === "tool") steer();
    else goal = grip.target;
    dirty = true;
  }
}

// The tool moves towards the point under the pointer, slower when it is close. `press` is the time of a press that begins.
function steer(press = null) {
  const way = subtract(grip.target, tipOf(measured));
  const far = length(way);
  const linear = far > 1e-4 ? way.map((value) => value / far * Math.min(1, far / REACH_M)) : [0, 0, 0];
  postMessage({ tool: { press, held: true, linear } });
}

function release() {
  if (grip.mode === "tool") postMessage({ tool: { held: false, linear: [0, 0, 0] } });
  if (grip.mode === "goal" && goal) postMessage({ goal });
  grip.mode = null;
}

function pinch({ before, now }) {
  const span = ([a, b]) => Math.max(1, Math.hypot(a[0] - b[0], a[1] - b[1]));
  zoom(span(before) / span(now));
  pan((now[0][0] + now[1][0] - before[0][0] - before[1][0]) / 2, (now[0][1] + now[1][1] - before[0][1] - before[1][1]) / 2);
}

function resize({ width, height, ratio }) {
  size = [Math.max(1, width), Math.max(1, height)];
  if (!screen) return;
  screen.canvas.width = Math.round(size[0] * ratio);
  screen.canvas.height = Math.round(size[1] * ratio);
  dirty = true;
  begun = 0; // a resized canvas is empty until it is drawn
}

const actions = {
  start, scene: load, state, plan, objects, size: resize, down, move, pinch, up: release,
  turn: ({ by }) => turn(by), zoom: ({ factor }) => zoom(factor),
  near: ({ names }) => { near = names; dirty = true; },
  joints: ({ names }) => { joints = names; },
  clear: () => {
    measured = commanded = planned = null;
    trail = [];
    screen.change(path, []);
    dirty = true;
  },
  // `moved`: the joints that the tool's handle moves, by which a robot with several arms has several tools.
  handle: ({ jog, goal: moves, moved }) => {
    const arm = Object.keys(tips).find((prefix) => moved.every((name) => name.startsWith(prefix)));
    const other = tips[arm] ?? tip;
    if (other !== tip) { release(); trail = []; }
    tip = other;
    if (jogs && !jog) release();
    if (goals !== moves) goal = null;
    if (goals && !moves) kept = false;
    jogs = jog;
    goals = moves;
    dirty = true;
  },
};

onmessage = ({ data }) => {
  try {
    if (screen || data.do === "start") actions[data.do](data);
  } catch (error) {
    postMessage({ problem: `3D failed: ${error.message}` });
  }
};
