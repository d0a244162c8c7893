// Camera pictures, each drawn when it arrives. Cameras that are not shown are not sent. What a policy attends to in a
// camera's picture, on /attention/CAMERA, is laid over it in red, if somebody asks for it.

import { h, paint, say } from "./dom.js";

export class Cameras {
  // `changed` is called when there are other cameras.
  constructor(section, page, changed) {
    this.section = section;
    this.page = page;
    this.changed = changed;
    this.views = new Map();
    this.attention = new Map(); // channel -> the view of a camera, and the canvas over it
    this.frames = {};
    this.shown = new Set(); // cameras over which attention is shown
    page.stream.addEventListener("picture", ({ detail }) => this.draw(detail));
  }

  update({ cameras, sensors }) {
    const key = JSON.stringify(cameras);
    if (this.key !== key) {
      this.key = key;
      for (const { element } of this.views.values()) element.remove();
      this.views.clear();
      this.attention.clear();
      const own = new Set(cameras.filter(({ topic }) => !isAttention(topic)).map(({ topic }) => nameOf(topic)));
      const over = cameras.filter(({ topic }) => isAttention(topic) && own.has(nameOf(topic)));
      this.section.append(...cameras.filter((camera) => !over.includes(camera)).map((camera) => this.add(camera)));
      for (const camera of over) this.lay(camera);
      this.changed();
    }
    for (const camera of cameras) {
      const sensor = sensors[nameOf(camera.topic)];
      const view = this.views.get(camera.channel);
      if (view && sensor) view.rate = `${sensor.rate_hz.toFixed(0)} Hz`;
    }
  }

  add({ channel, topic }) {
    const name = nameOf(topic);
    const canvas = h("canvas", { width: "4", height: "3", role: "img", "aria-label": `Camera ${name}` });
    const caption = h("span", {}, `${name}: waiting for its first picture …`), age = h("span", { class: "rate" });
    const element = h("figure", { class: "picture", "data-name": name }, canvas, h("figcaption", {}, caption, age));
    this.views.set(channel, { canvas, caption, age, element, name, rate: "" });
    this.page.stream.show(channel, true);
    return element;
  }

  // Adds a switch to a camera's picture for what the policy attends to there.
  lay({ channel, topic }) {
    const view = [...this.views.values()].find(({ name }) => name === nameOf(topic));
    const canvas = h("canvas", { class: "looks", width: "1", height: "1", role: "img", hidden: true, "aria-label": `What the policy attends to in the picture of ${view.name}` });
    const show = (shown) => { canvas.hidden = !shown; this.page.stream.show(channel, shown); };
    const box = h("input", { type: "checkbox", onchange: () => { this.shown[box.checked ? "add" : "delete"](view.name); show(box.checked); } });
    box.checked = this.shown.has(view.name);
    show(box.checked);
    view.element.append(canvas, h("label", { class: "looks" }, box, "attention"));
    this.attention.set(channel, { view, canvas });
  }

  draw({ channel, bitmap, stamp }) {
    const looks = this.attention.get(channel);
    if (looks) { if (bitmap) redden(looks.canvas, bitmap, looks.view.canvas); return; }
    const view = this.views.get(channel);
    if (!view) return;
    if (!bitmap) { say(view.caption, `${view.name}: damaged picture`); return; }
    paint(view.canvas, bitmap);
    const age = Date.now() - stamp;
    const counted = this.frames[view.name] ??= { count: 0, ages: [] };
    counted.count += 1;
    counted.ages.push(age);
    if (counted.ages.length > 500) counted.ages.shift();
    say(view.caption, view.name);
    say(view.age, ` · ${view.rate}${age < 60000 ? ` · ${Math.max(0, age).toFixed(0)} ms` : ""}`);
  }
}

function isAttention(topic) { return topic.startsWith("/attention/"); }

// Draws a small grey picture in red, the more opaque the brighter, in the size of another canvas.
function redden(canvas, bitmap, { width, height }) {
  Object.assign(canvas, { width, height });
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.drawImage(bitmap, 0, 0, width, height);
  bitmap.close();
  const picture = context.getImageData(0, 0, width, height);
  for (let i = 0; i < picture.data.length; i += 4) picture.data.set([255, 0, 0, 0.6 * picture.data[i]], i);
  context.putImageData(picture, 0, 0);
}

// "/camera/top/image_raw" is the camera top.
export function nameOf(topic) {
  const parts = topic.split("/").filter(Boolean);
  return parts[1] ?? parts[0];
}
