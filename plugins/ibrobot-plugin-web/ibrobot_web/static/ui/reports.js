// View: reports of one kind on folders with results, e.g. evaluations, and the recordings that they name.

import { h, problem, refresh, replace, row, say, scroll, table, toast, when } from "../dom.js";
import { words } from "../words.js";
import { Player } from "./player.js";

const SVG = "http://www.w3.org/2000/svg";
const SHAPES = new Set(["svg", "g", "title", "text", "line", "rect", "circle", "path", "polygon", "polyline"]);
const ATTRIBUTES = ["viewBox", "role", "x", "y", "x1", "y1", "x2", "y2", "cx", "cy", "r", "d", "points", "width", "height", "class", "text-anchor"];

export class View {
  constructor(ui, { name, title, report, within }) {
    this.ui = ui;
    this.within = within; // the view of the command that makes them
    this.name = name;
    this.title = title;
    this.kind = report;
    this.mended = new Map(); // report and case -> what a click did to its recording, and how to undo that
  }

  mount(element) {
    this.note = h("p", { class: "note", role: "status" });
    this.list = scroll(this.title);
    this.player = new Player(this.ui);
    this.mending = h("div", { class: "row" });
    this.playing = h("section", { class: "card", hidden: true, "aria-label": "Recording" },
      h("div", { class: "row" }, this.recording = h("h3", { tabindex: "-1" }), h("button", { onclick: () => this.play("") }, "Close")),
      this.reason = h("div", {}), this.problem = h("div", {}), this.player.element, this.mending);
    this.head = h("h2", { tabindex: "-1" });
    this.body = h("div", {});
    this.detail = h("section", { class: "card report", hidden: true, "aria-label": "Report" },
      h("div", { class: "row" }, this.head, h("button", { onclick: () => { location.hash = this.name; } }, "Close")), this.body);
    element.append(h("section", { class: "card" }, h("h2", {}, this.title), this.note, this.list), this.playing, this.detail);
  }

  async show(shown, rest) {
    this.shown = shown;
    if (!shown) { this.player.pause(); return; }
    await this.load();
    await this.open(rest);
  }

  job(job) {
    if (!this.shown || job.state === "running" || !(job.facts.made ?? []).some(({ kind }) => kind === this.kind)) return;
    this.load();
    if (this.path) this.open(this.path);
  }

  async load() {
    const found = await this.ui.attempt(() => this.ui.get("reports/list", { kind: this.kind }));
    if (!found) return;
    const maker = this.ui.session.views.find(({ name }) => name === this.within);
    this.note.replaceChildren(...(found.length ? [] : [h("span", {}, "None in the opened folders. "),
      ...(maker ? [h("a", { href: `#${maker.name}` }, maker.title)] : [])]));
    refresh(this.list, [found, this.path], () => (found.length
      ? [table(["Folder", "Result", "Changed"], found.map((each) => this.row(each)))] : []));
  }

  row({ path, lines, problem: why, changed_s: at }) {
    return row([h("a", { href: `#${this.name}/${encodeURIComponent(path)}` }, path),
      h("td", { class: why ? "bad text" : "text" }, why || lines.map((line) => h("div", {}, line))), when(at)],
    { class: path === this.path ? "current" : "" });
  }

  async open(path) {
    if (path !== this.path) {
      this.from = null;
      this.play("");
    }
    this.path = path;
    this.detail.hidden = !path;
    for (const each of this.list.querySelectorAll("tr")) each.classList.toggle("current", each.querySelector("a")?.textContent === path);
    if (!path) return;
    if (this.head.textContent !== path) refresh(this.body, "opens", () => [h("p", { class: "note" }, "Opening …")]);
    say(this.head, path);
    let sections;
    try {
      sections = await this.ui.get("reports/show", { kind: this.kind, path });
    } catch (error) {
      if (this.path === path) refresh(this.body, error.message, () => [problem(error.message)]);
      return;
    }
    if (this.path !== path) return; // another one was opened meanwhile
    this.sections = sections;
    this.draw();
  }

  draw() {
    refresh(this.body, [this.sections, [...this.mended], this.ui.drives], () => this.sections.map(({ title, blocks }, i) => (
      h("section", { "aria-label": numbered(title) }, i ? h("h3", {}, numbered(title)) : null, blocks.map((block) => this.block(block, title))))));
  }

  block(block, section) {
    switch (block.kind) {
      case "text": return block.role === "title" ? h("h4", {}, block.text) : h("p", { class: block.role }, block.text);
      case "table": return scroll(`${section}: table`, table(block.columns, block.rows.map(([first, ...cells]) => (
        row([first, ...cells.map((cell) => h("td", { class: cell.length > 40 ? "text" : "" }, cell))])))));
      case "plots": return block.pictures.length > 1
        ? h("div", { class: "plotted several" }, block.pictures.map(picture))
        : scroll(`${section}: plot`, h("div", { class: "plotted" }, block.pictures.map(picture)));
      case "cases": return h("div", { class: "columns cases" }, block.cases.map((each) => this.case(each)));
      default: return null;
    }
  }

  case(each) {
    const { title, text, episode, video, picture: shown, command, at_s: at } = each;
    return h("article", { class: "case" }, h("h4", {}, title),
      video ? h("video", { src: `${this.ui.address("reports/video", { path: video })}#t=0.01`, controls: true, muted: true, preload: "metadata", "aria-label": `Video of ${title}` }) : null,
      shown ? h("img", { src: this.ui.address("reports/picture", { path: shown }), alt: title }) : null,
      paragraphs(text),
      episode ? h("p", {}, h("a", { href: `#episodes/${encodeURIComponent(episode)}` }, episode)) : null,
      command ? h("code", {}, command) : null,
      h("div", { class: "row" },
        episode ? h("button", { "aria-label": `Play the recording of ${title}`, onclick: (event) => this.play(episode, title, event.target, at, each) }, "Play the recording") : null,
        command ? h("button", { "aria-label": `Copy the command of ${title}`, onclick: () => copy(command) }, "Copy the command") : null,
        this.fixes(each)));
  }

