// Plots of any numbers on any topic, over the last minutes in which this page was open.

import { h, refresh } from "../dom.js";
import { COLORS, drawPlot } from "../plot.js";

const SAMPLES = 2;
const KEPT = 1800; // three minutes at 10 Hz

export class PlotsPanel {
  id = "plots";
  title = "Plots";

  constructor(page) {
    this.page = page;
    this.times = [];
    this.series = new Map();
    this.topic = "/joint_states";
  }

  mount(element) {
    this.choice = h("select", { id: "plot-topic" });
    this.choice.addEventListener("change", () => { this.topic = this.choice.value; this.draw(); });
    this.canvas = h("canvas", { class: "plot", role: "img", "aria-label": "Plot of the chosen topic" });
    this.legend = h("p", { class: "legend" });
    this.latency = h("p", { class: "note" });
    element.append(h("div", { class: "row" }, h("label", { for: "plot-topic" }, "Topic"), this.choice), this.canvas,
      this.legend, this.latency);
    new ResizeObserver(() => this.draw()).observe(this.canvas);
  }

  show(shown) {
    this.shown = shown;
    this.page.stream.show(SAMPLES, shown);
    if (!shown) return;
    this.draw();
  }

  samples({ stamp, topics }) {
    this.times.push(stamp / 1e9);
    for (const [topic, values] of Object.entries(topics)) {
      for (const [path, value] of Object.entries(values)) {
        const name = `${topic} ${path}`;
        if (!this.series.has(name)) this.series.set(name, new Array(this.times.length - 1).fill(null));
        this.series.get(name).push(value);
      }
    }
    for (const values of this.series.values()) if (values.length < this.times.length) values.push(null);
    if (this.times.length > KEPT) {
      this.times.shift();
      for (const values of this.series.values()) values.shift();
    }
    const known = [...new Set([...this.series.keys()].map((name) => name.split(" ")[0]))].sort();
    refresh(this.choice, known, () => known.map((topic) => h("option", { selected: topic === this.topic }, topic)));
    if (this.shown) this.draw();
  }

  update(status) {
    const { dispatch, loop } = status.counts;
    this.latency.textContent = (dispatch ? `policy latency p50 ${dispatch.latency_p50_ms} ms, p99 ${dispatch.latency_p99_ms} ms, `
      + `plan ${dispatch.plan_length}, holds ${dispatch.holds} · ` : "")
      + (loop?.ticks ? `loop late p50 ${Math.round(loop.lateness_p50_us)} µs, p99 ${Math.round(loop.lateness_p99_us)} µs` : "");
  }

  draw() {
    const shown = [...this.series].filter(([name]) => name.startsWith(`${this.topic} `)).slice(0, COLORS.length);
    const end = this.times.at(-1) ?? 0;
    const span = Math.max(10, end - (this.times[0] ?? 0));
    drawPlot(this.canvas, {
      times: this.times, lines: shown, begin: end - span, end, labels: [`−${span.toFixed(0)} s`, "now"],
    });
    refresh(this.legend, shown.map(([name]) => name), () => shown.map(([name], i) => {
      const mark = h("i", {});
      mark.style.background = COLORS[i];
      return h("span", {}, mark, name.slice(this.topic.length + 1));
    }));
  }
}
