// The page of a run: header, faults, pictures, recording, driving, and panels that fold away.

import { clearToasts, h, refresh, row, say, switchTheme, table, toast } from "./dom.js";
import { Deadman } from "./hold.js";
import { Drive, StopLine, Stream } from "./link.js";
import { View3D } from "./view3d.js";
import { Dock } from "./dock.js";
import { Joints } from "./joints.js";
import { Modes } from "./modes.js";
import { Motion } from "./motion.js";
import { Pictures } from "./pictures.js";
import { Agents } from "./agents.js";
import { Record } from "./record.js";
import { Thumb } from "./thumb.js";
import { PlotsPanel } from "./panels/plots.js";
import { HealthPanel } from "./panels/health.js";
import { LogPanel } from "./panels/log.js";
import { words } from "./words.js";
import { GUARD_HZ, sound } from "./cues.js";

const STALE_MS = 1500;
const CONFIRMED_MS = 300;
const LATE_MS = 5000;
const $ = (id) => document.getElementById(id);

// What all parts of the page share.
const page = {
  stream: new Stream(), drive: new Drive(), line: new StopLine(), status: null, state: null, links: {}, arrived: 0,
  unconfirmed: "",
  // "drive", "watch", or "" until the run has said it: Esc and STOP work from the start.
  get role() { return this.drive.facts.role; },
  get operating() { return this.drive.facts.operating && !this.status?.ended; },
  get mode() { return this.status?.robot.modes.find((mode) => mode.name === this.status.mode); },
  // The devices with which the operator can jog from this page now; and the one that moves the tool.
  get jogs() { return this.operating && !this.status?.faults.length ? this.status?.jogs ?? [] : []; },
  get device() { return this.jogs.includes(this.chosen) ? this.chosen : this.jogs[0]; },
  // The name of the joints that a device moves.
  groupOf(device) {
    const own = this.mode.jogs[device];
    return Object.entries(this.status.robot.groups).find(([, joints]) => String(joints) === String(own))?.[0] ?? device;
  },
  setDevice(device) { this.chosen = device; update(); },
};
page.deadman = new Deadman(page.drive);
window.ibrobot = page; // for tests and for the console

let toolMotion = [0, 0, 0];
const view = new View3D($("view"), {
  onTool({ press, held, linear }) {
    toolMotion = linear;
    const { device } = page;
    if (press) page.deadman.hold(() => ({ device, linear: toolMotion }), press);
    if (!held) page.deadman.release();
  },
  onGoal: (point) => motion.setGoal?.(`xyz=${point.map((value) => value.toFixed(3)).join(",")}`),
});
page.view = view;
const pictures = new Pictures($("pictures"), page), record = new Record($("record"), page), motion = new Motion($("motion"), page);
const dock = new Dock($("dock"), page, [PlotsPanel, HealthPanel, LogPanel].map((Panel) => new Panel(page)));
const joints = new Joints($("joints"), page);
const parts = [pictures, record, new Modes($("mode"), page), motion, joints, new Agents($("agents"), page, motion), new Thumb($("thumb"), page), dock];

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
  if (page.operating) page.drive.ask("resign");
  else page.drive.ask("operate", { take_over: true });
});
$("theme").addEventListener("click", switchTheme);
// Which keys do something now.
function showKeys() {
  const keys = [...page.role === "watch" ? [] : [["Esc", "emergency stop"]], ...record.keys, ...pictures.keys, ["?", "this list"]];
  const devices = [...new Set((page.status?.help ?? "").split("\n"))].map(words).join("\n"); // two arms say the same
  const dialog = $("dialog");
  dialog.replaceChildren(h("h2", { id: "dialog-title" }, "Keys that are active now"),
    table(null, keys.map(([key, does]) => row([h("th", { scope: "row" }, h("kbd", {}, key)), does]))),
    devices ? h("pre", {}, devices) : "",
    h("form", { method: "dialog", class: "row" }, h("button", { autofocus: true }, "Close")));
  dialog.showModal();
}
$("keys").addEventListener("click", showKeys);
// Keys of recording and of pictures, unless something is typed or asked.
window.addEventListener("keydown", (event) => {
  if (event.repeat || event.ctrlKey || event.altKey || event.metaKey || event.defaultPrevented) return;
  if (event.target.closest?.("input:not([type=range]):not([type=checkbox]), select, textarea, dialog")) return;
  if (event.key === "?") showKeys();
  else if (record.press(event.key.toLowerCase()) || pictures.press(event.key)) event.preventDefault();
});

