// View: all jobs, newest first.

import { h, refresh } from "../dom.js";
import { JobCard } from "./job.js";

export class View {
  constructor(ui) {
    this.ui = ui;
    this.cards = new Map();
  }

  mount(element) {
    this.none = h("p", { class: "note" }, "No jobs yet. Runs, conversions and training appear here, with their output.");
    this.list = h("div", { class: "columns" });
    element.append(h("h2", {}, "Jobs"), this.none, this.list);
  }

  show(shown) {
    if (!shown) return;
    for (const job of this.ui.jobs.values()) this.job(job);
  }

  job(job) {
    if (!this.cards.has(job.number)) this.cards.set(job.number, new JobCard(this.ui));
    this.cards.get(job.number).update(job);
    this.none.hidden = true;
    const numbers = [...this.ui.jobs.keys()].reverse();
    refresh(this.list, numbers, () => numbers.filter((n) => this.cards.has(n)).map((n) => this.cards.get(n).element));
  }
}
