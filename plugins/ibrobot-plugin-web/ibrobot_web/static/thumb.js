// On phones: a bar at the thumb with one motion to choose and two buttons to hold.

import { h, refresh } from "./dom.js";

const TOOL = { "forward / back": [0, 1], "left / right": [1, 1], "up / down": [2, 1] };

export class Thumb {
  constructor(bar, page) {
    this.bar = bar;
    this.page = page;
  }

  update({ robot }) {
    const { page } = this;
    const device = page.device;
    refresh(this.bar, [device, page.mode?.jogs, robot.tool], () => {
      const group = (label, names) => h("optgroup", { label }, names.map((name) => h("option", {}, name)));
      const choice = h("select", { "aria-label": "Motion" }, robot.tool ? group("Tool", Object.keys(TOOL)) : null,
        group("Joints", page.mode?.jogs[device] ?? []));
      const button = (label, speed) => page.deadman.button(h("button", { "aria-label": `${label}, hold to move` },
        speed < 0 ? "−" : "+"), () => ({ device, ...request(choice.value, speed) }));
      return [button("less", -1), choice, button("more", 1)];
    });
    this.bar.hidden = !device;
  }
}

function request(motion, speed) {
  if (!(motion in TOOL)) return { joints: { [motion]: speed } };
  const linear = [0, 0, 0];
  linear[TOOL[motion][0]] = speed;
  return { linear };
}
