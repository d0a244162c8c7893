// View: trained policies, which are put into robot YAMLs.

import { h, problem, refresh, replace, when } from "../dom.js";
import { remember } from "./chooser.js";
import { words } from "../words.js";

export class View {
  constructor(ui) { this.ui = ui; }

  mount(element) { element.append(h("h2", {}, "Policies"), this.use()); }

  // The card that puts a trained policy into a robot YAML.
  use() {
    this.checkpoint = h("select", { id: "use-checkpoint" });
    this.robot = h("select", { id: "use-robot" });
    this.model = h("input", { type: "text", id: "use-model", placeholder: "the first of this type, or a new one" });
    this.mode = h("input", { type: "text", id: "use-mode", placeholder: "for a new model" });
    this.change = h("div", { "aria-live": "polite", tabindex: "-1" });
    this.look = h("button", { class: "primary", disabled: true }, "Show the change");
    this.none = h("p", { class: "note", hidden: true }, "No trained policies in the opened folders. Train one, or copy one into them.");
    const form = h("form", {}, h("div", { class: "fields" },
      h("label", { for: "use-checkpoint" }, "Policy"), this.checkpoint, h("label", { for: "use-robot" }, "Robot"), this.robot,
      h("label", { for: "use-model" }, "Model"), this.model, h("label", { for: "use-mode" }, "Mode"), this.mode),
    h("div", { class: "row" }, this.look));
    form.addEventListener("submit", (event) => { event.preventDefault(); this.preview(); });
    for (const each of [this.checkpoint, this.robot, this.model, this.mode]) each.addEventListener("change", () => this.renew());
    return h("section", { class: "card", "aria-labelledby": "use-title" }, h("h3", { id: "use-title" }, "Use a trained policy"), this.none, form, this.change);
  }

  async show(shown, rest) {
    if (!shown) return;
    await this.load();
    if (!rest || rest === this.linked) return;
    this.linked = rest; // a policy that was just trained: its change is shown at once
    this.checkpoint.value = rest;
    this.renew();
  }

  async load() {
    const [found, robots] = await Promise.all([
      this.ui.attempt(() => this.ui.get("policies/list")), this.ui.attempt(() => this.ui.get("robots/list"))]);
    if (!found || !robots) return;
    robots.sort((one, other) => (other.source === "folder") - (one.source === "folder")); // own ones first
    fill(this.checkpoint, found.map(({ path }) => path),
      found.map(({ path, changed_s: at }) => `${short(path)} (${when(at)})`));
    const first = !this.robot.value;
    fill(this.robot, robots.map(({ robot }) => robot), robots.map(({ robot }) => robot));
    const { robot } = JSON.parse(sessionStorage.getItem("robot") ?? "{}"); // the one of the last run
    if (first && robots.some((each) => each.robot === robot)) this.robot.value = robot;
    this.look.disabled = !found.length;
    this.none.hidden = found.length > 0;
  }

  get request() {
    return { checkpoint: this.checkpoint.value, robot: this.robot.value, model: this.model.value.trim(), mode: this.mode.value.trim() };
  }

  // What was shown is of another choice.
  renew() {
    replace(this.change);
    if (this.linked && this.checkpoint.value && this.robot.value) this.preview();
  }

  async preview() {
    const { request } = this;
    const chosen = () => JSON.stringify(this.request) === JSON.stringify(request);
    let found;
    try {
      found = await this.ui.get("policies/preview", request);
    } catch (error) {
      if (chosen()) replace(this.change, problem(error.message));
      return;
    }
    if (!chosen()) return; // another choice meanwhile
    const write = h("button", {
      class: "primary", disabled: !this.ui.drives || found.problems.length > 0 || !found.diff.length,
      onclick: () => this.write(request, found),
    }, found.new ? `Write the new file ${found.target}` : `Write the file ${found.target}`);
    replace(this.change,
      found.diff.length ? h("pre", { class: "diff", tabindex: "0", "aria-label": "Change" }, found.diff.map((line) => (
        h("span", { class: line.startsWith("+") ? "added" : line.startsWith("-") ? "removed" : "" }, `${line}\n`))))
        : h("p", { class: "note" }, "The robot has this policy already."),
      ...found.problems.map((each) => h("div", { class: "problem" }, each)),
      h("p", {}, `The mode ${found.mode} runs the policy.`), h("div", { class: "row" }, write));
  }

  async write(request, { digest }) {
    const done = await this.ui.attempt(() => this.ui.post("policies/apply", { ...request, digest }));
    if (!done) return;
    const launched = { robot: done.robot, sim: true, mode: done.mode };
    remember(launched);
    const evaluation = this.ui.session.views.find(({ name }) => name === "job-eval");
    const filled = `${evaluation?.takes.robot}=${done.robot}\nmode=${done.mode}\nsim=yes`;
    replace(this.change, h("p", {}, `${done.robot} is written; its mode ${done.mode} runs the policy.`),
      h("p", { class: "warned" }, "The robot moves by itself as soon as the run has started, until you stop it."),
      h("div", { class: "row" },
        h("button", { class: "primary", onclick: () => this.ui.openRun(() => this.ui.post("robots/launch", launched)) }, "Launch it in simulation"),
        evaluation && h("a", { class: "button", href: `#${evaluation.name}/${encodeURIComponent(filled)}` }, "Evaluate it in simulation"),
        h("a", { class: "button", href: "#robots" }, "Choose how to launch it")));
    await this.load();
  }
}

// A checkpoint of a training by its step: TRAINING, step 5000.
function short(path) {
  const match = /^(.+)\/checkpoints\/0*(\d+)\/pretrained_model$/.exec(path);
  return match ? words(`${match[1]}, step ${match[2]}`) : path;
}

function fill(select, values, texts) {
  const before = select.value;
  refresh(select, [values, texts], () => values.map((value, i) => h("option", { value }, texts[i])));
  if (values.includes(before)) select.value = before;
}
