// A first look: what the opened folders contain, by the groups of the work, each with its next step.

import { h, refresh, when } from "../dom.js";

const FIRST_S = 1e9; // runs in lockstep have a clock of their own, which begins in 1970
const RUNS = ["run", "record"];
// Titles of a robot's runs: the name of its file, without the ending.
const RUN_OF = (robot) => { const name = robot.split("/").at(-1).replace(/\.ya?ml$/, ""); return [name, `${name} in simulation`]; };

export class Overview {
  // `choose` is called with the robot of the card that was clicked.
  constructor(ui, choose) {
    this.ui = ui;
    this.choose = choose;
    this.tiles = h("section", { class: "tiles", "aria-label": "Overview" });
    this.robots = h("section", { class: "tiles", "aria-label": "Your robots" });
    this.element = h("div", { class: "overview" }, this.tiles, this.robots);
  }

  // Marks the robot that is chosen now.
  mark(robot) {
    this.chosen = robot;
    if (this.found) this.show(this.found);
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
    this.found = found;
    const runs = [...this.ui.jobs.values()].filter(({ kind, state, facts }) => RUNS.includes(kind) && state === "running" && facts.url);
    refresh(this.tiles, [found, runs.map(({ number, facts }) => [number, facts.url])], () => [
      tile("Set up", this.setUp(found, runs)), tile("Record", record(found)), tile("Learn", learn(found)), tile("Evaluate", evaluate(found))]);
    const last = (robot) => [...this.ui.jobs.values()].filter(({ kind, title }) => kind === "run" && RUN_OF(robot).includes(title)).at(-1);
    refresh(this.robots, found.robots.map(({ robot, summary }) => [robot, summary, robot === this.chosen, last(robot)?.state, last(robot)?.facts.url]), () =>
      found.robots.map(({ robot, summary }) => tile(robot, this.robot(robot, summary, last(robot)), "h3")));
  }

  robot(robot, summary, run) {
    const running = run?.state === "running";
    const state = running ? "It runs." : run?.state === "failed" ? "Its last run failed." : run ? "Its last run has ended." : "Not running.";
    return [summary, h("p", { class: running ? "good" : run?.state === "failed" ? "bad" : "note" }, state), h("div", { class: "row" },
      running && run.facts.url ? h("a", { class: "button primary", href: this.ui.runAddress(run.facts.url), target: "_blank" }, "Open its page")
        : robot === this.chosen ? h("span", { class: "note" }, "Chosen below.")
          : h("button", { onclick: () => this.choose(robot), "aria-label": `Choose ${robot}` }, "Choose"))].filter(Boolean);
  }

  setUp({ robots }, runs) {
    const running = runs.map(({ title, facts }) => h("a", { class: "button primary", href: this.ui.runAddress(facts.url), target: "_blank" }, `Open ${title}`));
    const own = robots.length ? [`${count(robots.length, "robot")} of your own.`] : ["No robot of your own yet: launch a shipped one in simulation, or copy it for your arm."];
    return [...own, ...(running.length ? running : [robots.length ? link("devices", "Check its devices") : link("robots", "Choose a robot below")])];
  }
}

function record({ episodes, unjudged, newest }) {
  if (!episodes) return ["No episode yet.", link("record", "Record some")];
  return [unjudged ? `${count(episodes, "episode")}, ${unjudged} not judged.` : `${count(episodes, "episode")}, all judged.`,
    h("ul", { class: "list", "aria-label": "The newest" }, newest.map(({ path, task, outcome, began_s: began }) => h("li", {},
      h("a", { href: `#episodes/${encodeURIComponent(path)}` }, task ? `“${task}”` : path.split("/").at(-1)), ", ", h("span", {}, outcome), began > FIRST_S ? `, ${when(began)}` : null))),
    unjudged ? link("episodes", `Judge ${count(unjudged, "episode")}`) : link("record", "Record more")];
}

function learn({ episodes, datasets, policies }) {
  const text = `${count(datasets.length, "dataset")}, ${count(policies.length, "policy", "policies")}.`;
  if (!datasets.length) return [text, episodes ? link("job-convert", "Convert the episodes") : note("Datasets are made from recorded episodes.")];
  return [text, policies.length ? link("policies", "Use a policy in a robot") : link("job-train", "Train a policy")];
}

function evaluate({ policies, reports }) {
  const text = reports ? `${count(reports, "evaluation")}.` : "No evaluation yet.";
  return [text, reports ? link("report-evaluation", "See the results") : policies.length ? link("job-eval", "Evaluate a policy") : note("An evaluation needs a trained policy.")];
}

const note = (text) => h("p", { class: "note" }, text);
const link = (view, text) => h("a", { class: "button", href: `#${view}` }, text);
const count = (number, one, several = `${one}s`) => `${number} ${number === 1 ? one : several}`;

function tile(title, content, heading = "h2") {
  return h("div", { class: "card" }, h(heading, {}, title), ...content.map((each) => (typeof each === "string" ? h("p", {}, each) : each)));
}
