// View: training, its loss, and trained policies in robot YAMLs.

import { h, refresh, toast } from "../dom.js";
import { drawPlot } from "../plot.js";
import { JobCard } from "./job.js";

const POLICIES = [["small_act", "small ACT, for a CPU"], ["act", "ACT"], ["diffusion", "Diffusion"], ["smolvla", "SmolVLA"], ["vqbet", "VQ-BeT"]];

export class View {
  constructor(ui) {
    this.ui = ui;
    this.cards = new Map();
  }

  mount(element) {
    this.missing = h("div", {});
    this.dataset = h("select", { id: "train-dataset" });
    this.out = h("input", { type: "text", id: "train-out", value: "training", required: true });
    this.policy = h("select", { id: "train-policy" }, POLICIES.map(([value, text]) => h("option", { value }, text)));
    this.steps = h("input", { type: "number", id: "train-steps", min: "1", value: "5000" });
    this.batch = h("input", { type: "number", id: "train-batch", min: "1", value: "32" });
    this.device = h("input", { type: "text", id: "train-device", value: "auto" });
    this.begin = h("button", { class: "primary", disabled: true }, "Train");
    const form = h("form", { class: "card" }, this.missing, h("div", { class: "fields" },
      h("label", { for: "train-dataset" }, "Dataset"), this.dataset, h("label", { for: "train-policy" }, "Policy"), this.policy,
      h("label", { for: "train-steps" }, "Steps"), this.steps, h("label", { for: "train-batch" }, "Frames in a step"), this.batch,
      h("label", { for: "train-device" }, "Device"), this.device, h("label", { for: "train-out" }, "New folder"), this.out),
    h("div", { class: "row" }, this.begin));
    form.addEventListener("submit", (event) => { event.preventDefault(); this.start(); });
    this.list = h("div", { class: "columns" }, h("p", { class: "note" }, "No training yet."));
    element.append(h("h2", {}, "Train"), h("div", { class: "columns" }, form, this.use()), h("h2", {}, "Trainings"), this.list);
  }

  // The card that puts a trained policy into a robot YAML.
  use() {
    this.checkpoint = h("select", { id: "use-checkpoint" });
    this.robot = h("select", { id: "use-robot" });
    this.model = h("input", { type: "text", id: "use-model", placeholder: "the first LeRobot model, or a new one" });
    this.mode = h("input", { type: "text", id: "use-mode", placeholder: "for a new model" });
    this.change = h("div", { "aria-live": "polite" });
    this.look = h("button", { class: "primary", disabled: true }, "Show the change");
    this.none = h("p", { class: "note", hidden: true }, "No trained policies in the opened folders.");
    const form = h("form", {}, h("div", { class: "fields" },
      h("label", { for: "use-checkpoint" }, "Policy"), this.checkpoint, h("label", { for: "use-robot" }, "Robot"), this.robot,
      h("label", { for: "use-model" }, "Model"), this.model, h("label", { for: "use-mode" }, "Mode"), this.mode),
    h("div", { class: "row" }, this.look));
    form.addEventListener("submit", (event) => { event.preventDefault(); this.preview(); });
    for (const each of [this.checkpoint, this.robot, this.model, this.mode]) each.addEventListener("change", () => this.change.replaceChildren());
    return h("section", { class: "card", "aria-labelledby": "use-title" }, h("h3", { id: "use-title" }, "Use a trained policy"), this.none, form, this.change);
  }

  async show(shown) {
    this.shown = shown;
    if (!shown) return;
    for (const job of this.ui.of("train")) this.job(job);
    await this.load();
  }

  async load() {
    const [found, robots] = await Promise.all([
      this.ui.attempt(() => this.ui.get("training/list")), this.ui.attempt(() => this.ui.get("robots/list"))]);
    if (!found || !robots) return;
    fill(this.dataset, found.datasets, found.datasets);
    fill(this.checkpoint, found.checkpoints.map(({ path }) => path),
      found.checkpoints.map(({ path, changed_s: at }) => `${path} (${new Date(at * 1000).toLocaleString([], { dateStyle: "short", timeStyle: "short" })})`));
    fill(this.robot, robots.map(({ robot }) => robot), robots.map(({ robot }) => robot));
    this.begin.disabled = !this.ui.drives || Boolean(found.missing) || !found.datasets.length;
    this.look.disabled = !found.checkpoints.length;
    this.none.hidden = found.checkpoints.length > 0;
    refresh(this.missing, found, () => [
      found.missing ? h("div", { class: "problem" }, "Training needs LeRobot. Install it where ibrobot is installed:\n", h("code", {}, found.missing)) : null,
      found.datasets.length ? null : h("p", { class: "note" }, "No datasets in the opened folders. Convert episodes into one, in the view Convert."),
    ].filter(Boolean));
  }

