// Camera pictures, each drawn when it arrives. Cameras that are not shown are not sent.

import { h, paint, say } from "./dom.js";

export class Cameras {
  // `changed` is called when there are other cameras.
  constructor(section, page, changed) {
    this.section = section;
    this.page = page;
    this.changed = changed;
    this.views = new Map();
    this.frames = {};
    page.stream.addEventListener("picture", ({ detail }) => this.draw(detail));
  }

  update({ cameras, sensors }) {
    const key = JSON.stringify(cameras);
    if (this.key !== key) {
      this.key = key;
      for (const { element } of this.views.values()) element.remove();
      this.views.clear();
      this.section.append(...cameras.map((camera) => this.add(camera)));
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

  draw({ channel, bitmap, stamp }) {
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

// "/camera/top/image_raw" is the camera top.
export function nameOf(topic) {
  const parts = topic.split("/").filter(Boolean);
  return parts[1] ?? parts[0];
}
