// View: recorded episodes.

import { confirm, h, refresh, replace, row, say, scroll, table, toast, when } from "../dom.js";
import { RUNS } from "./job.js";
import { keyed, press } from "./keys.js";
import { Player } from "./player.js";

export class View {
  constructor(ui) {
    this.ui = ui;
    this.chosen = new Set();
    this.rows = [];
  }

  mount(element) {
    this.note = h("p", { class: "note", role: "status" });
    this.filter = h("input", { type: "text", id: "episode-filter", placeholder: "task, outcome, name" });
    this.filter.addEventListener("input", () => this.draw());
    this.bulk = h("div", { class: "row" });
    this.table = scroll("Episodes");
    this.trash = h("details", { class: "card", hidden: true });
    this.player = new Player(this.ui);
    this.title = h("h2", { tabindex: "-1" });
    this.about = h("div", {});
    this.controls = h("div", {});
    this.detail = h("section", { class: "card", hidden: true, "aria-label": "Episode" },
      h("div", { class: "row" }, this.title, keyed("Previous", "p", () => this.go(-1)), keyed("Next", "n", () => this.go(1)),
        h("button", { onclick: () => { location.hash = "episodes"; } }, "Close")),
      this.about, this.player.element, this.controls);
    document.addEventListener("keydown", (event) => { if (this.shown && this.path) press(event, this.detail, this.player); });
    element.append(this.detail, h("section", { class: "card" }, h("h2", {}, "Episodes"), this.note,
      h("div", { class: "row" }, h("label", { for: "episode-filter" }, "Filter"), this.filter,
        h("button", { onclick: () => this.load() }, "Refresh")), this.bulk, this.table), this.trash);
  }

  async show(shown, rest) {
    this.shown = shown;
    if (!shown) { this.player.pause(); return; }
    await this.load();
    const inside = this.rows.filter(({ path }) => path.startsWith(`${rest}/`)); // a folder: its first one, if possible not judged
    if (rest && inside.length) {
      location.replace(`#episodes/${encodeURIComponent((inside.find(({ outcome }) => outcome === "unknown") ?? inside[0]).path)}`);
    } else if (rest !== this.path) await this.open(rest);
  }

  // Goes to the next or the previous episode of the list.
  go(by) {
    const rows = this.shownRows();
    const next = rows[rows.findIndex(({ path }) => path === this.path) + by];
    if (next) location.hash = `episodes/${encodeURIComponent(next.path)}`;
    else toast(by > 0 ? "This is the last episode." : "This is the first episode.");
  }

  job(job) {
    if (this.shown && job.state !== "running" && RUNS.includes(job.kind)) this.load();
  }

  async load() {
    const found = await this.ui.attempt(() => this.ui.get("episodes/list"));
    if (!found) return;
    this.rows = found.episodes;
    this.outcomes = found.outcomes;
    const known = new Set(this.rows.map(({ path }) => path));
    for (const path of this.chosen) if (!known.has(path)) this.chosen.delete(path);
    this.note.replaceChildren(...(this.rows.length ? [] : [h("span", {}, "No episodes in the opened folders. "), h("a", { href: "#record" }, "Record some"), "."]));
    if (!found.complete) say(this.note, "There are too many folders to search. Open a smaller folder: ibrobot ui FOLDER");
    this.draw();
    this.trashes = found.trashes;
    this.loadTrash();
  }

  shownRows() {
    const words = this.filter.value.toLowerCase().split(/\s+/).filter(Boolean);
    return this.rows.filter((row) => {
      const text = `${row.path} ${row.task} ${row.outcome} ${row.robot} ${row.mode} ${row.problems.join(" ")}`.toLowerCase();
      return words.every((word) => text.includes(word));
    });
  }

  draw() {
    const rows = this.shownRows();
    const { drives } = this.ui;
    const troubled = rows.some(({ problems }) => problems.length);
    refresh(this.bulk, [[...this.chosen], drives, rows.length], () => this.bulkControls(rows));
    refresh(this.table, [rows, [...this.chosen], this.path], () => (rows.length ? [table(
      [this.box("Choose all", rows), "Episode", "Task", "Length", "Began", "Size", "Outcome", ...(troubled ? ["Problems"] : [])],
      rows.map((each) => this.row(each, troubled)))] : []));
  }

