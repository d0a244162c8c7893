// View: all jobs, newest first.

import { h } from "../dom.js";
import { JobList } from "./job.js";

export class View {
  constructor(ui) { this.jobs = new JobList(ui, "No jobs yet. Runs, conversions and training appear here, with their output."); }
  mount(element) { element.append(h("h2", {}, "Jobs"), this.jobs.element); }
  show(shown) { if (shown) this.jobs.show(); }
  job(job) { this.jobs.update(job); }
}