  async start() {
    this.begin.disabled = true;
    await this.ui.attempt(() => this.ui.post("training/start", {
      dataset: this.dataset.value, out: this.out.value, policy: this.policy.value, device: this.device.value,
      steps: Number(this.steps.value), batch_size: Number(this.batch.value),
    }));
    this.begin.disabled = !this.ui.drives;
  }

  job(job) {
    if (job.kind !== "train") return;
    if (!this.cards.has(job.number)) {
      const card = new JobCard(this.ui);
      card.plot = h("canvas", { class: "plot", role: "img", "aria-label": "Loss over the steps of training" });
      card.result = h("div", {});
      card.details.before(card.plot, card.result);
      new ResizeObserver(() => draw(card)).observe(card.plot);
      this.cards.set(job.number, card);
    }
    const card = this.cards.get(job.number);
    card.update(job);
    card.job = job;
    draw(card);
    const { checkpoint } = job.facts;
    refresh(card.result, [checkpoint], () => (checkpoint ? [h("button", { class: "primary", onclick: () => this.choose(checkpoint) }, "Use it in a robot")] : []));
    const numbers = this.ui.of("train").map(({ number }) => number).filter((number) => this.cards.has(number));
    refresh(this.list, numbers, () => numbers.map((number) => this.cards.get(number).element));
    if (this.shown && job.state !== "running" && card.ended !== job.state) { card.ended = job.state; this.load(); }
  }

  async choose(checkpoint) {
    await this.load();
    this.checkpoint.value = checkpoint;
    this.checkpoint.focus();
  }

  get request() {
    return { checkpoint: this.checkpoint.value, robot: this.robot.value, model: this.model.value.trim(), mode: this.mode.value.trim() };
  }

  async preview() {
    const { request } = this;
    let found;
    try {
      found = await this.ui.get("training/preview", request);
    } catch (error) {
      this.change.replaceChildren(h("div", { class: "problem", role: "alert" }, error.message));
      return;
    }
    const write = h("button", {
      class: "primary", disabled: !this.ui.drives || found.problems.length > 0 || !found.diff.length,
      onclick: () => this.write(request, found),
    }, found.new ? `Write the new file ${found.target}` : `Write ${found.target}`);
    this.change.replaceChildren(
      found.diff.length ? h("pre", { class: "diff", tabindex: "0", "aria-label": "Change" }, found.diff.map((line) => (
        h("span", { class: line.startsWith("+") ? "added" : line.startsWith("-") ? "removed" : "" }, `${line}\n`))))
        : h("p", { class: "note" }, "The robot has this policy already."),
      ...found.problems.map((problem) => h("div", { class: "problem" }, problem)),
      h("p", {}, `The mode ${found.mode} runs the policy.`), h("div", { class: "row" }, write));
  }

  async write(request, { digest }) {
    const done = await this.ui.attempt(() => this.ui.post("training/apply", { ...request, digest }));
    if (!done) return;
    toast(`${done.robot} is written.`);
    const key = "robot";
    sessionStorage.setItem(key, JSON.stringify({ robot: done.robot, sim: true, mode: done.mode }));
    this.change.replaceChildren(h("p", {}, `${done.robot} is written; its mode ${done.mode} runs the policy.`),
      h("button", { class: "primary", onclick: () => { location.hash = "robots"; location.reload(); } }, "Launch it"));
    await this.load();
  }
}

function fill(select, values, texts) {
  const before = select.value;
  refresh(select, [values, texts], () => values.map((value, i) => h("option", { value }, texts[i])));
  if (values.includes(before)) select.value = before;
}

function draw({ plot, job }) {
  const points = job?.facts.points ?? [];
  plot.hidden = !points.length;
  if (!points.length) return;
  const steps = job.facts.steps ?? points.at(-1)[0];
  drawPlot(plot, {
    times: points.map(([step]) => step), lines: [["loss", points.map(([, loss]) => loss)]], begin: 0, end: steps,
    labels: ["loss, step 0", String(steps)],
  });
}
