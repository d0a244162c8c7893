// View: record a number of episodes of one task.

import { h, say } from "../dom.js";
import { Chooser } from "./chooser.js";
import { Form } from "./form.js";
import { JobList } from "./job.js";

const GIB = 1 << 30, MIB = 1 << 20;

export class View {
  constructor(ui) {
    this.ui = ui;
    this.sessions = new JobList(ui, "No session yet. In its page, you begin, judge and discard each episode.", "record");
    this.chooser = new Chooser(ui, (found) => this.found(found));
  }

  mount(element) {
    this.form = new Form("Start the session", "record", (values) => this.start(values));
    this.disk = h("p", { class: "note", "aria-live": "polite" });
    this.chooser.fields.classList.add("form");
    this.form.element.prepend(this.chooser.fields);
    this.form.others.before(this.disk);
    this.form.element.addEventListener("change", () => this.place());
    element.append(h("h2", {}, "Record"), h("div", { class: "columns" },
      this.form.element, h("section", { class: "card", "aria-label": "Check" }, this.chooser.report)),
    h("h2", {}, "Sessions"), this.sessions.element);
  }

  async load() {
    const form = await this.ui.attempt(() => this.ui.get("jobs/form", { command: "record" }));
    if (!form) return;
    this.missing = form.missing;
    this.form.show({ ...form, summary: "" }, this.ui.drives);
    this.suggest();
    this.enable();
    this.place();
  }

  // The dataset of the robot's YAML, unless one was entered.
  suggest() {
    const { dataset } = this.chooser.found ?? {};
    if (dataset) this.form.propose("dataset", dataset);
  }

  enable() { this.form.button.disabled = !this.chooser.ready || !this.ui.drives || Boolean(this.missing) || this.ui.startsRun; }

  show(shown) {
    if (!shown) return;
    this.chooser.load();
    this.load();
    this.sessions.show();
  }

  found(found) {
    this.enable();
    this.suggest();
    if (found) this.place();
  }

  // Where episodes go, and for how many the disk has room.
  async place() {
    try {
      const { folder, episodes, free_bytes: free, episode_bytes: size } = await this.ui.get("record/place", { dataset: this.form.values.dataset || undefined });
      const room = size ? `, room for about ${Number(Math.floor(free / size).toPrecision(2)).toLocaleString()} episodes of ${(size / MIB).toFixed(1)} MiB` : "";
      say(this.disk, `${folder}: ${episodes} episode${episodes === 1 ? "" : "s"} so far · ${(free / GIB).toFixed(1)} GiB of disk left${room}`);
      this.disk.classList.remove("bad");
    } catch (error) {
      say(this.disk, error.message);
      this.disk.classList.add("bad");
    }
  }

  async start(values) {
    this.form.button.disabled = true;
    const started = await this.ui.openRun(() => this.ui.post("record/start", { ...this.chooser.request, values }));
    this.enable();
    this.sessions.reveal(started, this.form.button);
  }

  job(job) {
    this.enable();
    const card = this.sessions.update(job);
    if (!card || job.state === "running") return;
    this.place();
    if (card.ended !== job.state) card.element.scrollIntoView({ block: "nearest" }); // with the next steps
    card.ended = job.state;
  }
}
