// The page of a run: header, faults, 3D, cameras, joints, and panels in tabs.

import { h, refresh, say, toast } from "./dom.js";
import { Deadman } from "./hold.js";
import { Drive, StopLine, Stream } from "./link.js";
import { View3D, isDark } from "./view3d.js";
import { Cameras } from "./cameras.js";
import { Joints } from "./joints.js";
import { Thumb } from "./thumb.js";
import { DrivePanel } from "./panels/drive.js";
import { EpisodesPanel } from "./panels/episodes.js";
import { PlotsPanel } from "./panels/plots.js";
import { HealthPanel } from "./panels/health.js";
import { LogPanel } from "./panels/log.js";

const STALE_MS = 1500;
const CONFIRMED_MS = 300;
const $ = (id) => document.getElementById(id);

// What all parts of the page share.
const page = {
  stream: new Stream(), drive: new Drive(), line: new StopLine(), status: null, state: null, links: {}, role: "watch",
  arrived: 0, unconfirmed: "",
  get operating() { return this.drive.facts.operating; },
  get mode() { return this.status?.robot.modes.find((mode) => mode.name === this.status.mode); },
  // Whether the operator can jog from this page now.
  get jogs() { return this.operating && this.status?.services.includes("jog") && !this.status.faults.length; },
  // Carries out a command, and shows its error.
  async command(name, facts = {}, done = "") {
    try {
      const answer = await this.drive.command(name, facts);
      if (done || typeof answer === "string") toast(done || answer);
      return true;
    } catch (error) {
      toast(error.message, "error");
      return false;
    }
  },
};
page.deadman = new Deadman(page.drive);
window.ibrobot = page; // for tests and for the console

let toolMotion = [0, 0, 0];
const view = new View3D($("view"), {
  onTool({ press, held, linear }) {
    toolMotion = linear;
    if (press) page.deadman.hold(() => ({ linear: toolMotion }), press);
    if (!held) page.deadman.release();
  },
  onGoal: (point) => panels[0].setGoal?.(`xyz=${point.map((value) => value.toFixed(3)).join(",")}`),
});
page.view = view;
page.cameras = new Cameras($("cameras"), page);
const parts = [page.cameras, new Joints($("joints"), page), new Thumb($("thumb"), page)];
const panels = [DrivePanel, EpisodesPanel, PlotsPanel, HealthPanel, LogPanel].map((Panel) => new Panel(page));

// Stops the robot. The button says so at once, and an alarm names other ways while the run has not confirmed it.
let stopping = 0;
async function stop() {
  const number = ++stopping;
  const confirmed = page.line.stop();
  page.deadman.release();
  page.unconfirmed = "";
  say($("stop"), "stopping …");
  const alarm = (why) => {
    if (number !== stopping) return;
    page.unconfirmed = why;
    showFaults();
  };
  const timer = setTimeout(() => {
    alarm(`no answer within ${CONFIRMED_MS / 1000} s`);
    page.line.request().then(done, () => {});
  }, CONFIRMED_MS);
  function done() {
    clearTimeout(timer);
    if (number !== stopping) return;
    page.unconfirmed = "";
    $("stop").replaceChildren("STOP ", h("kbd", {}, "Esc"));
    showFaults();
  }
  confirmed.then(done, (error) => { clearTimeout(timer); alarm(error.message); });
}

// Esc stops the robot, whatever the page shows and wherever the focus is.
window.addEventListener("keydown", (event) => {
  if (event.key !== "Escape" || page.role === "watch") return;
  event.preventDefault();
  event.stopImmediatePropagation();
  if (!event.repeat) stop();
}, true);
$("stop").addEventListener("pointerdown", stop);
$("stop").addEventListener("keydown", (event) => {
  if (["Enter", " "].includes(event.key) && !event.repeat) stop();
});

$("operate").addEventListener("click", () => {
  if (page.operating) page.command("resign");
  else page.command("operate", { take_over: true });
});
$("theme").addEventListener("click", () => {
  const theme = isDark() ? "light" : "dark";
  document.documentElement.dataset.theme = theme;
  localStorage.setItem("theme", theme);
});
for (const which of ["3d", "cameras"]) {
  $(`show-${which}`).addEventListener("click", () => {
    document.body.dataset.shown = which;
    for (const each of ["3d", "cameras"]) $(`show-${each}`).setAttribute("aria-pressed", String(each === which));
  });
}
document.body.dataset.shown = "3d";

function showTabs() {
  const list = document.querySelector("[role=tablist]");
  const content = document.querySelector(".panels");
  const tabs = panels.map((panel, i) => {
    panel.element = h("div", { role: "tabpanel", id: `panel-${panel.id}`, "aria-labelledby": `tab-${panel.id}`, tabindex: "0" });
    panel.mount(panel.element);
    content.append(panel.element);
    return h("button", {
      role: "tab", id: `tab-${panel.id}`, "aria-controls": `panel-${panel.id}`, onclick: () => choose(i),
    }, panel.title);
  });
  const choose = (chosen) => tabs.forEach((tab, i) => {
    tab.setAttribute("aria-selected", String(i === chosen));
    tab.tabIndex = i === chosen ? 0 : -1;
    panels[i].element.hidden = i !== chosen;
    panels[i].show?.(i === chosen);
  });
  list.append(...tabs);
  list.addEventListener("keydown", (event) => {
    const by = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (!by) return;
    const next = (tabs.indexOf(document.activeElement) + by + tabs.length) % tabs.length;
    choose(next);
    tabs[next].focus();
  });
  choose(0);
}
showTabs();

