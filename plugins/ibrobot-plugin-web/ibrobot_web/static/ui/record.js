// View: record a number of episodes of one task.

import { h, refresh, say } from "../dom.js";
import { Chooser } from "./chooser.js";
import { JobCard } from "./job.js";

const GIB = 1 << 30, MIB = 1 << 20;

export class View {
  constructor(ui) {
    this.ui = ui;
    this.cards = new Map();
    this.chooser = new Chooser(ui, (found) => this.found(found));
  }

  mount(element) {
    this.prompt = h("input", { type: "text", id: "record-prompt", placeholder: "pick the cube", maxlength: "500" });
    this.dataset = h("input", { type: "text", id: "record-dataset", value: "default" });
    this.dataset.addEventListener("change", () => this.place());
    this.count = h("input", { type: "number", id: "record-count", min: "1", max: "10000", value: "10" });
    this.begin = h("button", { class: "primary", disabled: true }, "Start the session");
    this.disk = h("p", { class: "note", "aria-live": "polite" });
    this.chooser.fields.append(h("label", { for: "record-prompt" }, "Task"), this.prompt,
      h("label", { for: "record-dataset" }, "Dataset"), this.dataset,
      h("label", { for: "record-count" }, "Episodes"), this.count, h("span", {}), this.disk);
    this.form = h("form", {}, this.chooser.fields, h("div", { class: "row" }, this.begin));
    this.form.addEventListener("submit", (event) => { event.preventDefault(); this.start(); });
    this.sessions = h("div", { class: "columns" },
      h("p", { class: "note" }, "No session yet. In its page, you begin, judge and discard each episode."));
    element.append(h("h2", {}, "Record"), h("div", { class: "columns" },
      h("section", { class: "card", "aria-label": "Session" }, this.form),
      h("section", { class: "card", "aria-label": "Check" }, this.chooser.report)),
    h("h2", {}, "Sessions"), this.sessions);
  }

  show(shown) {
    if (!shown) return;
    this.chooser.load();
    this.place();
    for (const job of this.ui.of("record")) this.job(job);
  }

  found(found) {
    this.begin.disabled = !this.chooser.ready || !this.ui.drives;
    if (found?.dataset && this.dataset.value === "default") { this.dataset.value = found.dataset; this.place(); }
  }

  // Where episodes go, and for how many the disk has room.
  async place() {
    try {
      const { folder, episodes, free_bytes: free, episode_bytes: size } = await this.ui.get("record/place", { dataset: this.dataset.value });
      const room = size ? `, room for some ${Math.floor(free / size)} episodes of ${(size / MIB).toFixed(1)} MiB` : "";
      say(this.disk, `${folder}: ${episodes} episode${episodes === 1 ? "" : "s"} so far · ${(free / GIB).toFixed(1)} GiB of disk left${room}`);
      this.disk.classList.remove("bad");
    } catch (error) {
      say(this.disk, error.message);
      this.disk.classList.add("bad");
    }
  }

  async start() {
    this.begin.disabled = true;
    await this.ui.attempt(() => this.ui.post("record/start", {
      ...this.chooser.request, prompt: this.prompt.value, dataset: this.dataset.value, episodes: Number(this.count.value),
    }));
    this.begin.disabled = !this.chooser.ready || !this.ui.drives;
  }

  job(job) {
    if (job.kind !== "record") return;
    if (!this.cards.has(job.number)) this.cards.set(job.number, new JobCard(this.ui));
    this.cards.get(job.number).update(job);
    if (job.state !== "running") this.place();
    const numbers = this.ui.of("record").map(({ number }) => number);
    refresh(this.sessions, numbers, () => numbers.filter((n) => this.cards.has(n)).map((n) => this.cards.get(n).element));
  }
}
