// Draws lines over time on a canvas.

import { h } from "./dom.js";

export const COLORS = ["#1478c8", "#c2410c", "#15803d", "#7e22ce", "#a16207", "#0e7490", "#be185d", "#4b5563"];
const LEFT = 56, BOTTOM = 22, TOP = 8;

// `lines`: [[name, values], …], with null where a value is missing. `begin` and `end`: the span of the time axis, whose
// ends are labelled with `labels`. `cursor`: the time of a vertical line. `shade`: spans of time that are drawn grey.
export function drawPlot(canvas, { times, lines, begin, end, labels, cursor = null, shade = [] }) {
  const box = canvas.getBoundingClientRect();
  if (box.width < 2) return;
  const ratio = window.devicePixelRatio;
  canvas.width = box.width * ratio;
  canvas.height = box.height * ratio;
  const context = canvas.getContext("2d");
  context.scale(ratio, ratio);
  const style = getComputedStyle(document.documentElement);
  let low = Infinity, high = -Infinity;
  for (const [, values] of lines) {
    for (const value of values) if (value !== null) { low = Math.min(low, value); high = Math.max(high, value); }
  }
  if (!Number.isFinite(low)) { low = -1; high = 1; }
  if (low === high) { low -= 1; high += 1; }
  const width = box.width - LEFT - 8, height = box.height - BOTTOM - TOP;
  const x = (time) => LEFT + width * (time - begin) / Math.max(1e-9, end - begin);
  const y = (value) => TOP + height * (high - value) / (high - low);
  context.font = "12px system-ui";
  context.fillStyle = context.strokeStyle = style.getPropertyValue("--muted");
  const digits = Math.min(6, Math.max(0, 2 - Math.floor(Math.log10(high - low)))); // two or three that differ
  for (let i = 0; i <= 4; i += 1) {
    const value = low + (high - low) * i / 4;
    const text = Math.abs(value) < 1e5 ? Number(value.toFixed(digits)).toString() : value.toPrecision(3);
    context.fillText(text.replace("-", "−"), 4, y(value) + 4);
    context.globalAlpha = 0.25;
    context.strokeRect(LEFT, y(value), width, 0);
    context.globalAlpha = 1;
  }
  context.fillText(labels[0], LEFT, box.height - 6);
  context.fillText(labels[1], LEFT + width - context.measureText(labels[1]).width, box.height - 6);
  context.globalAlpha = 0.15;
  for (const [from, to] of shade) context.fillRect(x(from), TOP, x(to) - x(from), height);
  context.globalAlpha = 1;
  context.lineWidth = 1.5;
  context.save();
  context.beginPath();
  context.rect(LEFT, 0, width, box.height);
  context.clip();
  lines.forEach(([, values], i) => {
    context.strokeStyle = COLORS[i % COLORS.length];
    context.beginPath();
    let drawing = false;
    values.forEach((value, at) => {
      if (value === null) return;
      context[drawing ? "lineTo" : "moveTo"](x(times[at]), y(value));
      drawing = true;
    });
    context.stroke();
  });
  context.restore();
  if (cursor !== null) {
    context.lineWidth = 2;
    context.strokeStyle = style.getPropertyValue("--text");
    context.strokeRect(x(cursor), TOP, 0, height);
  }
}

// The names of lines in their colours, for a legend.
export function legendOf(lines) {
  return lines.map(([name], i) => {
    const mark = h("i", {});
    mark.style.background = COLORS[i];
    return h("span", {}, mark, shortOf(name));
  });
}

// The time under a pointer on a plot, between begin and end.
export function timeAt(canvas, event, begin, end) {
  const box = canvas.getBoundingClientRect();
  const share = (event.clientX - box.left - LEFT) / (box.width - LEFT - 8);
  return begin + Math.min(1, Math.max(0, share)) * (end - begin);
}

// Values of a kind are plotted together: position.shoulder_pan is one of position, wrench.force.x one of wrench.force,
// latency_p50_ms one of latency. So numbers of different units do not share an axis.
export function kindOf(name) {
  return /^.+(?=\.[^.[]+$)|^[^[]+(?=\[)/.exec(name)?.[0] ?? /^(lateness|latency)(?=_)/.exec(name)?.[0] ?? "values";
}

// The name of a value among those of its kind: shoulder_pan of position.shoulder_pan.
function shortOf(name) { return name.startsWith(`${kindOf(name)}.`) ? name.slice(kindOf(name).length + 1) : name; }