function showHeader() {
  const { status } = page;
  if (!status) return;
  say($("robot"), status.robot.name);
  document.title = `${status.robot.name}: ${status.mode}`;
  say($("mode"), `${status.mode}${status.robot.simulated ? " · simulation" : ""}`);
  const loop = status.counts.loop ?? {};
  say($("late"), loop.ticks ? `${Math.round(loop.rate_hz)} Hz · late p99 ${Math.round(loop.lateness_p99_us)} µs · missed ${loop.missed}` : "");
  $("late").classList.toggle("bad", (loop.missed ?? 0) > 0);
}

function showOperator() {
  const { operating, operator, role, pages } = page.drive.facts;
  document.body.classList.toggle("operating", operating);
  const who = !page.drive.open ? "" : operating ? "you operate" : operator ? `watching · ${operator} operates` : "watching · no operator";
  say($("operator"), role === "watch" ? "watching only" : who && who + (pages > 1 ? ` · ${pages} pages` : ""));
  $("operator").classList.toggle("good", operating);
  $("operate").hidden = role === "watch" || !page.drive.open;
  say($("operate"), operating ? "Only watch" : operator ? "Take over" : "Operate");
  $("stop").disabled = role === "watch";
}

function showFaults() {
  const { status } = page;
  const estop = page.state?.estop ?? false;
  const faults = status?.faults ?? [];
  const held = status?.held ?? "", failure = status?.failure ?? "";
  const absent = status?.absent ?? [], conditions = status?.conditions ?? [];
  const lost = page.connected === false;
  const unconfirmed = page.unconfirmed ?? "";
  refresh($("faults"), { lost, unconfirmed, estop, faults, held, failure, absent, conditions, operating: page.operating }, () => {
    const reset = () => h("button", { onclick: () => page.command("reset"), disabled: !page.operating }, "Reset");
    return [
      unconfirmed ? h("div", { class: "fault alarm" }, h("strong", {}, "The robot may not have stopped: "), h("span", {},
        `STOP is not confirmed (${unconfirmed}). Press Esc in the terminal of the run, or switch off the robot's power.`)) : null,
      lost ? h("div", { class: "fault" }, h("strong", {}, "No connection to the run. "), h("span", {},
        "It has ended, or the network is down. STOP on this page has no effect. The page keeps trying.")) : null,
      ...faults.map(({ text, remedy }) => h("div", { class: "fault" },
        h("strong", {}, "Fault: "), h("span", {}, `${text}. The robot holds. ${remedy}`), reset())),
      estop && !faults.length ? h("div", { class: "fault" }, h("strong", {}, "Emergency stop. "), reset()) : null,
      held ? h("div", { class: "warning" }, h("strong", {}, "Holding: "), h("span", {}, held),
        h("button", { onclick: () => page.command("mode", { mode: page.status.mode }), disabled: !page.operating }, "Go on"))
        : null,
      failure ? h("div", { class: "fault" }, h("strong", {}, "The run ended: "), h("span", {}, failure)) : null,
      ...conditions.map((each) => h("div", { class: "warning" },
        h("strong", {}, `${each.joint}: `), h("span", {}, each.message ?? ""))),
      ...absent.map(({ name, why }) => h("div", { class: "warning" },
        h("strong", {}, `${name} is missing: `), h("span", {}, why))),
    ].filter(Boolean);
  });
}

function showConnection() {
  const stale = performance.now() - page.arrived > STALE_MS;
  const open = page.drive.open && page.connected;
  say($("connection"), !open ? "not connected" : stale ? "no states" : "");
  $("connection").classList.toggle("bad", !open || stale);
}

page.stream.addEventListener("state", ({ detail: state }) => {
  const before = page.state;
  page.state = state;
  page.drive.stops = state.stops;
  page.arrived = performance.now();
  view.tell({ do: "state", state });
  for (const part of [...parts, ...panels]) part.state?.(state);
  if (before?.estop !== state.estop) showFaults();
});
page.stream.addEventListener("status", ({ detail: status }) => {
  const first = !page.status;
  page.status = status;
  const objects = JSON.stringify(status.objects);
  if (objects !== page.objects) view.tell({ do: "objects", objects: status.objects });
  page.objects = objects;
  if (first) view.tell({ do: "joints", names: status.robot.joints.map((joint) => joint.name) });
  update();
});
page.stream.addEventListener("plan", ({ detail: plan }) => {
  if (page.state) view.tell({ do: "plan", plan, positions: page.state.position });
});
page.stream.addEventListener("samples", ({ detail }) => panels.forEach((panel) => panel.samples?.(detail)));
page.stream.addEventListener("connection", ({ detail }) => {
  page.connected = detail.open;
  showConnection();
  showFaults();
});
page.drive.addEventListener("operator", update);
page.drive.addEventListener("connection", showConnection);
page.drive.addEventListener("refused", ({ detail }) => toast(detail, "error"));

function update() {
  showHeader();
  showOperator();
  showFaults();
  const tool = page.operating && page.status?.robot.tool;
  view.tell({
    do: "handle", jog: Boolean(tool && page.jogs), goal: Boolean(tool && page.status.services.includes("goal")),
  });
  for (const part of [...parts, ...panels]) if (page.status) part.update?.(page.status);
}

setInterval(showConnection, 500);
fetch("/api/session").then((response) => response.json()).then(({ role, links }) => {
  page.role = role;
  page.links = links;
  update();
});
