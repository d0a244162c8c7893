// The deadman: the robot moves while something is held, and a message says so up to 25 times a second. Letting go, leaving
// the page, hiding it, a stall of the page or of the connection, or losing it releases it. The run counts only messages
// that are young, and after a release of any kind only a press that began later.

const PERIOD_MS = 40;
const STALL_MS = 200;

export class Deadman {
  constructor(drive) {
    this.drive = drive;
    this.request = null;
    this.timer = null;
    this.released = 0;
    this.listeners = new Set();
    const release = () => {
      this.released = performance.now();
      this.release();
    };
    for (const event of ["blur", "pagehide", "freeze"]) window.addEventListener(event, release);
    for (const event of ["pointerup", "pointercancel"]) window.addEventListener(event, release, true);
    document.addEventListener("visibilitychange", () => { if (document.hidden) release(); });
    window.addEventListener("contextmenu", release);
    drive.addEventListener("operator", () => { if (!drive.facts.operating) release(); });
  }

  get held() { return this.request !== null; }

  // `request` is a function that returns the present motion: {joints, targets, linear, turn, pose}. A press that began
  // `since` and was released before the call, as by leaving the page, does not count.
  hold(request, since = performance.now()) {
    if (since < this.released || !this.drive.facts.operating || document.hidden) return;
    this.press = this.drive.clock.now();
    if (this.press === null) return;
    this.request = request;
    this.alive = performance.now();
    this.asked = null;
    this.send();
    clearInterval(this.timer);
    this.timer = setInterval(() => this.beat(), PERIOD_MS);
    this.notify();
  }

  beat() {
    const now = performance.now();
    const stalled = now - this.alive > STALL_MS;
    const slow = this.asked !== null && now - this.asked > STALL_MS;
    this.alive = now;
    if (stalled) this.refuse("this page stalled");
    else if (slow) this.refuse("the connection is too slow to jog");
    else this.send();
  }

  // One message at a time is on its way, so that none queues in a slow network, where it would arrive late.
  async send() {
    if (!this.request || this.asked !== null || !this.drive.idle) return;
    const { press } = this;
    this.asked = performance.now();
    try {
      await this.drive.call("jog", { at: this.drive.clock.now(), press, ...this.request() });
      if (this.press === press) this.asked = null;
    } catch (error) {
      if (this.press === press) this.refuse(error.message);
    }
  }

  refuse(why) {
    if (!this.request) return;
    this.end();
    this.drive.emit("refused", `${why}: released; press again`);
  }

  release() {
    if (!this.request) return;
    // Behind a message that is still on its way it would come after the run's own limit, and delay a STOP.
    if (this.asked === null || performance.now() - this.asked < STALL_MS) this.drive.tell("release", { at: this.drive.clock.now() });
    this.end();
  }

  end() {
    this.request = null;
    clearInterval(this.timer);
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
