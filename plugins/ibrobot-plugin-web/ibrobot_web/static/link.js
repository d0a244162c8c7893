// The two connections to the server: states and pictures, newest only; and commands with their replies.

import { toast } from "./dom.js";

const CHANNELS = { 0: "state", 1: "status", 2: "samples", 3: "plan" };
const FIRST_PICTURE = 16;
const HEAD = 1;
const PICTURE_HEAD = 13;
const TYPES = ["image/jpeg", "", "image/png"];

function address(path) {
  return `${location.protocol === "https:" ? "wss" : "ws"}://${location.host}${path}`;
}

// Emits state, status, samples, plan, picture and connection. Each frame is acknowledged once it is handled, and so the
// server never sends more than the page can show.
export class Stream extends EventTarget {
  constructor() {
    super();
    this.wanted = new Set([0, 1, 3]);
    this.connect();
  }

  connect() {
    this.socket = new WebSocket(address("/stream"));
    this.socket.binaryType = "arraybuffer";
    this.socket.onopen = () => { this.report(true); this.want(); };
    this.socket.onclose = () => { this.report(false); setTimeout(() => this.connect(), 1000); };
    this.socket.onmessage = ({ data }) => this.take(data);
  }

  show(channel, shown) {
    if (this.wanted.has(channel) === shown) return;
    this.wanted[shown ? "add" : "delete"](channel);
    this.want();
  }

  want() {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(new Uint8Array([255, ...this.wanted, 255]));
  }

  async take(data) {
    const channel = new Uint8Array(data, 0, 1)[0];
    try {
      if (channel >= FIRST_PICTURE) await this.picture(channel, data);
      else this.emit(CHANNELS[channel], JSON.parse(new TextDecoder().decode(new Uint8Array(data, HEAD))));
    } finally {
      if (this.socket.readyState === WebSocket.OPEN) this.socket.send(new Uint8Array([channel]));
    }
  }

  async picture(channel, data) {
    const head = new DataView(data, HEAD, PICTURE_HEAD);
    const type = TYPES[head.getUint8(12)];
    try {
      const bitmap = await createImageBitmap(new Blob([new Uint8Array(data, HEAD + PICTURE_HEAD)], { type }));
      this.emit("picture", { channel, bitmap, stamp: Number(head.getBigInt64(0, true)) / 1e6 });
      await new Promise(requestAnimationFrame); // the next one when this one is on the screen; none while hidden
    } catch {
      this.emit("picture", { channel, bitmap: null });
    }
  }

  report(open) { this.emit("connection", { open }); }
  emit(name, detail) { this.dispatchEvent(new CustomEvent(name, { detail })); }
}

const WINDOW_MS = 10000; // clocks drift: the offset is measured anew after one to two windows
const ASK_MS = 2000;

// The robot's time, by what its server says. The least that it can be now: a message takes time to arrive, so what the
// page stamps by it may be younger than its stamp says, never older.
class Clock {
  constructor() { this.last = 0; this.reset(); }

  reset() { this.offsets = []; }

  hear(now) {
    const here = performance.now();
    if (!this.offsets.length || here > this.until) {
      this.offsets = [-Infinity, ...this.offsets.slice(0, 1)];
      this.until = here + WINDOW_MS;
    }
    this.offsets[0] = Math.max(this.offsets[0], now - here);
  }

  // Milliseconds, always later than the last time; null while it is unknown.
  now() {
    if (!this.offsets.length) return null;
    this.last = Math.max(this.last + 1, Math.floor(performance.now() + Math.max(...this.offsets)));
    return this.last;
  }
}

// Emits operator and connection. `call` resolves with the run's answer and rejects with its error.
export class Drive extends EventTarget {
  constructor() {
    super();
    this.number = 0;
    this.waiting = new Map();
    this.clock = new Clock();
    this.stops = null; // number of emergency stops that the page has seen
    this.facts = { operating: false, operator: "", role: "", pages: 0 };
    this.connect();
    setInterval(() => this.call("time").catch(() => {}), ASK_MS);
  }

  get open() { return this.socket.readyState === WebSocket.OPEN; }

  // Whether everything that was sent has left the page.
  get idle() { return this.open && this.socket.bufferedAmount === 0; }

  connect() {
    this.socket = new WebSocket(address("/drive"));
    this.socket.onmessage = ({ data }) => this.take(JSON.parse(data));
    this.socket.onopen = () => this.emit("connection", { open: true });
    this.socket.onclose = () => {
      this.facts = { ...this.facts, operating: false, operator: "" };
      for (const { reject } of this.waiting.values()) reject(new Error("the connection to the robot was lost"));
      this.waiting.clear();
      this.clock.reset();
      this.emit("operator", this.facts);
      this.emit("connection", { open: false });
      setTimeout(() => this.connect(), 1000);
    };
  }

  take(message) {
    if (message.now) this.clock.hear(message.now);
    if (message.event === "operator") {
      this.facts = message;
      this.emit("operator", message);
    } else if (this.waiting.has(message.id)) {
      const { resolve, reject } = this.waiting.get(message.id);
      this.waiting.delete(message.id);
      if ("error" in message) reject(new Error(message.error));
      else resolve(message.ok);
    } else if ("error" in message) {
      this.emit("refused", message.error);
    }
  }

  call(command, facts = {}) {
    if (!this.open) return Promise.reject(new Error("there is no connection to the robot"));
    const id = ++this.number;
    this.socket.send(JSON.stringify({ id, do: command, ...facts }));
    return new Promise((resolve, reject) => this.waiting.set(id, { resolve, reject }));
  }

  // As `call`, for what an emergency stop that the page has not seen makes void.
  command(name, facts = {}) { return this.call(name, { stops: this.stops, ...facts }); }

  // As `command`, and shows the answer or the error; resolves with whether it was carried out.
  async ask(name, facts = {}, done = "") {
    try {
      const answer = await this.command(name, facts);
      if (done || typeof answer === "string") toast(done || answer);
      return true;
    } catch (error) {
      toast(error.message, "error");
      return false;
    }
  }

  // As `ask`, for a service of the run.
  service(name, request = null, done = "") { return this.ask("call", { service: name, request }, done); }

  // Without a reply.
  tell(command, facts = {}) {
    if (this.open) this.socket.send(JSON.stringify({ do: command, ...facts }));
  }

  emit(name, detail) { this.dispatchEvent(new CustomEvent(name, { detail })); }
}

// The emergency stop, on a connection of its own, on which nothing else waits.
export class StopLine {
  constructor() {
    this.number = 0;
    this.waiting = new Map();
    this.connect();
  }

  connect() {
    this.socket = new WebSocket(address("/stop"));
    this.socket.onmessage = ({ data }) => {
      const { id, error } = JSON.parse(data);
      this.waiting.get(id)?.(error);
      this.waiting.delete(id);
    };
    this.socket.onclose = () => setTimeout(() => this.connect(), 1000);
  }

  // Resolves once the run has confirmed the stop; rejects with what it says.
  stop() {
    const id = ++this.number;
    if (this.socket.readyState !== WebSocket.OPEN) return this.request();
    this.socket.send(String(id));
    return new Promise((resolve, reject) => {
      this.waiting.set(id, (error) => (error ? reject(new Error(error)) : resolve()));
    });
  }

  // By another connection, if this one is lost or says nothing.
  async request() {
    const answer = await fetch("/api/stop", { method: "POST", keepalive: true });
    if (!answer.ok) throw new Error((await answer.json()).error);
  }
}