  // Buttons that mend a recording, or what was done and a button that undoes it.
  fixes({ title, episode, fixes }) {
    const done = this.mended.get(this.keyOf(title));
    if (done) {
      return [h("span", { class: "note", role: "status" }, done.label),
        h("button", { disabled: !this.ui.drives, "aria-label": `Undo what was done to ${title}`, onclick: () => this.undo(title) }, "Undo")];
    }
    return episode ? fixes.map((fix) => h("button", {
      class: fix.does === "delete" ? "danger" : "", disabled: !this.ui.drives, "aria-label": `${words(fix.label)}: ${title}`,
      onclick: () => this.mend(title, episode, fix),
    }, fix.label)) : [];
  }

  keyOf(title) { return `${this.path}: ${title}`; }

  async mend(title, path, { label, does, outcome, begin_s, end_s }) {
    const folder = path.includes("/") ? path.slice(0, path.lastIndexOf("/")) : ".";
    const before = does === "delete" ? {} : await this.ui.attempt(() => this.ui.get("episodes/open", { path }));
    if (!before) return;
    const answer = await this.ui.attempt(async () => {
      if (does === "delete") return this.ui.post("episodes/delete", { paths: [path] });
      if (does === "trim") await this.ui.post("episodes/trim", { path, begin_s, end_s: Math.min(end_s, before.duration_s) });
      return does === "trim" && !outcome ? null : this.ui.post("episodes/mark", { paths: [path], outcome });
    });
    if (answer === undefined) return;
    this.mended.set(this.keyOf(title), { label, does, path, folder, outcome: before.outcome });
    if (does === "delete" && this.player.path === path) this.player.close();
    if (does === "trim") this.again(path);
    this.draw();
    this.drawMending();
  }

  // Opens the recording in the player again, since it has changed.
  again(path) {
    if (!this.playing.hidden && this.played?.episode === path) this.player.open(path, this.problem);
  }

  // Puts the original back, or judges as before.
  async undo(title) {
    const { does, path, folder, outcome } = this.mended.get(this.keyOf(title));
    const answer = await this.ui.attempt(async () => {
      if (does === "mark") return this.ui.post("episodes/mark", { paths: [path], outcome });
      const trashed = await this.ui.get("episodes/trash", { path: folder });
      const original = trashed.find((each) => each.path === path);
      if (!original) throw new Error(`${path}: the trash has no original`);
      return this.ui.post("episodes/restore", { path: folder, id: original.id });
    });
    if (answer === undefined) return;
    this.mended.delete(this.keyOf(title));
    if (does !== "mark") this.again(path);
    this.draw();
    this.drawMending();
  }

  // The same buttons beside the player.
  drawMending() {
    replace(this.mending, ...(this.played ? this.fixes(this.played) : []));
  }

  // Plays a recording until it is closed, which leads back to where it was opened, with the focus.
  async play(path, title = "", from = null, at = 0, played = null) {
    this.playing.hidden = !path;
    this.played = played;
    this.drawMending();
    const opener = this.from;
    this.from = from;
    if (!path) {
      this.player.close();
      const label = opener?.getAttribute("aria-label"); // what was mended meanwhile has new buttons
      const back = label && [...this.body.querySelectorAll("button")].find((each) => each.getAttribute("aria-label") === label);
      back?.scrollIntoView({ block: "center" });
      back?.focus({ preventScroll: true });
      return;
    }
    say(this.recording, title);
    replace(this.reason, paragraphs(played?.text ?? ""));
    this.problem.replaceChildren();
    if (await this.player.open(path, this.problem)) {
      if (at > 0) this.player.seek(Math.min(at, this.player.length));
      this.player.toggle();
    }
    this.playing.scrollIntoView({ block: "start" });
    this.recording.focus({ preventScroll: true });
  }
}

// A heading with a number, in the language of the browser.
const numbered = (title) => title.replace(/^(\d+\. )(.+)$/, (_, number, text) => number + words(text));

const paragraphs = (text) => text.split("\n").filter(Boolean).map((line) => h("p", {}, line));

async function copy(text) {
  try {
    await navigator.clipboard.writeText(text);
    toast("The command is copied.");
  } catch {
    toast("The browser does not allow copying; select the command instead.", "error");
  }
}

// A plot: shapes and texts of an SVG, and nothing else that it may contain.
function picture(text) {
  const made = shape(new DOMParser().parseFromString(text, "image/svg+xml").documentElement);
  const width = made?.getAttribute("viewBox")?.split(" ")[2];
  if (width) Object.assign(made.style, { maxWidth: `${Number(width)}px`, minWidth: `${0.8 * width}px` }); // smaller texts cannot be read
  return made;
}

function shape(element) {
  if (!SHAPES.has(element.localName)) return null;
  const made = document.createElementNS(SVG, element.localName);
  for (const name of ATTRIBUTES) if (element.hasAttribute(name)) made.setAttribute(name, element.getAttribute(name));
  for (const child of element.childNodes) {
    const part = child.nodeType === Node.TEXT_NODE ? child.data : child.nodeType === Node.ELEMENT_NODE ? shape(child) : null;
    if (part !== null) made.append(part);
  }
  return made;
}
