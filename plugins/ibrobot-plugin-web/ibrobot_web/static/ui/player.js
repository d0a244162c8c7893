// Plays an episode: 3D, camera pictures and plots on one time line. Pictures are asked for by time, the newest only.

import { h, paint, problem, refresh, say } from "../dom.js";
import { COLORS, drawPlot, kindOf, legendOf, timeAt } from "../plot.js";
import { View3D } from "../view3d.js";

const STEP_S = 0.05;
const SPEEDS = [0.25, 0.5, 1, 2, 4];

export class Player {
  constructor(ui) {
    this.ui = ui;
    this.at = 0;
    this.playing = false;
    this.cameras = [];
    this.series = null;
    this.cut = null;
    this.build();
  }

  get length() { return this.facts?.duration_s ?? 0; }

  build() {
    this.scene = h("section", { class: "player-3d", "aria-label": "3D view of the robot" });
    this.pictures = h("section", { class: "player-cameras", "aria-label": "Cameras", tabindex: "0" });
    this.play = h("button", { class: "primary", disabled: true, onclick: () => this.toggle() }, "Play");
    this.line = h("input", { type: "range", min: "0", max: "1", step: String(STEP_S), value: "0", "aria-label": "Time", disabled: true });
    this.line.addEventListener("input", () => { this.pause(); this.seek(Number(this.line.value)); });
    this.clock = h("output", { class: "clock" });
    this.speed = h("select", { "aria-label": "Speed" },
      SPEEDS.map((speed) => h("option", { value: speed, selected: speed === 1 }, `${speed}×`)));
    this.topic = h("select", { id: `plot-${Math.random()}` });
    this.topic.addEventListener("change", () => this.plot());
    this.group = h("select", { "aria-label": "Values", hidden: true });
    this.group.addEventListener("change", () => this.draw());
    this.canvas = h("canvas", { class: "plot", role: "img", "aria-label": "Plot of the chosen topic; a click moves the time" });
    this.canvas.addEventListener("pointerdown", (event) => {
      if (!this.length) return;
      this.pause();
      this.seek(timeAt(this.canvas, event, 0, this.length));
    });
    this.legend = h("p", { class: "legend" });
    this.element = h("div", { class: "player" }, this.pictures, this.scene,
      h("div", { class: "row player-line" }, this.play, this.line, this.clock, this.speed),
      h("div", { class: "player-plot" }, h("div", { class: "row" },
        h("label", { for: this.topic.id }, "Plot"), this.topic, this.group), this.canvas, this.legend));
    new ResizeObserver(() => this.draw()).observe(this.canvas);
  }

  // Opens an episode; returns what it contains, or null after showing in `problems` why it cannot be opened. The 3D view
  // is made once, when the element is on the page.
  async open(path, problems) {
    this.pause();
    this.element.hidden = false;
    this.posed = undefined;
    this.path = path;
    this.facts = null;
    this.series = null;
    this.enable();
    say(this.clock, "");
    let facts;
    try {
      facts = await this.ui.get("episodes/open", { path });
    } catch (error) {
      if (this.path !== path) return null;
      this.close();
      this.element.hidden = true;
      problems.replaceChildren(problem(error.message));
      return null;
    }
    if (this.path !== path) return null; // another was opened meanwhile
    this.facts = facts;
    this.view ??= new View3D(this.scene, { scene: null });
    const robot = JSON.stringify(facts.metadata.robot ?? "") + JSON.stringify(facts.motion.joints);
    this.view.tell({ do: "clear" });
    this.view.tell({ do: "joints", names: facts.motion.joints });
    if (this.robot !== robot) this.view.load(this.ui.address("episodes/scene", { path })).then(() => this.pose(true));
    this.robot = robot;
    this.line.max = String(this.length);
    this.enable();
    this.cameras = facts.cameras.map((topic) => this.camera(topic));
    this.pictures.replaceChildren(...(this.cameras.length ? this.cameras.map(({ element }) => element)
      : [h("p", { class: "note" }, "No cameras.")]));
    const plotted = facts.topics.filter(({ name, count }) => count && !facts.cameras.includes(name)).map(({ name }) => name);
    const chosen = plotted.includes(this.topic.value) ? this.topic.value
      : plotted.includes("/joint_states") ? "/joint_states" : plotted[0];
    this.topic.replaceChildren(...plotted.map((name) => h("option", { selected: name === chosen }, name)));
    this.objects = [];
    this.view.tell({ do: "objects", objects: [] });
    this.seek(Math.min(this.length, facts.first_picture_s ?? 0)); // at first all cameras have a picture
    this.plot();
    this.loadObjects(path);
    return facts;
  }

  // The objects of a simulated scene, which take the server a moment.
  async loadObjects(path) {
    const found = await this.ui.attempt(() => this.ui.get("episodes/objects", { path }));
    if (this.path !== path || !found?.length) return;
    this.objects = found;
    this.place();
  }

  place() {
    if (!this.objects?.length) return;
    this.view.tell({ do: "objects", objects: this.objects.map(({ type, size, pos, quat, times, poses }) => {
      const pose = times.length ? poses[last(times, this.at)] : [...pos, ...quat];
      return { type, size, pos: pose.slice(0, 3), quat: pose.slice(3) };
    }) });
  }

