// View: devices. The guides of plugins: ports, cameras, motors, calibration, step by step.

import { h, problem, refresh, say, table } from "../dom.js";
import { words } from "../words.js";

const POLL_MS = 150;

export class View {
  constructor(ui) {
    this.ui = ui;
    this.items = [];
    this.number = 0;
  }

  mount(element) {
    this.list = h("div", { class: "columns guides" });
    this.title = h("h3", {});
    this.state = h("span", { class: "state", role: "status" });
    this.steps = h("ol", { class: "list steps", "aria-live": "polite" });
    this.ask = h("div", { class: "ask" });
    this.cancel = h("button", { onclick: () => this.post("cancel") }, "Cancel");
    this.work = h("section", { class: "card", "aria-label": "Steps of the guide", hidden: true },
      h("div", { class: "row" }, this.title, this.state), this.steps, this.ask, h("div", { class: "row" }, this.cancel));
    element.append(h("h2", {}, "Devices"), this.work, this.list);
  }

  show(shown) {
    this.shown = shown;
    if (!shown) return;
    this.load();
    this.poll();
  }

  async load() {
    const { guides, install } = await this.ui.attempt(() => this.ui.get("devices/list")) ?? {};
    if (guides?.length === 0) {
      this.list.replaceChildren(h("p", { class: "note" }, `No installed plugin has a device to set up. To install those of ibrobot: ${install}`));
    } else if (guides) {
      refresh(this.list, [guides, this.ui.drives], () => guides.map((guide) => this.card(guide)));
    }
  }

  card(guide) {
    const fields = guide.questions.map((question) => field(guide.name, question));
    const form = h("form", { class: "card" }, h("h3", {}, guide.title), h("p", { class: "note" }, guide.summary),
      fields.length ? h("div", { class: "fields" }, fields.flatMap(({ elements }) => elements)) : null,
      h("div", { class: "row" }, h("button", { disabled: !this.ui.drives, "aria-label": `${guide.title}: start` }, "Start")));
    form.addEventListener("submit", async (event) => {
      event.preventDefault();
      const answers = Object.fromEntries(fields.map(({ name, value }) => [name, value()]));
      if (await this.ui.attempt(() => this.ui.post("devices/start", { name: guide.name, answers }).then(() => true))) {
        await this.poll();
        this.work.scrollIntoView({ block: "start" });
      }
    });
    return form;
  }

  post(what, facts = {}) {
    return this.ui.attempt(() => this.ui.post(`devices/${what}`, { number: this.number, ...facts }));
  }

  // Shows what the guide shows, and asks what it asks, while it runs and the view is shown.
  async poll() {
    clearTimeout(this.timer);
    if (!this.shown) return;
    const asked = this.asked = Symbol("poll");
    let found;
    try {
      found = await this.ui.get("devices/state", { after: this.items.length });
    } catch {
      found = null;
    }
    if (asked !== this.asked) return; // a later poll asked for the same items
    if (!found) {
      this.timer = setTimeout(() => this.poll(), 1000);
      return;
    }
    if (found.number !== this.number) {
      const known = this.items.length;
      this.number = found.number;
      this.items = [];
      this.steps.replaceChildren();
      if (known) { this.poll(); return; }
    }
    this.update(found);
    if (found.state === "running") this.timer = setTimeout(() => this.poll(), POLL_MS);
  }

  update({ state, title, error, items, ask }) {
    this.work.hidden = state === "none";
    if (state === "none") return;
    say(this.title, title);
    say(this.state, { running: ask ? "it is your turn" : "working …", done: "done", failed: "ended" }[state]);
    this.state.className = `state ${state}`;
    this.items.push(...items);
    this.steps.append(...items.map((item) => h("li", {}, this.item(item))));
    if (error && !this.steps.querySelector(".problem")) this.steps.append(h("li", {}, problem(error)));
    this.cancel.hidden = state !== "running";
    this.cancel.disabled = !this.ui.drives;
    refresh(this.ask, ask ? [ask.ask, ask.text] : null, () => (ask ? this.question(ask) : []));
    if (ask?.rows) refresh(this.live, ask.rows, () => tableOf(ask));
    if (ask?.sight && this.sight.complete) {
      this.sight.hidden = false;
      this.sight.src = this.ui.address("devices/sight", { sight: ask.sight, n: this.number });
    }
  }

  question({ ask, kind, text }) {
    const button = (label, ok, primary) => h("button", {
      class: primary ? "primary" : "", disabled: !this.ui.drives,
      onclick: async () => { await this.post("answer", { ask, ok }); this.poll(); },
    }, label);
    this.live = h("div", { class: "scroll" });
    this.sight = h("img", { class: "sight", alt: "What the camera sees", hidden: true });
    return [h("p", { class: "request", role: "alert" }, text), this.live, this.sight,
      h("div", { class: "row" }, ...(kind === "confirm" ? [button("Yes", true, true), button("No", false)] : [button("Done", true, true)]))];
  }

  item(item) {
    if (item.kind === "picture") {
      return h("figure", {}, h("img", { src: this.ui.address("devices/picture", { picture: item.picture, n: this.number }), alt: `Picture of ${item.title}` }),
        h("figcaption", {}, item.title));
    }
    if (item.kind === "show") return h("div", { class: "scroll" }, tableOf(item));
    if (item.kind === "answered") return [h("p", { class: "note" }, `${item.text} — ${item.answer}`), item.rows ? h("div", { class: "scroll" }, tableOf(item)) : null];
    return h("p", { class: item.warning ? "warned" : "" }, item.text);
  }
}

// A question of the form: its elements, and a function that returns its answer.
function field(guide, { name, text, default: preset, choices, open }) {
  const id = `${guide}-${name}`;
  const label = h("label", { for: id }, text);
  if (typeof preset === "boolean") {
    const box = h("input", { type: "checkbox", id, checked: preset });
    return { name, elements: [label, box], value: () => box.checked };
  }
  if (choices.length && !open) {
    const select = h("select", { id }, choices.map((choice) => h("option", { selected: choice === preset }, choice)));
    return { name, elements: [label, select], value: () => select.value };
  }
  const input = h("input", { type: "text", id, value: preset });
  if (!choices.length) return { name, elements: [label, h("span", {}, input)], value: () => input.value };
  // What was found, or else what is typed.
  const other = choices.includes(preset) ? "" : preset;
  const select = h("select", { id }, choices.map((choice) => h("option", { value: choice, selected: choice === preset }, choice)),
    other ? h("option", { value: other }, `${other} (not found)`) : null, h("option", { value: "" }, "another …"));
  input.id = `${id}-other`;
  input.hidden = true;
  input.setAttribute("aria-label", words(`${text}, another`));
  select.addEventListener("change", () => { input.hidden = select.value !== ""; if (!input.hidden) { input.value = ""; input.focus(); } });
  return { name, elements: [label, h("span", {}, select, input)], value: () => select.value || input.value };
}

// A table; the names of columns with numbers begin with `>`.
function tableOf({ columns, rows }) {
  const number = columns.map((name) => name.startsWith(">"));
  return table(columns.map((name) => name.replace(/^>/, "")),
    rows.map((cells) => h("tr", {}, cells.map((cell, i) => h("td", { class: number[i] ? "number" : "" }, cell)))));
}
