// One row for each joint: position between the limits, command, and jog by slider or buttons. Angles are in one unit.

import { h, refresh, say } from "./dom.js";
import { words } from "./words.js";

const KEY = "angles";
const DEGREES = 180 / Math.PI;
const SHORT = 1; // range of joints whose positions have a third digit [rad or m]

export class Joints {
  constructor(section, page) {
    this.section = section;
    this.page = page;
    this.rows = [];
    this.degrees = localStorage.getItem(KEY) === "deg"; // radians as in the YAML, goals and the panel of the terminal
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
    const { jogs, mode, device } = this.page;
    const own = jogs.length > 1 ? mode.jogs[device] : null; // those of the chosen arm
    const shared = own ? prefix(own) : "";
    refresh(this.list, [robot.joints, own], () => {
      this.rows = robot.joints.map((joint, index) => ({ joint, index })).filter(({ joint }) => !own || own.includes(joint.name))
        .map(({ joint, index }) => this.row(joint, index, joint.name.slice(shared.length)));
      return this.rows.map((row) => row.element);
    });
    for (const row of this.rows) {
      row.device = jogs.find((device) => mode.jogs[device].includes(row.joint.name));
      for (const control of [row.slider, row.less, row.more]) control.disabled = !row.device;
    }
  }

  row(joint, index, name) {
    const { deadman } = this.page;
    const step = (joint.upper - joint.lower) / 1000;
    const row = { joint, index };
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
    row.element = h("div", { class: "joint" }, h("span", { class: "name", title: joint.name }, name), row.value,
      h("div", { class: "bar", "aria-hidden": "true" }, row.bar, row.command),
      h("div", { class: "jog" }, row.less, h("div", { class: "track" }, row.slider), row.more));
    return row;
  }

  state({ position, command }) {
    this.rows.forEach((row) => {
      const i = row.index;
      const { lower, upper, name } = row.joint;
      const share = (value) => `${100 * Math.min(1, Math.max(0, (value - lower) / (upper - lower)))}%`;
      const slides = this.page.view.slides.includes(name), digits = upper - lower < SHORT ? 3 : 2; // as in the panel
      say(row.value, this.degrees ? (slides ? `${signed(position[i] * 1000, 0)} mm` : `${signed(position[i] * DEGREES, 0)}°`)
        : `${signed(position[i], digits)} ${slides ? "m" : "rad"}`);
      row.bar.style.width = share(position[i]);
      row.command.style.left = share(command[i]);
      const beyond = (upper - lower) / 200; // a joint that rests at its limit is not outside
      row.element.classList.toggle("outside", position[i] < lower - beyond || position[i] > upper + beyond);
      if (document.activeElement !== row.slider || !this.page.deadman.held) row.slider.value = position[i];
    });
  }
}

// What the names of an arm's joints begin with, up to a separator, e.g. `left_`.
function prefix(names) {
  const first = names[0] ?? "";
  for (let end = first.length - 1; end > 0; end--) {
    const begin = first.slice(0, end);
    if (/[_/.-]$/.test(begin) && names.length > 1 && names.every((name) => name.startsWith(begin))) return begin;
  }
  return "";
}

// A number with a typographic minus, and none before zero.
function signed(value, digits) {
  const text = value.toFixed(digits);
  return Number(text) === 0 ? text.replace("-", "") : text.replace("-", "−");
}
