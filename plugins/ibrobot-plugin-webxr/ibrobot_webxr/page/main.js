// The page: connects its parts.

import { Connection } from "/static/connection.js";
import { Controls } from "/static/controls.js";
import { Headset, supportedMode } from "/static/headset.js";
import { Phone } from "/static/phone.js";

const IDLE_MS = 200;
const REFUSED_MS = 3000; // after failing to connect for this long, the page suggests a remedy
const $ = (id) => document.getElementById(id);
const figures = [];
let state = null;
let failure = "";
let refusedSince = performance.now(); // null once the socket has been open

const controls = new Controls(document);
const connection = new Connection({ onState, onImage, onLink });
const arm = () => $("arm").value || Object.keys(state?.hands ?? {})[0] || "right";
const phone = new Phone(controls, connection, arm);
const headset = new Headset(controls, connection, arm, $("overlay"));

function onState(next) {
  state = next;
  $("robot").textContent = next.robot?.name ?? "ibrobot";
  $("mode").textContent = next.robot ? `mode ${next.robot.mode}` : "";
  const arms = Object.entries(next.hands);
  const devices = new Set(arms.map(([, { device }]) => device));
  if (devices.size > 1 && $("arm").options.length !== arms.length) {
    $("arm").replaceChildren(...arms.map(([hand, { device }]) => new Option(device, hand)));
  }
  $("arms").hidden = devices.size < 2;
  $("claim").hidden = next.control !== "free";
  const moves = arms.some(([, { engaged }]) => engaged);
  $("clutch").classList.toggle("moves", moves);
  $("message").textContent = failure || reason(next, arms);
  nameCameras();
  for (const button of document.querySelectorAll("[data-event], #clutch, #stick, #open, #close")) button.disabled = next.control !== "you";
}

function reason({ control, robot, error }, arms) {
  if (robot?.estop) return "EMERGENCY STOP. Reset it at the robot.";
  if (robot?.faults.length) return robot.faults.join("; ");
  if (control === "other") return "Another page has control. This one watches.";
  if (control === "free") return "No page has control.";
  if (!arms.length) return `The mode ${robot?.mode ?? ""} is not driven from here.`;
  const running = phone.running || headset.session;
  return (running && arms.map(([, { text }]) => text).find(Boolean)) || error || "";
}

function onLink({ open, silent, rate, roundTrip }) {
  $("link").textContent = !open ? "not connected" : silent ? "the network is slow" : roundTrip === undefined ? "connected" : `${rate} Hz, ${roundTrip.toFixed(0)} ms`;
  if (open) refusedSince = null;
  $("trust").hidden = refusedSince === null || performance.now() - refusedSince < REFUSED_MS;
  if (!open || silent) controls.release();
}

// The first image of a camera may come before the state that names it.
function nameCameras() {
  figures.forEach(({ children: [image, caption] }, camera) => {
    caption.textContent = image.alt = state?.cameras[camera] ?? "";
  });
}

function onImage(camera, blob, shown) {
  if (!figures[camera]) {
    const figure = document.createElement("figure");
    figure.append(document.createElement("img"), document.createElement("figcaption"));
    figures[camera] = figure;
    $("cameras").replaceChildren(...figures.filter(Boolean));
  }
  nameCameras();
  const [image] = figures[camera].children;
  if (headset.session && !headset.isPhone) {
    createImageBitmap(blob).then((bitmap) => headset.screens.show(camera, bitmap)).finally(shown);
    return;
  }
  const address = URL.createObjectURL(blob);
  image.onload = image.onerror = () => {
    URL.revokeObjectURL(address);
    shown();
  };
  image.src = address;
}

async function run(start) {
  failure = "";
  try {
    await start();
    connection.send({ type: "claim" }); // a silent page may have lost control during a long start
    $("controls").hidden = Boolean(headset.session) && !headset.isPhone;
    await navigator.wakeLock?.request("screen").catch(() => {});
  } catch (error) {
    failure = error.message;
  }
}

$("stop").addEventListener("pointerdown", () => connection.send({ type: "stop" }));
$("stop").addEventListener("click", () => connection.send({ type: "stop" }));
$("claim").addEventListener("click", () => connection.send({ type: "claim" }));
$("sensors").addEventListener("click", () => run(async () => {
  await phone.start();
  $("sensors").hidden = $("xr").hidden = true;
}));
for (const button of document.querySelectorAll("[data-event]")) {
  button.addEventListener("click", () => connection.send({ type: "press", event: button.dataset.event }));
}

supportedMode().then((mode) => {
  if (!mode) return;
  $("xr").hidden = false;
  $("xr").textContent = mode === "immersive-ar" ? "Start AR" : "Start VR";
  $("xr").addEventListener("click", () => run(async () => {
    phone.stop();
    await headset.start(mode, () => {
      controls.release();
      $("controls").hidden = true;
      $("xr").hidden = $("sensors").hidden = false;
    });
    $("xr").hidden = $("sensors").hidden = true;
  }));
});

// An idle page stays in control by empty messages. A page that is left reports that no hand is tracked.
setInterval(() => {
  if (!headset.session && !phone.running && document.visibilityState === "visible") connection.sendHands({}, 0);
}, IDLE_MS);
const leave = () => connection.sendHands({}, 0);
window.addEventListener("blur", leave);
window.addEventListener("pagehide", leave);
document.addEventListener("visibilitychange", () => {
  if (document.visibilityState === "visible" && state?.control === "free") connection.send({ type: "claim" });
  leave();
});
