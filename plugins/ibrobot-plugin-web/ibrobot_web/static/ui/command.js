// View: a command that runs as a job: its form, and what it has done.

import { h } from "../dom.js";
import { Form } from "./form.js";
import { JobList } from "./job.js";

export class View {
  constructor(ui, { name, command, title }) {
    this.ui = ui;
    this.reports = ui.session.views.filter(({ within }) => within === name);
    this.command = command;
    this.title = title;
    this.jobs = new JobList(ui, "None yet.", command);
  }

  mount(element) {
    this.form = new Form(this.title, this.command, (values) => this.start(values));
    const reports = this.reports.map((each) => h("a", { class: "button", href: `#${each.name}` }, each.title));
    element.append(h("div", { class: "row" }, h("h2", {}, this.title), reports), this.form.element, h("h2", {}, "Jobs"), this.jobs.element);
  }

  // The address may fill in fields: FIELD=VALUE, one in each line.
  async show(shown, rest) {
    if (!shown) return;
    this.jobs.show();
    await this.load();
    const given = [...(rest ?? "").matchAll(/^(\w+)=(.*)$/gm)].map(([, name, value]) => [name, value]);
    if (given.length && rest !== this.filled) this.form.enter(Object.fromEntries(given), true);
    this.filled = rest;
  }

  async load() {
    const form = await this.ui.attempt(() => this.ui.get("jobs/form", { command: this.command }));
    if (!form) return;
    this.form.show(form, this.ui.drives);
  }

  async start(values) {
    this.form.button.disabled = true;
    const started = await this.ui.attempt(() => this.ui.post("jobs/start", { command: this.command, values }));
    this.form.button.disabled = !this.ui.drives;
    this.jobs.reveal(started, this.form.button);
  }

  job(job) {
    const card = this.jobs.update(job);
    if (card && job.state !== "running" && card.ended !== job.state) { card.ended = job.state; this.load(); }
  }
}
