// One row for each joint: position between the limits, command, and jog by slider or buttons. Angles are in one unit.

import { h, refresh, say } from "./dom.js";
import { words } from "./words.js";

const KEY = "angles";
const DEGREES = 180 / Math.PI;

export class Joints {
  constructor(section, page) {
    this.section = section;
    this.page = page;
    this.rows = [];
    this.degrees = localStorage.getItem(KEY) !== "rad";
    this.unit = h("button", { class: "small", onclick: () => this.setUnit(!this.degrees) });
    this.list = h("div", {});
    section.append(h("div", { class: "title" }, h("h2", {}, "Joints"), this.unit), this.list);
    this.setUnit(this.degrees);
  }

  setUnit(degrees) {
    this.degrees = degrees;
    localStorage.setItem(KEY, degrees ? "deg" : "rad");
    say(this.unit, degrees ? "in degrees" : "in radians");
    this.unit.title = words(degrees ? "Show radians" : "Show degrees");
    if (this.page.state) this.state(this.page.state);
  }

  update({ robot }) {
    refresh(this.list, robot.joints, () => {
      this.rows = robot.joints.map((joint) => this.row(joint));
      return this.rows.map((row) => row.element);
    });
    const { jogs, mode } = this.page;
    for (const row of this.rows) {
      row.device = jogs.find((device) => mode.jogs[device].includes(row.joint.name));
      for (const control of [row.slider, row.less, row.more]) control.disabled = !row.device;
    }
  }

  row(joint) {
    const { deadman } = this.page;
    const step = (joint.upper - joint.lower) / 1000;
    const row = { joint };
    row.slider = h("input", {
      type: "range", min: joint.lower, max: joint.upper, step, "aria-label": `${joint.name}, target`,
    });
    const request = () => ({ device: row.device, targets: { [joint.name]: Number(row.slider.value) } });
    row.slider.addEventListener("pointerdown", () => deadman.hold(request));
    const arrows = ["ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown", "PageUp", "PageDown", "Home", "End"];
    row.slider.addEventListener("keydown", (event) => { if (arrows.includes(event.key) && !event.repeat) deadman.hold(request); });
    for (const name of ["keyup", "blur"]) row.slider.addEventListener(name, () => deadman.release());
    const button = (sign, speed) => deadman.button(
      h("button", { "aria-label": `${joint.name} ${sign === "−" ? "down" : "up"}, hold to move` }, sign),
      () => ({ device: row.device, joints: { [joint.name]: speed } }));
    row.less = button("−", -1);
    row.more = button("+", 1);
    row.value = h("output", {});
    row.bar = h("div", { class: "value" });
    row.command = h("div", { class: "command" });
    row.element = h("div", { class: "joint" }, h("span", { class: "name" }, joint.name), row.value,
      h("div", { class: "bar", "aria-hidden": "true" }, row.bar, row.command),
      h("div", { class: "jog" }, row.less, h("div", { class: "track" }, row.slider), row.more));
    return row;
  }

  state({ position, command }) {
    this.rows.forEach((row, i) => {
      const { lower, upper, name } = row.joint;
      const share = (value) => `${100 * Math.min(1, Math.max(0, (value - lower) / (upper - lower)))}%`;
      say(row.value, this.page.view.slides.includes(name) ? `${signed(position[i] * 1000, 0)} mm`
        : this.degrees ? `${signed(position[i] * DEGREES, 0)}°` : `${signed(position[i], 2)} rad`);
      row.bar.style.width = share(position[i]);
      row.command.style.left = share(command[i]);
      const beyond = (upper - lower) / 200; // a joint that rests at its limit is not outside
      row.element.classList.toggle("outside", position[i] < lower - beyond || position[i] > upper + beyond);
      if (document.activeElement !== row.slider || !this.page.deadman.held) row.slider.value = position[i];
    });
  }
}

// A number with a typographic minus, and none before zero.
function signed(value, digits) {
  const text = value.toFixed(digits);
  return Number(text) === 0 ? text.replace("-", "") : text.replace("-", "−");
}
