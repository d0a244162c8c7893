// A card that shows a job: state, progress, output, and the button that ends it.

import { h, problem, refresh, regain, say } from "../dom.js";
import { drawPlot } from "../plot.js";
import { Question } from "./question.js";
import { words } from "../words.js";

// What a job has made -> the view that shows it.
const MADE = { dataset: ["datasets", "Open the dataset"], policy: ["policies", "Use it in a robot"], episode: ["episodes", "See the episode"], episodes: ["episodes", "Judge the episodes"] };
const REVEAL_MS = 300;
export const RUNS = ["run", "record"];
const SET_UP = "Set up"; // the group of views whose steps come first, or much later
const STATES = { running: "running", done: "done", failed: "failed", cancelled: "ended" };

// The title of a job begins with what the page calls its command; then it names files.
export function titled(title) {
  const shown = words(title);
  return shown === title ? title.replace(/^\S+/, (name) => words(name)) : shown;
}

// What a job says, in lines of one sentence or of several with semicolons between them; some follow the name of an episode.
function told(text) {
  return text.replace(/ {2,}/g, " ").split("\n").map((line) => { // without the columns of a terminal
    const parts = line.split("; "), shown = parts.map(sentence), whole = sentence(line);
    return whole === line || parts.every((each, i) => each !== shown[i]) ? shown.join("; ") : whole;
  }).join("\n");
}

function sentence(text) {
  const shown = words(text);
  return shown === text ? text.replace(/(?<=^\S+: ).+$/, words) : shown;
}

export class JobCard {
  constructor(ui) {
    this.ui = ui;
    this.state = h("span", { class: "state", role: "status" });
    this.title = h("h3", {});
    this.controls = h("div", { class: "row" });
    this.progress = h("progress", { max: "1", "aria-label": "Progress", hidden: true });
    this.facts = h("p", { class: "lines" });
    this.error = h("div", {});
    this.question = new Question(ui);
    this.plot = h("canvas", { class: "plot", role: "img", hidden: true });
    new ResizeObserver(() => this.draw()).observe(this.plot);
    this.problems = h("div", {});
    this.made = h("div", { class: "row" });
    this.output = h("pre", { class: "output", tabindex: "0", "aria-label": "Output" });
    this.details = h("details", { ontoggle: () => { this.output.scrollTop = this.output.scrollHeight; } }, h("summary", {}, "Output"), this.output);
    this.element = h("div", { class: "card job", tabindex: "-1" }, h("div", { class: "row" }, this.title, this.state), this.progress,
      this.facts, this.question.element, this.error, this.plot, this.problems, this.made, this.controls, this.details);
  }

  update(job) {
    say(this.title, titled(job.title));
    say(this.state, job.cancelling && job.state === "running" ? "ending …" : STATES[job.state]);
    this.state.className = `state ${job.state}`;
    const { progress } = job.facts;
    this.progress.hidden = progress === undefined || job.state !== "running";
    if (progress !== undefined) this.progress.value = progress;
    const starts = job.state === "running" && RUNS.includes(job.kind) && !job.facts.url;
    say(this.facts, starts ? `starts … ${job.lines.at(-1) ?? ""}` : told(job.facts.text ?? ""));
    this.question.update(job);
    refresh(this.error, [job.state, job.exit_code, job.facts.error], () => (job.state === "failed" ? failure(job) : []));
    refresh(this.controls, [job.state, job.cancelling, job.facts.url, this.ui.drives], () => this.buttons(job));
    this.job = job;
    this.draw();
    const { problems = [], made = [] } = job.facts;
    refresh(this.problems, problems, () => problems.map((each) => h("div", { class: "problem" }, told(each))));
    refresh(this.made, [made, job.state], () => (job.state === "running" ? [] : made.flatMap((each) => this.next(each))));
    const text = job.lines.join("\n");
    this.details.hidden = !text;
    if (this.output.textContent !== text) {
      const atEnd = this.output.scrollHeight - this.output.scrollTop - this.output.clientHeight < 30;
      this.output.textContent = text;
      if (atEnd) this.output.scrollTop = this.output.scrollHeight;
    }
  }

