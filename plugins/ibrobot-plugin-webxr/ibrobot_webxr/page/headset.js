// A WebXR session: controllers and hands of a headset, or a phone that tracks itself.

import { curledClutch, headingOf, pinch } from "/static/pose.js";
import { Screens } from "/static/screens.js";

const TRIGGER = 0, SQUEEZE = 1, THUMBSTICK = 3, LOWER = 4, UPPER = 5; // of the WebXR gamepad mapping `xr-standard`
const PRESSES = { right: { [LOWER]: "start", [UPPER]: "success", [THUMBSTICK]: "failure" }, left: { [LOWER]: "discard", [UPPER]: "intervention", [THUMBSTICK]: "stop" } };

export async function supportedMode() {
  if (!navigator.xr) return null;
  for (const mode of ["immersive-ar", "immersive-vr"]) {
    if (await navigator.xr.isSessionSupported(mode)) return mode;
  }
  return null;
}

export class Headset {
  constructor(controls, connection, arm, overlay) {
    Object.assign(this, { controls, connection, arm, overlay });
    this.session = null;
    this.screens = new Screens();
    this.curled = {};
    this.pressed = new Set();
  }

  async start(mode, onEnd) {
    const options = { requiredFeatures: ["local-floor"], optionalFeatures: ["hand-tracking"] };
    if (mode === "immersive-ar") {
      options.requiredFeatures = ["local"];
      options.optionalFeatures = ["local-floor", "hand-tracking", "dom-overlay"];
      options.domOverlay = { root: this.overlay };
    }
    const session = await navigator.xr.requestSession(mode, options);
    const canvas = document.createElement("canvas");
    const gl = canvas.getContext("webgl2", { xrCompatible: true, alpha: true });
    session.updateRenderState({ baseLayer: new XRWebGLLayer(session, gl) });
    this.screens.begin(gl);
    this.space = await session.requestReferenceSpace("local-floor").catch(() => session.requestReferenceSpace("local"));
    this.session = session;
    session.addEventListener("end", () => {
      this.session = null;
      this.connection.sendHands({}, 0);
      onEnd();
    });
    session.requestAnimationFrame((time, frame) => this.frame(frame));
  }

  stop() {
    this.session?.end();
  }

  // Whether the session overlays the page's buttons: phones do, headsets do not.
  get isPhone() {
    return this.session?.interactionMode === "screen-space";
  }

  frame(frame) {
    const session = frame.session;
    session.requestAnimationFrame((time, next) => this.frame(next));
    const viewer = frame.getViewerPose(this.space);
    const hands = {};
    if (viewer && session.visibilityState === "visible") {
      if (this.isPhone) {
        if (!viewer.emulatedPosition) hands[this.arm()] = { ...pose(viewer), ...this.controls.read() };
      } else {
        for (const source of session.inputSources) {
          const hand = source.hand ? this.trackedHand(frame, source) : this.controller(frame, source);
          if (hand) hands[source.handedness] = hand;
        }
      }
    }
    this.connection.sendHands(hands, viewer ? headingOf(values(viewer.transform.orientation, 4)) : 0);
    if (viewer) this.screens.draw(session, viewer, this.isPhone);
  }

  controller(frame, source) {
    if (!source.gripSpace || !source.gamepad || source.handedness === "none") return null;
    const grip = frame.getPose(source.gripSpace, this.space);
    this.press(source);
    if (!grip || grip.emulatedPosition) return null;
    const { buttons } = source.gamepad;
    return { ...pose(grip), clutch: Boolean(buttons[SQUEEZE]?.pressed), gripper: unit(buttons[TRIGGER]?.value ?? 0), open: 0, move: [0, 0, 0] };
  }

  trackedHand(frame, source) {
    const joint = (name) => frame.getJointPose(source.hand.get(name), this.space);
    const wrist = joint("wrist");
    const others = ["middle-finger-phalanx-proximal", "middle-finger-tip", "thumb-tip", "index-finger-tip"].map(joint);
    if (!wrist || wrist.emulatedPosition || others.some((found) => !found)) {
      this.curled[source.handedness] = false;
      return null;
    }
    const [knuckle, tip, thumb, index] = others.map((found) => found.transform.position);
    const clutch = curledClutch(this.curled[source.handedness], wrist.transform.position, knuckle, tip);
    this.curled[source.handedness] = clutch;
    return { ...pose(wrist), clutch, gripper: pinch(thumb, index), open: 0, move: [0, 0, 0] };
  }

  press(source) {
    for (const [button, event] of Object.entries(PRESSES[source.handedness] ?? {})) {
      const key = `${source.handedness} ${button}`;
      const down = Boolean(source.gamepad.buttons[button]?.pressed);
      if (down && !this.pressed.has(key)) this.connection.send(event === "stop" ? { type: "stop" } : { type: "press", event });
      down ? this.pressed.add(key) : this.pressed.delete(key);
    }
  }
}

function pose({ transform }) {
  return { position: values(transform.position, 3), orientation: values(transform.orientation, 4) };
}

function values(point, count) {
  return [point.x, point.y, point.z, point.w].slice(0, count);
}

function unit(value) {
  return Math.max(0, Math.min(1, value));
}
