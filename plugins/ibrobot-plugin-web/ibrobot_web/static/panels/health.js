// Rates, counters, temperatures and voltages: all groups of /diagnostics, and the panels of plugins.

import { h, refresh } from "../dom.js";

export class HealthPanel {
  id = "health";
  title = "Health";

  constructor(page) { this.page = page; }

  mount(element) {
    this.panels = h("div", { class: "groups" });
    this.groups = h("div", { class: "groups" });
    element.append(this.panels, this.groups);
  }

  show(shown) { this.shown = shown; if (shown && this.page.status) this.update(this.page.status); }

  update({ counts, panels }) {
    if (!this.shown) return;
    refresh(this.panels, panels ?? [], () => (panels ?? []).map(({ title, columns, rows }) => h("table", {}, h("caption", {}, title),
      h("thead", {}, h("tr", {}, columns.map((name) => h("th", { scope: "col" }, name)))),
      h("tbody", {}, rows.map((row) => h("tr", {}, row.map((cell, i) => (i ? h("td", {}, cell) : h("th", { scope: "row" }, cell)))))))));
    const groups = Object.entries(counts).filter(([, values]) => Object.keys(values).length);
    refresh(this.groups, groups, () => groups.map(([group, values]) => h("table", {}, h("caption", {}, group),
      h("tbody", {}, Object.entries(values).map(([key, value]) => h("tr", {}, h("th", { scope: "row" }, key),
        h("td", {}, typeof value === "object" ? JSON.stringify(value) : String(value))))))));
  }
}
