// The WebSocket to the robot: sends poses, and receives states and images. It connects again by itself.

const RETRY_MS = 500;
const SILENT_MS = 300; // without an answer for this long, the network counts as lost

export class Connection {
  constructor({ onState, onImage, onLink }) {
    this.onState = onState;
    this.onImage = onImage;
    this.onLink = onLink;
    this.number = 0;
    this.sentAt = new Map();
    this.roundTrips = [];
    this.answers = [];
    this.inControl = false;
    this.open();
    setInterval(() => this.report(), 250);
  }

  open() {
    this.socket = new WebSocket(`wss://${location.host}/socket`);
    this.socket.binaryType = "arraybuffer";
    this.socket.onmessage = (event) => this.receive(event.data);
    this.socket.onclose = () => {
      this.inControl = false;
      this.sentAt.clear();
      setTimeout(() => this.open(), RETRY_MS);
    };
  }

  receive(data) {
    if (data instanceof ArrayBuffer) {
      const camera = new Uint8Array(data, 0, 1)[0];
      this.onImage(camera, new Blob([new Uint8Array(data, 1)], { type: "image/jpeg" }), () => this.send({ type: "shown", camera }));
      return;
    }
    const message = JSON.parse(data);
    if (message.type === "echo") {
      const now = performance.now();
      this.roundTrips = [...this.roundTrips.slice(-59), now - this.sentAt.get(message.n)];
      this.answers = [...this.answers.slice(-59), now];
      // Answers arrive in order: earlier ones that are missing are lost.
      for (const n of this.sentAt.keys()) if (n <= message.n) this.sentAt.delete(n);
    } else if (message.type === "state") {
      this.inControl = message.control === "you";
      this.onState(message);
    }
  }

  send(message) {
    // Skip poses while the network is congested: a late pose is worthless.
    if (this.socket.readyState === WebSocket.OPEN && (message.type !== "hands" || this.socket.bufferedAmount < 4096)) {
      this.socket.send(JSON.stringify(message));
      return true;
    }
    return false;
  }

  sendHands(hands, heading) {
    if (!this.inControl) return;
    const now = performance.now();
    const n = ++this.number;
    if (this.send({ type: "hands", n, t: now / 1000, heading, hands })) {
      this.sentAt.set(n, now);
      if (this.sentAt.size > 600) this.sentAt.delete(this.sentAt.keys().next().value);
    }
  }

  report() {
    const now = performance.now();
    const recent = this.answers.filter((time) => now - time < 1000);
    const median = [...this.roundTrips].sort((a, b) => a - b)[this.roundTrips.length >> 1];
    const oldest = this.sentAt.size ? this.sentAt.values().next().value : now;
    this.onLink({
      open: this.socket.readyState === WebSocket.OPEN,
      silent: now - oldest > SILENT_MS,
      rate: recent.length,
      roundTrip: median,
    });
  }
}