  // Links from what a job has made: to the view that shows it, and to the commands that work on it, filled in.
  next({ kind, path }) {
    const { views } = this.ui.session;
    const shows = MADE[kind] ?? views.filter(({ report }) => report === kind).map(({ name, title }) => [name, `Open in ${title}`])[0];
    const link = (name, rest, text) => h("a", { class: "button", href: `#${name}/${encodeURIComponent(rest)}` }, text);
    const taking = views.filter(({ takes }) => takes?.[kind]);
    const onward = [...taking.filter(({ group }) => group !== SET_UP), ...taking.filter(({ group }) => group === SET_UP)];
    return [shows && link(shows[0], path, shows[1]),
      ...onward.map(({ name, title, takes }) => link(name, `${takes[kind]}=${path}`, title))].filter(Boolean);
  }

  // The curve of the job, e.g. its loss over its steps.
  draw() {
    const { points = [], axes = [], progress } = this.job?.facts ?? {};
    this.plot.hidden = !points.length;
    if (!points.length) return;
    const last = points.at(-1)[0];
    const end = progress ? Math.max(last, last / progress) : last;
    this.plot.setAttribute("aria-label", words(`Plot of ${words(axes[1])} over ${words(axes[0])}`));
    drawPlot(this.plot, {
      times: points.map(([x]) => x), lines: [[axes[1], points.map(([, y]) => y)]], begin: 0, end,
      labels: [`${words(axes[1])}, ${words(axes[0])} 0`, String(Math.round(end))],
    });
  }

  buttons(job) {
    if (job.state !== "running") return [];
    const open = job.facts.url
      ? h("a", { class: "button primary", href: this.ui.runAddress(job.facts.url), target: "_blank" }, "Open the robot's page") : null;
    const end = h("button", {
      class: "danger", disabled: !this.ui.drives,
      onclick: () => this.ui.attempt(() => this.ui.post("jobs/cancel", { number: job.number })),
    }, job.cancelling ? "End it at once" : RUNS.includes(job.kind) ? "Stop the run" : "Cancel");
    return [open, end].filter(Boolean);
  }
}

// Why a job failed: its own error, or else its error lines, or its last lines.
function failure(job) {
  if (job.facts.error) return [problem(told(job.facts.error))];
  if (job.exit_code < 0) return [problem(`It was killed by signal ${-job.exit_code}. Its last lines are in its output.`)];
  const errors = job.lines.filter((line) => line.startsWith("error: "));
  if (!errors.length && job.facts.problems?.length) return []; // they are the result, and are shown
  const text = errors.length ? errors.map((line) => line.slice("error: ".length)) : job.lines.slice(-8);
  return [problem(told([`exit code ${job.exit_code}`, ...text].join("\n")))];
}

// The cards of the jobs of some kinds, or of all, newest first; `none` stands there before the first.
export class JobList {
  constructor(ui, none, ...kinds) {
    Object.assign(this, { ui, kinds });
    this.cards = new Map();
    this.element = h("div", { class: "columns" }, h("p", { class: "note" }, none));
  }

  shows({ kind }) { return !this.kinds.length || this.kinds.includes(kind); }

  // Shows all jobs of the kinds.
  show() { for (const job of this.ui.jobs.values()) this.update(job); }

  // Scrolls a job that was just started into view and gives its card the focus, which the button lost.
  reveal(started, button) {
    setTimeout(() => { // once its card is there
      const { element } = this.cards.get(started?.number) ?? {};
      element?.scrollIntoView({ block: "nearest" });
      regain(element ?? button);
    }, REVEAL_MS);
  }

  // Shows a job if it is of the kinds; returns its card then.
  update(job) {
    if (!this.shows(job)) return null;
    if (!this.cards.has(job.number)) this.cards.set(job.number, new JobCard(this.ui));
    const card = this.cards.get(job.number);
    card.update(job);
    const numbers = [...this.ui.jobs.keys()].filter((number) => this.cards.has(number)).reverse();
    refresh(this.element, numbers, () => numbers.map((number) => this.cards.get(number).element));
    return card;
  }
}