  // A box that chooses episodes.
  box(label, rows) {
    const box = h("input", { type: "checkbox", "aria-label": label });
    box.checked = rows.every(({ path }) => this.chosen.has(path));
    box.addEventListener("change", () => {
      for (const { path } of rows) this.chosen[box.checked ? "add" : "delete"](path);
      this.draw();
    });
    return box;
  }

  row(each, troubled) {
    const place = each.group === "." ? each.name : `${each.group}/${each.name}`;
    return row([h("td", {}, this.box(`Choose ${each.name} of ${each.group}`, [each])),
      h("th", { scope: "row" }, h("a", { href: `#episodes/${encodeURIComponent(each.path)}` }, place)),
      h("td", { class: each.task.length > 30 ? "text" : "" }, each.task || h("span", { class: "note" }, "none")),
      each.duration_s === null ? "" : `${each.duration_s.toFixed(1)} s`, began(each.began_s), size(each.bytes),
      h("td", { class: { success: "good", failure: "bad" }[each.outcome] ?? "" }, each.outcome),
      ...(troubled ? [h("td", { class: each.problems.length ? "bad text" : "" }, each.problems.join("; "))] : [])],
    { class: each.path === this.path ? "current" : "" });
  }

  bulkControls(rows) {
    const paths = rows.map(({ path }) => path).filter((path) => this.chosen.has(path));
    if (!rows.length) return [];
    if (!paths.length) return [h("p", { class: "note" }, `${rows.length} episode${rows.length === 1 ? "" : "s"}. Choose some to judge or delete them together.`)];
    const off = !this.ui.drives;
    return [h("span", {}, `${paths.length} chosen:`),
      ...this.outcomes.map(([outcome, text]) => h("button", { disabled: off, onclick: () => this.mark(paths, outcome) }, `Judge ${text}`)),
      h("button", { class: "danger", disabled: off, onclick: () => this.remove(paths) }, "Delete")];
  }

  async open(path) {
    if (path !== this.path) this.controls.replaceChildren(); // they act on the previous one
    this.path = path;
    this.draw();
    this.detail.hidden = !path;
    if (!path) { this.player.close(); return; }
    say(this.title, path);
    replace(this.about, h("p", { class: "note" }, "Opening …"));
    this.player.setCut(null);
    const facts = await this.player.open(path, this.about);
    if (this.path !== path) return;
    if (!facts) { this.controls.replaceChildren(); return; }
    const { metadata, topics } = facts;
    replace(this.about,
      h("p", {}, [metadata.robot, metadata.mode, facts.task && `“${facts.task}”`, facts.outcome, metadata.trimmed && `trimmed: ${metadata.trimmed}`]
        .filter(Boolean).join(" · ")),
      ...facts.problems.map((problem) => h("div", { class: "problem" }, problem)));
    this.drawControls(facts);
    this.controls.append(h("details", {}, h("summary", {}, `${topics.length} topics`), scroll("Topics",
      table(["Topic", "Type", "Messages", "Rate", "Lost"], topics.map((each) => row(
        [each.name, each.type, each.count, each.rate_hz === null ? "" : `${each.rate_hz} Hz`, each.lost || ""]))))));
  }

  drawControls(facts) {
    const off = !this.ui.drives, { path, player } = this;
    const cut = [0, facts.duration_s];
    const kept = h("output", {});
    const trim = h("button", { disabled: true, onclick: () => this.trim(path, cut) }, "Trim to this span");
    const show = () => {
      const whole = cut[0] === 0 && cut[1] === facts.duration_s;
      say(kept, `keep ${cut[0].toFixed(2)} to ${cut[1].toFixed(2)} s`);
      trim.disabled = off || whole || cut[1] - cut[0] < 0.01;
      player.setCut(whole ? null : cut);
    };
    const begin = h("button", { disabled: off, onclick: () => { cut[0] = Math.min(round(player.at), cut[1]); show(); } }, "Begin here");
    const end = h("button", { disabled: off, onclick: () => { cut[1] = Math.min(facts.duration_s, Math.max(round(player.at), cut[0])); show(); } }, "End here");
    const whole = h("button", { disabled: off, onclick: () => { cut[0] = 0; cut[1] = facts.duration_s; show(); } }, "Whole");
    show();
    replace(this.controls,
      h("div", { class: "row" }, h("span", {}, "Judge:"), this.outcomes.map(([outcome, text]) => h("button", {
        disabled: off || !facts.finished, "aria-pressed": String(facts.outcome === outcome), "data-key": outcome[0],
        onclick: () => this.mark([path], outcome),
      }, text, h("kbd", { "aria-hidden": "true" }, outcome[0].toUpperCase()))),
      facts.finished ? null : h("button", { class: "primary", disabled: off, onclick: () => this.repair(path) }, "Repair"),
      h("button", { class: "danger", disabled: off, onclick: () => this.remove([path]) }, "Delete")),
      h("div", { class: "row" }, h("span", {}, "Trim:"), begin, end, whole, kept, trim));
  }

