// Plots of any numbers on any topic, over the last minutes in which this page was open.

import { h, refresh } from "../dom.js";

const SAMPLES = 2;
const KEPT = 1800; // three minutes at 10 Hz
const COLORS = ["#1478c8", "#c2410c", "#15803d", "#7e22ce", "#a16207", "#0e7490", "#be185d", "#4b5563"];

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
    const { canvas } = this;
    const box = canvas.getBoundingClientRect();
    if (box.width < 2) return;
    const ratio = window.devicePixelRatio;
    canvas.width = box.width * ratio;
    canvas.height = box.height * ratio;
    const context = canvas.getContext("2d");
    context.scale(ratio, ratio);
    const style = getComputedStyle(document.documentElement);
    const shown = [...this.series].filter(([name]) => name.startsWith(`${this.topic} `)).slice(0, COLORS.length);
    const values = shown.flatMap(([, each]) => each).filter((value) => value !== null);
    let low = Infinity, high = -Infinity;
    for (const value of values) { low = Math.min(low, value); high = Math.max(high, value); }
    if (!(low < high)) { low = (values[0] ?? 0) - 1; high = low + 2; }
    const left = 56, bottom = 22, width = box.width - left - 8, height = box.height - bottom - 8;
    const x = (time) => left + width * (1 - (this.times.at(-1) - time) / Math.max(10, this.times.at(-1) - this.times[0]));
    const y = (value) => 8 + height * (high - value) / (high - low);
    context.font = "12px system-ui";
    context.fillStyle = context.strokeStyle = style.getPropertyValue("--muted");
    for (let i = 0; i <= 4; i += 1) {
      const value = low + (high - low) * i / 4;
      context.fillText(value.toPrecision(3), 4, y(value) + 4);
      context.globalAlpha = 0.25;
      context.strokeRect(left, y(value), width, 0);
      context.globalAlpha = 1;
    }
    const span = Math.max(10, (this.times.at(-1) ?? 0) - (this.times[0] ?? 0));
    context.fillText(`−${span.toFixed(0)} s`, left, box.height - 6);
    context.fillText("now", left + width - 24, box.height - 6);
    context.lineWidth = 1.5;
    shown.forEach(([, each], i) => {
      context.strokeStyle = COLORS[i];
      context.beginPath();
      let drawing = false;
      each.forEach((value, at) => {
        if (value === null) { return; }
        context[drawing ? "lineTo" : "moveTo"](x(this.times[at]), y(value));
        drawing = true;
      });
      context.stroke();
    });
    refresh(this.legend, shown.map(([name]) => name), () => shown.map(([name], i) => {
      const mark = h("i", {});
      mark.style.background = COLORS[i];
      return h("span", {}, mark, name.slice(this.topic.length + 1));
    }));
  }
}