let missed = 0, missedAt = -Infinity; // the loop's late ticks, and when the last one came
function showHeader() {
  const { status } = page;
  if (!status) return;
  say($("robot"), status.robot.name);
  document.title = `${status.robot.name}: ${status.mode}`;
  say($("body"), status.robot.simulated ? "simulation" : "real robot");
  const loop = status.counts.loop ?? {};
  if ((loop.missed ?? 0) > missed) missedAt = performance.now();
  missed = loop.missed ?? 0;
  const late = performance.now() - missedAt < LATE_MS;
  say($("late"), loop.ticks ? `${Math.round(loop.rate_hz)} Hz, ${late ? "late" : "on time"}` : "");
  $("late").title = loop.ticks ? words(`Lateness of the control loop: 99 % below ${Math.round(loop.lateness_p99_us)} µs; ${loop.missed} of ${loop.ticks} ticks missed`) : "";
  $("late").classList.toggle("bad", late);
}

function showOperator() {
  const { operating, operator, role, pages } = page.drive.facts;
  const ended = page.status?.ended ?? false;
  document.body.classList.toggle("operating", operating);
  const who = !page.drive.open || ended ? "" : operating ? "you operate" : operator ? `watching · ${operator} operates` : "watching · no operator";
  say($("operator"), role === "watch" ? "watching only" : who && who + (pages > 1 ? ` · ${pages} pages` : ""));
  $("operator").classList.toggle("good", operating);
  $("operate").hidden = role === "watch" || !page.drive.open || ended;
  say($("operate"), operating ? "Only watch" : operator ? "Take over" : "Operate");
  $("stop").disabled = role === "watch" || ended;
}

function showFaults() {
  const { status } = page;
  const estop = page.state?.estop ?? false;
  const faults = status?.faults ?? [];
  const held = status?.held ?? "", failure = status?.failure ?? "";
  const absent = status?.absent ?? [], conditions = status?.conditions ?? [];
  const ended = status?.ended ?? false;
  const lost = page.connected === false && !ended;
  const guard = status?.guard?.text ?? "";
  const unconfirmed = page.unconfirmed ?? "";
  refresh($("faults"), { ended, lost, unconfirmed, estop, faults, held, guard, failure, absent, conditions, operating: page.operating }, () => {
    if (faults.length || estop) clearToasts(); // what they say is past, and on a phone they would cover the fault
    const reset = () => h("button", { onclick: () => page.drive.ask("reset"), disabled: !page.operating }, "Reset");
    return [
      unconfirmed ? h("div", { class: "fault alarm" }, h("strong", {}, "The robot may not have stopped: "), h("span", {},
        `STOP is not confirmed (${unconfirmed}). Press Esc in the terminal of the run, or switch off the robot's power.`)) : null,
      lost ? h("div", { class: "fault" }, h("strong", {}, "No connection to the run. "), h("span", {},
        "It has ended, or the network is down. STOP on this page has no effect. The page keeps trying."), ...toHome()) : null,
      ...faults.map(({ text, remedy }) => h("div", { class: "fault" },
        h("strong", {}, "Fault: "), h("span", {}, `${text}. The robot holds. ${remedy}`), reset())),
      estop && !faults.length ? h("div", { class: "fault" }, h("strong", {}, "Emergency stop. "), reset()) : null,
      held ? h("div", { class: "warning" }, h("strong", {}, "Holding: "), h("span", {}, held),
        h("button", { onclick: () => page.drive.service("/set_mode", page.status.mode), disabled: !page.operating }, "Go on"))
        : null,
      guard ? h("div", { class: "warning" }, h("strong", {}, "The guard holds the arm back: "), h("span", {}, guard)) : null,
      failure ? h("div", { class: "fault" }, h("strong", {}, "The run ended: "), h("span", {}, failure)) : null,
      ended && !failure ? h("div", { class: "ended" }, h("strong", {}, "The run has ended"), h("span", {}, results(status)), ...onwards(status)) : null,
      ...conditions.map((each) => h("div", { class: "warning" },
        h("strong", {}, `${each.joint}: `), h("span", {}, each.message ?? ""))),
      ...[...new Set(absent.map(({ why }) => why))].map((why) => {
        const names = absent.filter((each) => each.why === why).map(({ name }) => name);
        return h("div", { class: "warning" }, h("strong", {}, `${names.join(", ")} ${names.length > 1 ? "are" : "is"} missing: `), h("span", {}, why));
      }),
    ].filter(Boolean);
  });
}

