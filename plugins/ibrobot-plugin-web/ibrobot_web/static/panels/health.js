// Rates, counters, temperatures and voltages: all groups of /diagnostics, and the panels of plugins.

import { h, refresh, row, table } from "../dom.js";

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
    refresh(this.panels, panels, () => panels.map(({ title, columns, rows }) => table(columns, rows.map((cells) => row(cells)), title)));
    const groups = Object.entries(counts).filter(([, values]) => Object.keys(values).length);
    refresh(this.groups, groups, () => groups.map(([group, values]) => table(null, Object.entries(values).map(
      ([key, value]) => row([key, typeof value === "object" ? JSON.stringify(value) : String(value)])), group)));
  }
}

function topics({ rates_hz: rates, silent, lost }) {
  return table(["Topic", "Rate", "Lost"], Object.entries(rates).map(([topic, rate]) => (
    row([topic, `${rate.toFixed(1)} Hz`, lost[topic] ?? 0], { class: silent.includes(topic) ? "bad" : "" }))), "Recorded topics");
}
