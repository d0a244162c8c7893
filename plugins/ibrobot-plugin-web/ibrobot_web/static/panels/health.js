// Rates, counters, temperatures and voltages: all groups of /diagnostics, and the panels of plugins.

import { h, refresh } from "../dom.js";

export class HealthPanel {
  id = "health";
  title = "Health";

  constructor(page) { this.page = page; }

  mount(element) {
    this.panels = h("div", { class: "groups" });
    this.groups = h("div", { class: "groups" });
    this.topics = h("div", { class: "groups" });
    element.append(this.topics, this.panels, this.groups);
  }

  show(shown) { this.shown = shown; if (shown && this.page.status) this.update(this.page.status); }

  update({ counts, panels, episode }) {
    if (!this.shown) return;
    const recorded = episode ? [episode.rates_hz, episode.silent, episode.lost] : null;
    refresh(this.topics, recorded, () => (recorded ? [topics(episode)] : []));
    refresh(this.panels, panels ?? [], () => (panels ?? []).map(({ title, columns, rows }) => h("table", {}, h("caption", {}, title),
      h("thead", {}, h("tr", {}, columns.map((name) => h("th", { scope: "col" }, name)))),
      h("tbody", {}, rows.map((row) => h("tr", {}, row.map((cell, i) => (i ? h("td", {}, cell) : h("th", { scope: "row" }, cell)))))))));
    const groups = Object.entries(counts).filter(([, values]) => Object.keys(values).length);
    refresh(this.groups, groups, () => groups.map(([group, values]) => h("table", {}, h("caption", {}, group),
      h("tbody", {}, Object.entries(values).map(([key, value]) => h("tr", {}, h("th", { scope: "row" }, key),
        h("td", {}, typeof value === "object" ? JSON.stringify(value) : String(value))))))));
  }
}

function topics({ rates_hz: rates, silent, lost }) {
  return h("table", {}, h("caption", {}, "Recorded topics"),
    h("thead", {}, h("tr", {}, ["Topic", "Rate", "Lost"].map((name) => h("th", { scope: "col" }, name)))),
    h("tbody", {}, Object.entries(rates).map(([topic, rate]) => h("tr", { class: silent.includes(topic) ? "bad" : "" },
      h("th", { scope: "row" }, topic), h("td", {}, `${rate.toFixed(1)} Hz`), h("td", {}, String(lost[topic] ?? 0))))));
}