  close() {
    this.pause();
    this.path = null;
    this.facts = null;
    this.enable();
  }

  // An episode that is not open yet, or that has no length, cannot be played.
  enable() { for (const control of [this.play, this.line]) control.disabled = !this.length; }

  camera(topic) {
    const name = topic.split("/").filter(Boolean).slice(-2)[0];
    const canvas = h("canvas", { width: "4", height: "3", role: "img", "aria-label": `Camera ${name}` });
    const caption = h("figcaption", {}, name);
    return { topic, name, canvas, caption, element: h("figure", {}, canvas, caption), busy: false, shown: null };
  }

  toggle() {
    if (this.playing) { this.pause(); return; }
    if (!this.length) return;
    if (this.at >= this.length - STEP_S) this.seek(0);
    this.playing = true;
    say(this.play, "Pause");
    let before = null; // a frame's time may lie before the click
    const step = (now) => {
      if (!this.playing) return;
      const next = this.at + (before === null ? 0 : (now - before) / 1000 * Number(this.speed.value));
      before = now;
      this.seek(Math.min(next, this.length));
      if (next >= this.length) this.pause();
      else requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
  }

  // Pauses, and goes on or back by a step.
  step(by) {
    this.pause();
    this.seek(Math.min(this.length, Math.max(0, this.at + by * STEP_S)));
  }

  pause() {
    this.playing = false;
    say(this.play, "Play");
  }

  seek(at) {
    if (!this.facts) return;
    this.at = at;
    this.line.value = String(at);
    const text = `${at.toFixed(2)} of ${this.length.toFixed(2)} s`;
    say(this.clock, text);
    this.line.setAttribute("aria-valuetext", text);
    this.pose();
    for (const camera of this.cameras) this.ask(camera);
    this.draw();
  }

  pose(again = false) {
    if (!this.facts) return;
    const { joints, times, positions, commands } = this.facts.motion;
    if (!joints.length || !times.length) return;
    const i = last(times, this.at);
    if (i === this.posed && !again) return;
    if (this.posed === undefined || i < this.posed || i > this.posed + 60) this.view.tell({ do: "clear" });
    this.posed = i;
    this.place();
    this.view.tell({ do: "state", state: { stamp: Math.round(times[i] * 1e9) + 1, position: positions[i], command: commands[i] } });
  }

  // Asks for a camera's picture at the present time; while one is on its way, only the newest wish is kept.
  async ask(camera) {
    if (camera.busy || camera.shown === this.at) return;
    camera.busy = true;
    const { path, at } = this;
    try {
      const response = await fetch(this.ui.address("episodes/picture", { path, topic: camera.topic, at_s: at }));
      const content = await response.blob();
      if (!response.ok) throw new Error(JSON.parse(await content.text()).error);
      camera.shown = at;
      say(camera.caption, content.size ? camera.name : `${camera.name}: no picture at this time`);
      if (content.size && this.path === path) {
        paint(camera.canvas, await createImageBitmap(content));
      }
    } catch (error) {
      say(camera.caption, `${camera.name}: ${error.message}`);
      camera.shown = at;
    } finally {
      camera.busy = false;
    }
    if (this.path === path && camera.shown !== this.at && this.cameras.includes(camera)) this.ask(camera);
  }

  async plot() {
    const topic = this.topic.value, { path } = this;
    if (!topic || !path) { this.series = null; this.draw(); return; }
    const found = await this.ui.attempt(() => this.ui.get("episodes/series", { path, topic }));
    if (this.path !== path || this.topic.value !== topic) return;
    this.series = found ?? null;
    const groups = [...new Set(Object.keys(found?.values ?? {}).map(kindOf))];
    const chosen = groups.includes(this.group.value) ? this.group.value : groups[0];
    this.group.replaceChildren(...groups.map((name) => h("option", { selected: name === chosen }, name)));
    this.group.hidden = groups.length < 2;
    this.draw();
  }

  // The span that a trim would keep; null for none.
  setCut(cut) {
    this.cut = cut;
    this.draw();
  }

  draw() {
    const lines = Object.entries(this.series?.values ?? {}).filter(([name]) => kindOf(name) === this.group.value).slice(0, COLORS.length);
    const shade = this.cut ? [[0, this.cut[0]], [this.cut[1], this.length]] : [];
    drawPlot(this.canvas, {
      times: this.series?.times ?? [], lines, begin: 0, end: this.length || 1, labels: ["0 s", `${this.length.toFixed(1)} s`],
      cursor: this.facts ? this.at : null, shade,
    });
    refresh(this.legend, [this.topic.value, lines.map(([name]) => name)], () => legendOf(lines));
  }
}

// The index of the last of ascending times at or before one.
function last(times, at) {
  let low = 0, high = times.length - 1;
  while (low < high) {
    const middle = Math.ceil((low + high) / 2);
    if (times[middle] <= at) low = middle;
    else high = middle - 1;
  }
  return low;
}
