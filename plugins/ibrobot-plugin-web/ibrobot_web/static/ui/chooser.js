// The choice of a robot, its body and its mode, with what `ibrobot config check` says. Views share the choice.

import { h, refresh, row, say, table } from "../dom.js";
import { words } from "../words.js";

const SOURCES = { folder: "In the opened folders", ibrobot: "Shipped with ibrobot", plugin: "Shipped with plugins" };
const KEY = "robot";
const choice = { robot: "", sim: true, mode: "", ...JSON.parse(sessionStorage.getItem(KEY) ?? "{}") };

// Chooses for all views.
export function remember(facts) {
  Object.assign(choice, facts);
  sessionStorage.setItem(KEY, JSON.stringify(choice));
}

export class Chooser {
  // `changed` is called with what was found about the choice: {problems, modes, …}, or null while it is checked.
  constructor(ui, changed) {
    this.ui = ui;
    this.changed = changed;
    this.found = null;
    this.asked = 0;
    this.robot = h("select", { id: `robot-${Math.random()}` });
    this.robot.addEventListener("change", () => this.choose({ robot: this.robot.value, mode: "" }));
    this.body = h("div", { class: "row", role: "radiogroup", "aria-label": "Body" });
    this.mode = h("select", { id: `mode-${Math.random()}` });
    this.mode.addEventListener("change", () => this.choose({ mode: this.mode.value }));
    this.summary = h("p", { class: "note" });
    this.warning = h("p", { class: "warned", role: "status" });
    this.report = h("div", { "aria-live": "polite" });
    this.fields = h("div", { class: "fields" },
      h("label", { for: this.robot.id }, "Robot"), this.robot, h("span", {}), this.summary,
      h("span", { class: "label" }, "Body"), this.body, h("label", { for: this.mode.id }, "Mode"), this.mode,
      h("span", {}), this.warning);
    const name = `body-${Math.random()}`;
    for (const [value, label] of [[true, "Simulation"], [false, "Real hardware"]]) {
      const radio = h("input", { type: "radio", name });
      radio.addEventListener("change", () => this.choose({ sim: value, mode: "" }));
      radio.dataset.sim = value;
      this.body.append(h("label", {}, radio, ` ${label}`));
    }
  }

  get request() { return { robot: choice.robot, sim: choice.sim, mode: choice.mode }; }
  get ready() { return Boolean(this.found && !this.found.problems.length && choice.mode); }

  choose(facts) {
    remember(facts);
    this.found = null;
    this.changed(null);
    this.check();
  }

  // Lists the robots, and checks the chosen one again, since files change.
  async load() {
    this.robots = await this.ui.attempt(() => this.ui.get("robots/list")) ?? [];
    const names = this.robots.map(({ robot }) => robot);
    const own = this.robots.find(({ source }) => source === "folder")?.robot;
    if (!names.includes(choice.robot)) Object.assign(choice, { robot: own ?? (names.includes("so101") ? "so101" : names[0] ?? ""), mode: "" });
    refresh(this.robot, this.robots, () => Object.entries(SOURCES).map(([source, label]) => {
      const mine = this.robots.filter((each) => each.source === source);
      return mine.length ? h("optgroup", { label }, mine.map(({ robot }) => h("option", { value: robot }, robot))) : null;
    }).filter(Boolean));
    await this.check();
  }

  async check() {
    const asked = ++this.asked;
    this.robot.value = choice.robot;
    for (const radio of this.body.querySelectorAll("input")) radio.checked = radio.dataset.sim === String(choice.sim);
    say(this.summary, this.robots?.find(({ robot }) => robot === choice.robot)?.summary ?? "");
    if (!choice.robot) return;
    let found;
    try {
      found = await this.ui.get("robots/check", { robot: choice.robot, sim: choice.sim });
    } catch (error) {
      found = { problems: [{ file: choice.robot, line: 0, path: "", message: error.message }] };
    }
    if (asked !== this.asked) return; // another choice meanwhile
    this.found = found;
    if (found.modes && !found.modes.some(({ name, unavailable }) => name === choice.mode && !unavailable)) {
      choice.mode = found.modes.some(({ name, unavailable }) => name === found.mode && !unavailable) ? found.mode : "";
    }
    refresh(this.mode, [choice.robot, found.modes ?? []], () => (found.modes ?? []).map(({ name, label, unavailable }) =>
      h("option", { value: name, disabled: Boolean(unavailable), title: unavailable || name }, unavailable ? `${label}: ${unavailable}` : label)));
    this.mode.value = choice.mode;
    this.mode.disabled = !found.modes;
    const chosen = found.modes?.find(({ name }) => name === choice.mode);
    this.warning.textContent = [chosen?.policy && "The robot moves by itself as soon as the run has started, until you stop it.",
      chosen && !choice.sim && "Real hardware moves. Keep a hand at the power switch."].filter(Boolean).map(words).join(" ");
    refresh(this.report, found, () => reportOf(found));
    this.changed(found);
  }
}

// The problems of a robot YAML in the words of `ibrobot config check`, or what it has.
function reportOf(found) {
  if (found.problems.length) {
    const count = found.problems.length;
    return [h("h3", {}, `${count} problem${count === 1 ? "" : "s"} in this YAML`),
      ...found.problems.map(({ file, line, path, message }) => h("div", { class: "problem" },
        h("code", { class: "where" }, `${file}${line ? `:${line}` : ""}: ${path ? `${path}: ` : ""}`), message))];
  }
  const rows = [["Joints", found.joints.join(", ")], ["Cameras", found.cameras.join(", ") || "none"],
    ...Object.entries(found.devices)];
  return [h("p", { class: "good" }, "No problems found."),
    table(null, rows.map((cells) => row(cells))),
    ...found.notes.map((note) => h("p", { class: "note" }, `Note: ${note}`))];
}
