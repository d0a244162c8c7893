// A first look: what the opened folders contain, by the groups of the work, each with its next step.

import { h, refresh, when } from "../dom.js";

const RUNS = ["run", "record"];

export class Overview {
  constructor(ui) {
    this.ui = ui;
    this.element = h("section", { class: "tiles", "aria-label": "Overview" });
  }

  // Counts again; what was asked while it counts is asked once more.
  async load() {
    if (this.loading) { this.again = true; return; }
    this.loading = true;
    try {
      do {
        this.again = false;
        const found = await this.ui.attempt(() => this.ui.get("robots/overview"));
        if (found) this.show(found);
      } while (this.again);
    } finally {
      this.loading = false;
    }
  }

  show(found) {
    const runs = [...this.ui.jobs.values()].filter(({ kind, state, facts }) => RUNS.includes(kind) && state === "running" && facts.url);
    refresh(this.element, [found, runs.map(({ number, facts }) => [number, facts.url])], () => [
      tile("Set up", this.setUp(found, runs)), tile("Record", record(found)), tile("Learn", learn(found)), tile("Evaluate", evaluate(found))]);
  }

  setUp({ robots }, runs) {
    const running = runs.map(({ title, facts }) => h("a", { class: "button primary", href: this.ui.runAddress(facts.url), target: "_blank" }, `Open ${title}`));
    const own = robots.length ? [`Your robots: ${robots.map(({ robot }) => robot).join(", ")}.`] : ["No robot of your own yet: launch a shipped one in simulation, or copy it for your arm."];
    return [...own, ...(running.length ? running : [robots.length ? link("devices", "Check its devices") : link("robots", "Choose a robot below")])];
  }
}

function record({ episodes, unjudged, newest }) {
  if (!episodes) return ["No episode yet.", link("record", "Record some")];
  const last = newest[0];
  return [`${count(episodes, "episode")}, ${unjudged} not judged.`,
    `The newest: ${[last.task && `“${last.task}”`, last.outcome, last.began_s && when(last.began_s)].filter(Boolean).join(", ")}.`,
    unjudged ? link("episodes", `Judge ${count(unjudged, "episode")}`) : link("record", "Record more")];
}

function learn({ episodes, datasets, policies }) {
  const text = `${count(datasets.length, "dataset")}, ${count(policies.length, "policy", "policies")}.`;
  if (!datasets.length) return [text, episodes ? link("job-convert", "Convert the episodes") : null];
  return [text, policies.length ? link("policies", "Use a policy in a robot") : link("job-train", "Train a policy")];
}

function evaluate({ policies, reports }) {
  const text = reports ? `${count(reports, "evaluation")}.` : "No evaluation yet.";
  return [text, reports ? link("report-evaluation", "See the results") : policies.length ? link("job-eval", "Evaluate a policy") : null];
}

const link = (view, text) => h("a", { class: "button", href: `#${view}` }, text);
const count = (number, one, several = `${one}s`) => `${number} ${number === 1 ? one : several}`;

function tile(title, content) {
  return h("div", { class: "card" }, h("h2", {}, title), ...content.map((each) => (typeof each === "string" ? h("p", {}, each) : each)));
}
