// A phone without WebXR: its orientation sensors turn the tool, the sticks on the screen move it.

import { fromDeviceOrientation, headingOf } from "/static/pose.js";

const WITHOUT_SENSOR = [0, 0, 0, 1];
const PERIOD_MS = 1000 / 70; // at most once in a frame of 60 Hz

export class Phone {
  constructor(controls, connection, arm) {
    this.controls = controls;
    this.connection = connection;
    this.arm = arm;
    this.orientation = null;
    this.running = false;
    this.last = 0;
  }

  // Call it from a tap: iPhones ask for permission only then.
  async start() {
    const asks = window.DeviceOrientationEvent?.requestPermission;
    if (asks && (await asks.call(window.DeviceOrientationEvent)) !== "granted") throw new Error("the sensors are not permitted");
    window.addEventListener("deviceorientation", (event) => {
      if (event.alpha !== null) this.orientation = fromDeviceOrientation(event.alpha, event.beta, event.gamma);
    });
    this.running = true;
    const frame = (now) => {
      if (!this.running) return;
      if (now - this.last >= PERIOD_MS) {
        this.last = now;
        this.send();
      }
      requestAnimationFrame(frame);
    };
    requestAnimationFrame(frame);
  }

  stop() {
    this.running = false;
  }

  send() {
    const orientation = this.orientation ?? WITHOUT_SENSOR;
    const hand = { position: null, orientation, ...this.controls.read() };
    this.connection.sendHands({ [this.arm()]: hand }, headingOf(orientation));
  }
}
