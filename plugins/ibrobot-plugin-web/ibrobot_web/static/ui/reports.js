// View: reports of one kind on folders with results, e.g. evaluations, and the recordings that they name.

import { h, problem, refresh, row, say, scroll, table, toast, when } from "../dom.js";
import { Player } from "./player.js";

const SVG = "http://www.w3.org/2000/svg";
const SHAPES = new Set(["svg", "g", "title", "text", "line", "rect", "circle", "path", "polygon", "polyline"]);
const ATTRIBUTES = ["viewBox", "role", "x", "y", "x1", "y1", "x2", "y2", "cx", "cy", "r", "d", "points", "width", "height", "class", "text-anchor"];

export class View {
  constructor(ui, { name, title, report }) {
    this.ui = ui;
    this.name = name;
    this.title = title;
    this.kind = report;
  }

  mount(element) {
    this.note = h("p", { class: "note", role: "status" });
    this.list = scroll(this.title);
    this.player = new Player(this.ui);
    this.playing = h("section", { class: "card", hidden: true, "aria-label": "Recording" },
      h("div", { class: "row" }, this.recording = h("h3", {}), h("button", { onclick: () => this.play("") }, "Close")),
      this.problem = h("div", {}), this.player.element);
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
    say(this.note, found.length ? "" : "None in the opened folders.");
    refresh(this.list, [found, this.path], () => (found.length
      ? [table(["Folder", "Result", "Changed"], found.map((each) => this.row(each)))] : []));
  }

  row({ path, lines, problem: why, changed_s: at }) {
    return row([h("a", { href: `#${this.name}/${encodeURIComponent(path)}` }, path),
      h("td", { class: why ? "bad text" : "text" }, why || lines.map((line) => h("div", {}, line))), when(at)],
    { class: path === this.path ? "current" : "" });
  }

  async open(path) {
    if (path !== this.path) this.play("");
    this.path = path;
    this.detail.hidden = !path;
    for (const each of this.list.querySelectorAll("tr")) each.classList.toggle("current", each.querySelector("a")?.textContent === path);
    if (!path) return;
    say(this.head, path);
    let sections;
    try {
      sections = await this.ui.get("reports/show", { kind: this.kind, path });
    } catch (error) {
      if (this.path === path) refresh(this.body, error.message, () => [problem(error.message)]);
      return;
    }
    if (this.path !== path) return; // another one was opened meanwhile
    refresh(this.body, sections, () => sections.map(({ title, blocks }, i) => (
      h("section", { "aria-label": title }, i ? h("h3", {}, title) : null, blocks.map((block) => this.block(block, title))))));
  }

  block(block, section) {
    switch (block.kind) {
      case "text": return block.role === "title" ? h("h4", {}, block.text) : h("p", { class: block.role }, block.text);
      case "table": return scroll(`${section}: table`, table(block.columns, block.rows.map(([first, ...cells]) => (
        row([first, ...cells.map((cell) => h("td", { class: cell.length > 40 ? "text" : "" }, cell))])))));
      case "plots": return h("div", { class: block.pictures.length > 1 ? "plotted several" : "plotted" }, block.pictures.map(picture));
      case "cases": return h("div", { class: "columns cases" }, block.cases.map((each) => this.case(each)));
      default: return null;
    }
  }

  case({ title, text, episode, video, command }) {
    return h("article", { class: "case" }, h("h4", {}, title),
      video ? h("video", { src: `${this.ui.address("reports/video", { path: video })}#t=0.01`, controls: true, muted: true, preload: "metadata", "aria-label": `Video of ${title}` }) : null,
      h("p", {}, text),
      episode ? h("p", {}, h("a", { href: `#episodes/${encodeURIComponent(episode)}` }, episode)) : null,
      command ? h("code", {}, command) : null,
      h("div", { class: "row" },
        episode ? h("button", { "aria-label": `Play the recording of ${title}`, onclick: (event) => this.play(episode, title, event.target) }, "Play the recording") : null,
        command ? h("button", { "aria-label": `Copy the command of ${title}`, onclick: () => copy(command) }, "Copy the command") : null));
  }

  // Plays a recording until it is closed, which leads back to where it was opened.
  async play(path, title = "", from = null) {
    this.playing.hidden = !path;
    const opener = this.from;
    this.from = from;
    if (!path) {
      this.player.close();
      opener?.scrollIntoView({ block: "center" });
      return;
    }
    say(this.recording, title);
    this.problem.replaceChildren();
    if (await this.player.open(path, this.problem)) this.player.toggle();
    this.playing.scrollIntoView({ block: "start" });
  }
}

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
  if (width) made.style.maxWidth = `${Number(width)}px`;
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
