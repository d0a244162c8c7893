// Panels that fold away: plots, health, log; and what ends the run.

import { confirm, h, refresh } from "./dom.js";

const KEY = "panel";

export class Dock {
  constructor(section, page, panels) {
    this.page = page;
    this.panels = panels;
    const content = section.querySelector("#panels");
    this.buttons = panels.map((panel, i) => {
      panel.element = h("div", { id: `panel-${panel.id}`, role: "region", "aria-label": panel.title, tabindex: "0", hidden: true });
      panel.mount(panel.element);
      content.append(panel.element);
      return h("button", { "aria-expanded": "false", "aria-controls": `panel-${panel.id}`, onclick: () => this.toggle(i) }, panel.title);
    });
    this.run = h("span", { class: "row end" });
    section.querySelector("#toggles").append(...this.buttons, this.run);
    const kept = panels.findIndex(({ id }) => id === localStorage.getItem(KEY));
    if (kept >= 0) this.toggle(kept);
  }

  // Shows one panel, or folds it away.
  toggle(chosen) {
    this.panels.forEach((panel, i) => {
      const shown = i === chosen && panel.element.hidden;
      panel.element.hidden = !shown;
      this.buttons[i].setAttribute("aria-expanded", String(shown));
      panel.show?.(shown);
      if (i === chosen) localStorage.setItem(KEY, shown ? panel.id : "");
    });
  }

  update(status) {
    const { page } = this;
    refresh(this.run, [page.operating, page.links], () => [
      page.links.watch ? h("button", { onclick: () => this.copy() }, "Copy link for watching") : null,
      h("button", { disabled: !page.operating, onclick: () => this.end() }, "End the run"),
    ].filter(Boolean));
    for (const panel of this.panels) panel.update?.(status);
  }

  samples(message) { for (const panel of this.panels) panel.samples?.(message); }

  async copy() {
    const link = location.origin + this.page.links.watch;
    try {
      await navigator.clipboard.writeText(link);
    } catch {
      window.prompt("Link for watching", link);
    }
  }

  async end() {
    const text = "The robot stops as its YAML says. This page then shows nothing new.";
    if (await confirm("End the run?", text, "End the run", { no: "Keep it running" })) this.page.drive.ask("finish");
  }
}
