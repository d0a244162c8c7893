// A copy of the chosen robot YAML with one's own ports and cameras, chosen from what was found.

import { capital, h, toast } from "../dom.js";

export class Copy {
  constructor(ui, chooser) {
    this.ui = ui;
    this.chooser = chooser;
    this.form = h("form", { class: "fields" });
    this.form.addEventListener("submit", (event) => { event.preventDefault(); this.write(); });
    this.element = h("details", {}, h("summary", {}, "Copy it to a file with my ports and cameras"), this.form);
    this.element.addEventListener("toggle", () => { if (this.element.open) this.load(); });
  }

  enable() {
    this.element.hidden = !this.ui.drives || !this.chooser.request.robot;
    if (this.element.open && this.robot !== this.chooser.request.robot) this.load();
  }

  async load() {
    const robot = this.robot = this.chooser.request.robot;
    const found = await this.ui.attempt(() => this.ui.get("robots/copying", { robot }));
    if (!found || robot !== this.robot) return;
    this.file = h("input", { id: "copy-file", type: "text", required: true, value: found.file });
    this.values = found.variables.map((variable) => field(variable));
    const lacks = found.variables.some(({ found: values }) => values.length) ? "" : "No arm and no camera was found: plug them in, and open this again, or keep what is written here.";
    this.form.replaceChildren(h("label", { for: "copy-file" }, "File"), this.file,
      ...this.values.flatMap(({ elements }) => elements),
      ...(lacks ? [h("span", {}), h("p", { class: "note" }, lacks)] : []),
      h("span", {}), h("div", { class: "row" }, h("button", { class: "primary" }, "Copy"),
        h("a", { class: "button", href: "#devices" }, "Which is which?")));
  }

  async write() {
    const values = Object.fromEntries(this.values.map(({ name, input }) => [name, input.value]));
    const made = await this.ui.attempt(() => this.ui.post("robots/copy", { robot: this.robot, file: this.file.value, values }));
    if (!made) return;
    this.element.open = false;
    toast(`${made.robot} is written. It is chosen now.`);
    await this.chooser.load();
    this.chooser.choose({ robot: made.robot, mode: "" });
  }
}

// A variable: `IBROBOT_TOP_CAMERA` is "Top camera".
function field({ name, default: usual, found }) {
  const words = name.replace(/^IBROBOT_/, "").toLowerCase().replaceAll("_", " ");
  const id = `copy-${name}`;
  const choices = h("datalist", { id: `${id}-found` }, found.map((value) => h("option", { value })));
  const input = h("input", { id, type: "text", value: usual, list: `${id}-found`, title: name });
  const note = found.length ? `found: ${found.join(", ")}` : "";
  return {
    name, input,
    elements: [h("label", { for: id }, capital(words)),
      h("div", {}, input, choices, note ? h("p", { class: "note" }, note) : null)],
  };
}
