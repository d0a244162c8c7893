// Plots of any numbers on any topic while this tab is shown, and of the run's counters, such as latencies, all the time.

import { h, refresh } from "../dom.js";
import { COLORS, drawPlot, kindOf, legendOf } from "../plot.js";

const SAMPLES = 2;
const KEPT_S = 180;

export class PlotsPanel {
  id = "plots";
  title = "Plots";

  constructor(page) {
    this.page = page;
    this.topics = new Map(); // topic -> {times, series: path -> values}
    this.topic = "/joint_states";
    this.kind = "position";
  }

  mount(element) {
    this.choice = h("select", { id: "plot-topic" });
    this.choice.addEventListener("change", () => { this.topic = this.choice.value; this.draw(); });
    this.kinds = h("select", { "aria-label": "Values", hidden: true });
    this.kinds.addEventListener("change", () => { this.kind = this.kinds.value; this.draw(); });
    this.canvas = h("canvas", { class: "plot", role: "img", "aria-label": "Plot of the chosen topic" });
    this.legend = h("p", { class: "legend" });
    this.latency = h("p", { class: "note" });
    element.append(h("div", { class: "row" }, h("label", { for: "plot-topic" }, "Topic"), this.choice, this.kinds), this.canvas,
      this.legend, this.latency);
    new ResizeObserver(() => this.draw()).observe(this.canvas);
  }

  show(shown) {
    this.shown = shown;
    this.page.stream.show(SAMPLES, shown);
    if (shown) this.draw();
  }

  samples({ stamp, topics }) {
    for (const [topic, values] of Object.entries(topics)) this.add(topic, stamp / 1e9, values);
    if (this.shown) this.draw();
  }

  add(topic, time, values) {
    if (!this.topics.has(topic)) this.topics.set(topic, { times: [], series: new Map() });
    const { times, series } = this.topics.get(topic);
    times.push(time);
    for (const [path, value] of Object.entries(values)) {
      if (!series.has(path)) series.set(path, new Array(times.length - 1).fill(null));
      series.get(path).push(value);
    }
    for (const kept of series.values()) if (kept.length < times.length) kept.push(null);
    while (times[0] < time - KEPT_S) {
      times.shift();
      for (const kept of series.values()) kept.shift();
    }
  }

  update(status) {
    const { dispatch, loop } = status.counts;
    this.latency.textContent = (dispatch ? `policy latency p50 ${Math.round(dispatch.latency_p50_ms)} ms, p99 ${Math.round(dispatch.latency_p99_ms)} ms, `
      + `plan ${dispatch.plan_length}, holds ${dispatch.holds} · ` : "")
      + (loop?.ticks ? `loop late p50 ${Math.round(loop.lateness_p50_us)} µs, p99 ${Math.round(loop.lateness_p99_us)} µs` : "");
    const now = (this.page.state?.stamp ?? 0) / 1e9;
    for (const [group, counts] of Object.entries(now ? status.counts : {})) {
      const values = Object.entries(counts).filter(([, value]) => typeof value === "number");
      if (values.length) this.add(`counters of ${group}`, now, Object.fromEntries(values));
    }
  }

  draw() {
    const known = [...this.topics.keys()].sort();
    refresh(this.choice, known, () => known.map((topic) => h("option", { selected: topic === this.topic }, topic)));
    const { times, series } = this.topics.get(this.topic) ?? { times: [], series: new Map() };
    const kinds = [...new Set([...series.keys()].map(kindOf))];
    if (!kinds.includes(this.kind)) [this.kind] = kinds;
    refresh(this.kinds, [kinds, this.kind], () => kinds.map((kind) => h("option", { selected: kind === this.kind }, kind)));
    this.kinds.hidden = kinds.length < 2;
    const lines = [...series].filter(([path]) => kindOf(path) === this.kind).slice(0, COLORS.length);
    const end = times.at(-1) ?? 0;
    const span = Math.max(10, end - (times[0] ?? 0));
    drawPlot(this.canvas, { times, lines, begin: end - span, end, labels: [`−${span.toFixed(0)} s`, "now"] });
    refresh(this.legend, lines.map(([name]) => name), () => legendOf(lines));
  }
}