  // Does something to episodes, and shows the new state.
  async change(act, done) {
    const answer = await this.ui.attempt(act);
    if (answer === undefined) return false;
    toast(done);
    await this.load();
    return true;
  }

  async mark(paths, outcome) {
    if (await this.change(() => this.ui.post("episodes/mark", { paths, outcome }), `${count(paths)}: ${outcome}`)
      && paths.includes(this.path)) await this.open(this.path);
  }

  async trim(path, [begin_s, end_s]) {
    const text = `Only ${begin_s.toFixed(2)} to ${end_s.toFixed(2)} s stay. The original goes to the trash, from which you can restore it.`;
    if (!await confirm("Trim the episode?", text, "Trim", { danger: false })) return;
    if (await this.change(() => this.ui.post("episodes/trim", { path, begin_s, end_s }), "Trimmed. The trash below has the original.")) await this.open(path);
  }

  async remove(paths) {
    if (!await this.change(() => this.ui.post("episodes/delete", { paths }), `${count(paths)} moved to the trash below`)) return;
    if (paths.includes(this.path)) location.hash = "episodes";
  }

  async repair(path) {
    if (await this.change(() => this.ui.post("episodes/repair", { path }), "Repaired")) await this.open(path);
  }

  async loadTrash() {
    const found = [];
    for (const path of this.trashes) found.push(...await this.ui.attempt(() => this.ui.get("episodes/trash", { path })) ?? []);
    this.trash.hidden = !found.length;
    refresh(this.trash, [found, this.ui.drives], () => [h("summary", {}, `Trash: ${found.length}, ${size(found.reduce((sum, each) => sum + each.size_bytes, 0))}`),
      scroll("Trash", table(["Episode", "What was done", "Size", h("span", { class: "hidden-label" }, "Restore")], found.map((each) => row(
        [each.path, each.what, size(each.size_bytes), h("button", {
          disabled: !this.ui.drives, "aria-label": `Restore ${each.path}`, onclick: () => this.restore(each),
        }, "Restore")])))),
      ...this.trashes.map((path) => h("button", { class: "danger", disabled: !this.ui.drives, onclick: () => this.empty(path) },
        `Empty the trash of ${path}`))]);
  }

  async restore({ folder, id, path }) {
    if (await this.change(() => this.ui.post("episodes/restore", { path: folder, id }), `${path}: restored`)
      && this.path === path) await this.open(path);
  }

  async empty(path) {
    const sure = await confirm("Empty the trash?", `What is in the trash of ${path} is deleted for good.`, "Delete for good");
    if (sure) await this.change(() => this.ui.post("episodes/empty", { path }), "The trash is empty.");
  }
}

const count = (paths) => (paths.length === 1 ? paths[0] : `${paths.length} episodes`);

// Lockstep runs have a clock of their own, which begins in 1970.
function began(seconds) {
  if (!seconds) return "";
  return seconds < 1e9 ? "simulated time" : when(seconds);
}

function round(seconds) { return Math.round(seconds * 1000) / 1000; }

export function size(bytes) {
  let number = bytes;
  for (const unit of ["B", "kB", "MB"]) {
    if (number < 1000) return `${unit === "B" ? number : number.toFixed(1)} ${unit}`;
    number /= 1000;
  }
  return `${number.toFixed(1)} GB`;
}
