// Agents: who is connected, what one asks for, and what a person lets it do.

import { h, refresh, say } from "./dom.js";

const ARM = "/agent/arm";
const DISARM = "/agent/disarm";
// Nothing is granted by a click that was meant for what stood there before.
const READ_MS = 1000;

export class Agents {
  constructor(section, page, motion) {
    Object.assign(this, { section, page, motion, seconds: "120", speed: "25" });
    this.facts = h("p", { "aria-live": "polite" });
    this.asked = h("div", {});
    this.controls = h("div", {});
    section.append(h("h3", {}, "Agents"), this.facts, this.asked, this.controls);
  }

  update({ agents, services, faults }) {
    const { page } = this;
    this.section.hidden = !services.includes(ARM);
    if (this.section.hidden) return;
    const { connected, armed, asked } = agents;
    const shown = JSON.stringify([connected, asked]);
    if (shown !== this.shown) {
      this.shown = shown;
      this.readable = performance.now() + READ_MS;
      setTimeout(() => this.enable(), READ_MS + 20);
    }
    say(this.facts, line(agents));
    this.facts.classList.toggle("warning", Boolean(armed));
    refresh(this.asked, asked, () => this.request(asked));
    refresh(this.controls, [connected, armed, faults.length, page.operating], () => (armed ? this.disarm() : this.arm(connected, faults.length)));
    this.enable();
  }

  // A new request has to stand for a moment before a click allows it.
  enable() {
    if (this.button) this.button.disabled = this.blocked || performance.now() < this.readable;
  }

  // What an agent asks for, and its path before it moves.
  request(asked) {
    if (!asked) return [];
    const { agent, service, request, refused, goal } = asked;
    return [h("p", { class: "note" }, refused ? `${agent} asks for ${service}:` : `${agent} has called ${service}:`), h("pre", {}, request),
      goal ? h("div", { class: "row" }, h("button", { onclick: () => this.motion.preview(goal) }, "Show the path")) : null].filter(Boolean);
  }

  arm(connected, stopped) {
    if (!connected.length) return [];
    const { page } = this;
    const field = (name, label, most) => {
      const input = h("input", { type: "number", min: "1", max: most, required: true, "aria-label": label, title: label });
      input.value = this[name];
      input.addEventListener("input", () => { this[name] = input.value; });
      return input;
    };
    const agent = h("select", { "aria-label": "Agent" }, connected.map((name) => h("option", { value: name }, name)));
    if (connected.includes(this.agent)) agent.value = this.agent;
    agent.addEventListener("change", () => { this.agent = agent.value; });
    this.blocked = !page.operating || stopped > 0;
    this.button = h("button", { class: "primary" }, "Let the agent move");
    const form = h("form", { class: "row" }, agent, field("seconds", "For how many seconds", "3600"), "s",
      field("speed", "Percent of its speed", "100"), "%", this.button);
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      page.drive.service(ARM, { agent: agent.value, seconds: Number(this.seconds), speed: Number(this.speed) / 100, by: "page" });
    });
    return [form];
  }

  disarm() {
    const { page } = this;
    return [h("div", { class: "row" }, h("button", { class: "danger", disabled: !page.operating, onclick: () => page.drive.service(DISARM) }, "Take it back"))];
  }
}

function line({ connected, armed, left_s: left, speed, ended }) {
  if (armed) return `${armed} may move the robot for ${left} s at ${Math.round(speed * 100)} % of its speed.`;
  if (!connected.length) return "No agent is connected.";
  const before = ended ? ` · ended before: ${ended}` : "";
  return `${connected.join(", ")} may look, plan and stop.${before}`;
}
