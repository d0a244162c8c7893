// View: choose a robot, see its problems, launch it, and stop it.

import { h, say } from "../dom.js";
import { Chooser } from "./chooser.js";
import { Copy } from "./copy.js";
import { JobList, RUNS } from "./job.js";
import { Overview } from "./overview.js";

export class View {
  constructor(ui) {
    this.ui = ui;
    this.runs = new JobList(ui, "No run yet. A run opens a page of its own, which shows and drives the robot.", ...RUNS);
    this.chooser = new Chooser(ui, () => this.enable());
    this.copy = new Copy(ui, this.chooser);
    this.overview = new Overview(ui, (robot) => {
      this.chooser.choose({ robot, mode: "" });
      this.chooser.fields.scrollIntoView({ block: "center" });
      this.chooser.robot.focus();
    });
  }

  mount(element) {
    this.launch = h("button", { class: "primary", disabled: true, onclick: () => this.start() }, "Launch");
    this.hint = h("p", { class: "note" });
    element.append(this.overview.element, h("h2", {}, "Robots"),
      h("div", { class: "columns" },
        h("section", { class: "card", "aria-label": "Choice" }, this.chooser.fields,
          h("div", { class: "row" }, this.launch, h("a", { class: "button", href: "#record" }, "Record episodes")), this.hint, this.copy.element),
        h("section", { class: "card", "aria-label": "Check" }, this.chooser.report)),
      h("h2", {}, "Runs"), this.runs.element);
  }

  show(shown) {
    if (!shown) return;
    this.chooser.load();
    this.runs.show();
    this.overview.load();
  }

  enable() {
    this.copy.enable();
    this.overview.mark(this.chooser.request.robot);
    this.launch.disabled = !this.chooser.ready || !this.ui.drives || this.ui.startsRun;
    const { found } = this.chooser;
    say(this.hint, found?.modes && !found.modes.some(({ jogs }) => Object.keys(jogs).length)
      ? "No mode of this YAML is driven from the robot's page. To jog from it, add `web: {type: web}` to `teleoperation`, and a mode with `teleop: web`." : "");
  }

  async start() {
    this.launch.disabled = true;
    const started = await this.ui.openRun(() => this.ui.post("robots/launch", this.chooser.request));
    this.enable();
    this.runs.reveal(started, this.launch);
  }

  job(job) {
    this.runs.update(job);
    this.enable();
    this.overview.load();
  }
}
