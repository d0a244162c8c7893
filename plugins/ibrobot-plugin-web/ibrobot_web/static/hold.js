// The deadman: the robot moves while something is held, and a message says so 25 times a second. Letting go, leaving the
// page, hiding it, or losing the connection releases it; the run releases it by itself if messages stay away.

const PERIOD_MS = 40;

export class Deadman {
  constructor(drive) {
    this.drive = drive;
    this.request = null;
    this.press = Date.now();
    this.timer = null;
    this.listeners = new Set();
    const release = () => this.release();
    for (const event of ["blur", "pagehide", "freeze"]) window.addEventListener(event, release);
    for (const event of ["pointerup", "pointercancel"]) window.addEventListener(event, release, true);
    document.addEventListener("visibilitychange", () => { if (document.hidden) this.release(); });
    window.addEventListener("contextmenu", release);
    drive.addEventListener("operator", () => { if (!drive.facts.operating) this.release(); });
    drive.addEventListener("refused", release);
  }

  get held() { return this.request !== null; }

  // `request` is a function that returns the present motion: {joints, targets, linear, turn, pose}.
  hold(request) {
    if (!this.drive.facts.operating || document.hidden) return;
    this.press = Math.max(this.press + 1, Date.now());
    this.request = request;
    this.send();
    clearInterval(this.timer);
    this.timer = setInterval(() => this.send(), PERIOD_MS);
    this.notify();
  }

  send() {
    if (this.request) this.drive.tell("jog", { ...this.request(), press: this.press });
  }

  release() {
    if (!this.request) return;
    this.request = null;
    clearInterval(this.timer);
    this.drive.tell("release");
    this.notify();
  }

  notify() {
    for (const listener of this.listeners) listener(this.held);
  }

  // Makes a button move the robot while it is held, by pointer or by Enter.
  button(element, request) {
    element.classList.add("hold");
    element.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      event.preventDefault();
      element.focus();
      this.hold(request);
    });
    element.addEventListener("keydown", (event) => {
      if (event.key === "Enter" && !event.repeat) this.hold(request);
      if (event.key === "Enter") event.preventDefault();
    });
    for (const event of ["keyup", "blur"]) element.addEventListener(event, () => this.release());
    return element;
  }
}
