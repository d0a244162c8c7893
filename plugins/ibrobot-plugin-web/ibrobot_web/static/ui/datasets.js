// View: datasets: counts, features, statistics, and their episodes, which are played back.

import { h, refresh, row, say, scroll, table, toast } from "../dom.js";
import { size } from "./episodes.js";
import { keyed, press } from "./keys.js";
import { Player } from "./player.js";

export class View {
  constructor(ui) { this.ui = ui; }

  mount(element) {
    this.choice = h("select", { id: "dataset" });
    this.choice.addEventListener("change", () => { location.hash = `datasets/${encodeURIComponent(this.choice.value)}`; });
    this.note = h("p", { class: "note", role: "status" });
    this.facts = h("section", { "aria-label": "Dataset" });
    this.player = new Player(this.ui);
    this.title = h("h3", {});
    this.problem = h("div", {});
    this.playing = h("section", { class: "card", hidden: true, "aria-label": "Episode" }, h("div", { class: "row" }, this.title,
      keyed("Previous", "p", () => this.go(-1)), keyed("Next", "n", () => this.go(1)),
      h("button", { onclick: () => this.play(null) }, "Close")), this.problem, this.player.element);
    document.addEventListener("keydown", (event) => { if (this.shown && !this.playing.hidden) press(event, this.playing, this.player); });
    this.choices = h("div", { class: "row" }, h("label", { for: "dataset" }, "Dataset"), this.choice);
    element.append(h("h2", {}, "Datasets"), this.choices, this.note, this.playing, this.facts);
  }

  // Plays the next or the previous episode.
  go(by) {
    const next = this.number + by;
    if (next >= 0 && next < this.count) this.play(next);
    else toast(by > 0 ? "This is the last episode." : "This is the first episode.");
  }

  async show(shown, rest) {
    this.shown = shown;
    if (!shown) { this.player.pause(); return; }
    const found = await this.ui.attempt(() => this.ui.get("datasets/list"));
    if (!found) return;
    const chosen = rest || this.path || found[0];
    refresh(this.choice, [found, chosen], () => found.map((path) => h("option", { value: path, selected: path === chosen }, path)));
    this.choices.hidden = !found.length;
    this.note.replaceChildren(...(found.length ? [] : [h("span", {}, "No datasets in the opened folders. "), h("a", { href: "#job-convert" }, "Convert episodes into one"), "."]));
    if (chosen && found.includes(chosen)) await this.open(chosen);
    else if (rest) say(this.note, `${rest}: there is no such dataset in the opened folders`);
  }

  async open(path) {
    if (this.path !== path) this.play(null);
    this.path = path;
    say(this.note, "Reading …");
    const facts = await this.ui.attempt(() => this.ui.get("datasets/info", { path }));
    if (this.path !== path) return;
    say(this.note, "");
    refresh(this.facts, facts ?? path, () => (facts ? this.tables(facts) : []));
  }

  tables(facts) {
    this.count = facts.episodes;
    const counts = [["Episodes", facts.episodes], ["Frames", facts.frames], ["Rate", `${facts.fps} Hz`],
      ["Length", `${facts.seconds.toFixed(1)} s`], ["Size", size(facts.bytes)], ["Robot", facts.robot_type || "not given"],
      ["Tasks", facts.tasks.join("; ") || "none"], ["Unit of joints", facts.norm_mode || "not given"]];
    return [h("div", { class: "columns" },
      h("div", { class: "card" }, h("h3", {}, "Contents"), table(null, counts.map((cells) => row(cells)))),
      h("div", { class: "card" }, h("h3", {}, "Episodes"), scroll("Episodes",
        table(["Episode", "Length", "Frames", "Outcome", "Task", "Source"], facts.list.map((each) => row([
          h("button", { onclick: () => this.play(each.number) }, `Play ${each.number}`), `${each.seconds.toFixed(1)} s`, each.frames,
          each.outcome, h("td", { class: each.task.length > 30 ? "text" : "" }, each.task), each.source])))))),
    h("div", { class: "card" }, h("h3", {}, "Features"), scroll("Features",
      table(["Feature", "Type", "Shape", "Unit", "Value", "Minimum", "Mean", "Maximum", "Deviation"], facts.features.flatMap(rows))))];
  }

  async play(number) {
    this.number = number;
    this.playing.hidden = number === null;
    if (number === null) { this.player.close(); return; }
    say(this.title, `${this.path}, episode ${number}`);
    this.problem.replaceChildren();
    if (await this.player.open(`${this.path}:${number}`, this.problem)) this.player.toggle();
    this.playing.scrollIntoView({ block: "nearest" });
  }
}

// One row for each value of a feature; pictures have one for each colour. Below one another they say once whose they are.
function rows({ key, dtype, shape, unit, names, stats, picture }) {
  const count = stats.mean?.length ?? 1;
  const colors = ["red", "green", "blue"];
  return Array.from({ length: count }, (_, i) => row([
    h("th", { scope: "row", class: i ? "same" : "" }, key), ...(i ? ["", "", ""] : [dtype, shape.join(" × "), unit]),
    picture && count === 3 ? colors[i] : names[i] ?? (count > 1 ? String(i) : ""),
    ...["min", "mean", "max", "std"].map((name) => ((stats[name]?.[i] ?? null) === null ? "" : rounded(stats[name][i])))]));
}

// Four digits, of which at most four are decimals.
function rounded(value) { return Number(Math.abs(value) < 1 ? value.toFixed(4) : value.toPrecision(4)).toString().replace("-", "−"); }