// What a run has achieved.
function results({ episode, episodes, successes }) {
  if (episode) return `${episode.saved}${episode.wanted ? ` of ${episode.wanted}` : ""} saved`;
  return episodes ? `${successes} of ${episodes} episode${episodes === 1 ? "" : "s"} successful` : "";
}

// The page that launched the run, whose address this one has after #, goes on with what was recorded.
function onwards({ episode }) {
  const origin = homeOf();
  if (!origin) return [];
  return [episode?.saved ? h("a", { class: "button", href: `${origin}/#record` }, "Judge and convert the episodes") : null,
    h("a", { class: "button", href: `${origin}/#robots` }, "Launch another run")].filter(Boolean);
}

// The page that started the run, on this machine; null if a terminal did.
function homeOf() {
  const home = new URLSearchParams(location.hash.slice(1)).get("home");
  return home && URL.canParse(home) && new URL(home).hostname === location.hostname ? new URL(home).origin : null;
}

function toHome() {
  const origin = homeOf();
  return origin ? [h("a", { class: "button", href: `${origin}/#jobs` }, "See its result")] : [];
}

function showConnection() {
  const stale = performance.now() - page.arrived > STALE_MS;
  const open = page.drive.open && page.connected;
  const ended = page.status?.ended ?? false;
  const starts = !page.status && page.connected !== false; // a page that was just opened
  const waits = !open ? "connecting …" : "waiting for the robot …";
  say($("connection"), ended ? "ended" : starts ? waits : !open ? "not connected" : stale ? "no states" : "");
  $("connection").classList.toggle("bad", !ended && !starts && (!open || stale));
}

page.stream.addEventListener("state", ({ detail: state }) => {
  const before = page.state;
  page.state = state;
  page.drive.stops = state.stops;
  page.arrived = performance.now();
  view.tell({ do: "state", state });
  joints.state(state);
  if (before?.estop !== state.estop) update();
});
page.stream.addEventListener("status", ({ detail: status }) => {
  const first = !page.status;
  const { text: held, sound: sounds } = status.guard ?? {};
  if (sounds && held !== page.status?.guard?.text) sound(GUARD_HZ);
  page.status = status;
  const objects = JSON.stringify(status.objects);
  if (objects !== page.objects) view.tell({ do: "objects", objects: status.objects });
  page.objects = objects;
  const near = [status.guard?.first, status.guard?.second].filter(Boolean);
  if (String(near) !== String(page.near ?? [])) view.tell({ do: "near", names: near });
  page.near = near;
  if (first) view.tell({ do: "joints", names: status.robot.joints.map((joint) => joint.name) });
  update();
});
page.stream.addEventListener("plan", ({ detail: plan }) => {
  if (page.state) view.tell({ do: "plan", plan, positions: page.state.position });
});
page.stream.addEventListener("samples", ({ detail }) => dock.samples(detail));
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
    do: "handle", jog: Boolean(tool && page.device), goal: Boolean(tool && page.status.services.includes("/planning/go_to")),
    moved: page.mode?.jogs[page.device] ?? [],
  });
  for (const part of parts) if (page.status) part.update(page.status);
}

setInterval(showConnection, 500);
fetch("/api/session").then((response) => response.json()).then(({ links }) => {
  page.links = links;
  update();
});
