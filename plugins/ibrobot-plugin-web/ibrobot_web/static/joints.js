// One row for each joint: position between the limits, command, and jog by slider or buttons.

import { h, refresh } from "./dom.js";

export class Joints {
  constructor(section, page) {
    this.section = section;
    this.page = page;
    this.rows = [];
  }

  update({ robot }) {
    refresh(this.section, robot.joints, () => {
      this.rows = robot.joints.map((joint) => this.row(joint));
      return [h("h2", {}, "Joints"), ...this.rows.map((row) => row.element)];
    });
    const jogs = Boolean(this.page.jogs);
    for (const row of this.rows) for (const control of [row.slider, row.less, row.more]) control.disabled = !jogs;
  }

  row(joint) {
    const { deadman } = this.page;
    const step = (joint.upper - joint.lower) / 1000;
    const slider = h("input", {
      type: "range", min: joint.lower, max: joint.upper, step, "aria-label": `${joint.name}, target`,
    });
    const request = () => ({ targets: { [joint.name]: Number(slider.value) } });
    slider.addEventListener("pointerdown", () => deadman.hold(request));
    const arrows = ["ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown", "PageUp", "PageDown", "Home", "End"];
    slider.addEventListener("keydown", (event) => { if (arrows.includes(event.key) && !event.repeat) deadman.hold(request); });
    for (const name of ["keyup", "blur"]) slider.addEventListener(name, () => deadman.release());
    const button = (sign, speed) => deadman.button(
      h("button", { "aria-label": `${joint.name} ${sign === "−" ? "down" : "up"}, hold to move` }, sign),
      () => ({ joints: { [joint.name]: speed } }));
    const less = button("−", -1), more = button("+", 1);
    const value = h("output", {}), bar = h("div", { class: "value" }), command = h("div", { class: "command" });
    const element = h("div", { class: "joint" }, h("span", { class: "name" }, joint.name), value,
      h("div", { class: "bar", "aria-hidden": "true" }, bar, command), h("div", { class: "jog" }, less, slider, more));
    return { element, slider, less, more, value, bar, command, joint };
  }

  state({ position, command }) {
    this.rows.forEach((row, i) => {
      const { lower, upper } = row.joint;
      const share = (value) => `${100 * Math.min(1, Math.max(0, (value - lower) / (upper - lower)))}%`;
      row.value.textContent = this.page.view.slides.includes(row.joint.name) ? `${signed(position[i], 3)} m`
        : `${signed(position[i], 2)} rad · ${signed(position[i] * 180 / Math.PI, 0)}°`;
      row.bar.style.width = share(position[i]);
      row.command.style.left = share(command[i]);
      row.element.classList.toggle("outside", position[i] < lower || position[i] > upper);
      if (document.activeElement !== row.slider || !this.page.deadman.held) row.slider.value = position[i];
    });
  }
}

// A number with a typographic minus, and none before zero.
function signed(value, digits) {
  const text = value.toFixed(digits);
  return Number(text) === 0 ? text.replace("-", "") : text.replace("-", "−");
}
