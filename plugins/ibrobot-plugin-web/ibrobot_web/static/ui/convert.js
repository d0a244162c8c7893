// View: conversion of episodes into a dataset.

import { h, refresh } from "../dom.js";
import { JobCard } from "./job.js";

const OUTCOMES = [["", "all"], ["success", "successful ones"], ["failure", "failed ones"], ["unknown", "those not judged"]];
const ONLY = [["all", "all rows"], ["interventions", "what the operator commanded"], ["policy", "what the policy commanded"]];
const MISSING = [["skip", "leave the tick out"], ["hold", "hold the last value"], ["refuse", "leave the episode out"]];
const UNITS = [["radians", "radians"], ["degrees", "degrees, as LeRobot's drivers"], ["range_m100_100", "−100 to 100, as LeRobot's drivers"]];

export class View {
  constructor(ui) {
    this.ui = ui;
    this.cards = new Map();
    this.results = new Map();
  }

  mount(element) {
    this.groups = h("fieldset", {}, h("legend", {}, "Episodes"));
    this.out = h("input", { type: "text", id: "convert-out", required: true, list: "convert-known", placeholder: "datasets/pick_cube" });
    this.known = h("datalist", { id: "convert-known" });
    this.append = h("input", { type: "checkbox", id: "convert-append" });
    this.success = h("input", { type: "checkbox", id: "convert-success" });
    this.prompt = h("input", { type: "text", id: "convert-prompt", placeholder: "for episodes without a task" });
    this.outcome = select("convert-outcome", OUTCOMES);
    this.only = select("convert-only", ONLY);
    this.missing = select("convert-missing", MISSING);
    this.unit = select("convert-unit", UNITS);
    this.begin = h("button", { class: "primary", disabled: true }, "Convert");
    const form = h("form", { class: "card" }, this.groups, h("div", { class: "fields gap" },
      h("label", { for: "convert-out" }, "Dataset"), h("div", {}, this.out, this.known),
      h("label", { for: "convert-append" }, "Add to it"), h("div", {}, this.append, " if it exists"),
      h("label", { for: "convert-outcome" }, "Only"), this.outcome), h("details", {}, h("summary", {}, "More options"),
      h("div", { class: "fields gap" }, h("label", { for: "convert-only" }, "Rows"), this.only,
        h("label", { for: "convert-missing" }, "If an observation is missing"), this.missing,
        h("label", { for: "convert-unit" }, "Unit of joints"), this.unit,
        h("label", { for: "convert-prompt" }, "Task"), this.prompt,
        h("label", { for: "convert-success" }, "Add next.success"), h("div", {}, this.success))),
    h("div", { class: "row" }, this.begin));
    form.addEventListener("submit", (event) => { event.preventDefault(); this.start(); });
    this.list = h("div", { class: "columns" }, h("p", { class: "note" }, "No conversion yet."));
    element.append(h("h2", {}, "Convert"), form, h("h2", {}, "Conversions"), this.list);
  }

  async show(shown) {
    if (!shown) return;
    for (const job of this.ui.of("convert")) this.job(job);
    const found = await this.ui.attempt(() => this.ui.get("convert/list"));
    if (!found) return;
    this.empty = !found.groups.length;
    this.begin.disabled = !this.ui.drives || this.empty;
    refresh(this.known, found.datasets, () => found.datasets.map((path) => h("option", { value: path })));
    refresh(this.groups, found.groups, () => [h("legend", {}, "Episodes"), ...(found.groups.length
      ? found.groups.map(({ path, episodes }, i) => {
        const box = h("input", { type: "checkbox", value: path });
        box.checked = found.groups.length === 1 && i === 0;
        return h("label", { class: "row" }, box, `${path}: ${episodes} episode${episodes === 1 ? "" : "s"}`);
      }) : [h("p", { class: "note" }, "No episodes in the opened folders. Record some, in the view Record.")])]);
  }

  async start() {
    const paths = [...this.groups.querySelectorAll("input:checked")].map(({ value }) => value);
    this.begin.disabled = true;
    await this.ui.attempt(() => this.ui.post("convert/start", {
      paths, out: this.out.value, append: this.append.checked, success: this.success.checked, prompt: this.prompt.value,
      outcome: this.outcome.value, only: this.only.value, missing: this.missing.value, norm_mode: this.unit.value,
    }));
    this.begin.disabled = !this.ui.drives || this.empty;
  }

  job(job) {
    if (job.kind !== "convert") return;
    if (!this.cards.has(job.number)) {
      this.cards.set(job.number, new JobCard(this.ui));
      const result = h("div", {});
      this.results.set(job.number, result);
      this.cards.get(job.number).element.append(result);
    }
    this.cards.get(job.number).update(job);
    const { problems = [], report, out } = job.facts;
    refresh(this.results.get(job.number), [problems, report, job.state], () => [
      ...problems.map(({ episode, error }) => h("div", { class: "problem" }, `${episode} is left out: ${error}`)),
      report?.episodes ? h("a", { class: "button", href: `#datasets/${encodeURIComponent(out)}` }, "Open the dataset") : null,
    ].filter(Boolean));
    const numbers = this.ui.of("convert").map(({ number }) => number).filter((number) => this.cards.has(number));
    refresh(this.list, numbers, () => numbers.map((number) => this.cards.get(number).element));
  }
}

function select(id, choices) {
  return h("select", { id }, choices.map(([value, text]) => h("option", { value }, text)));
}
