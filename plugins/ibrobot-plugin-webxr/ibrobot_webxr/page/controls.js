// Buttons and sticks on the screen. Everything is released when a finger lifts, or the page is left in any way.

const DEAD_ZONE = 0.15;
const WAY_PX = 90; // full deflection

export class Pad {
  // An area to hold with a finger: `held`, and how far the finger has slid, `x` to the right and `y` up, -1 to 1.
  constructor(element) {
    this.element = element;
    this.knob = element.querySelector("i");
    this.release();
    element.addEventListener("pointerdown", (event) => {
      event.preventDefault();
      element.setPointerCapture(event.pointerId);
      this.pointer = event.pointerId;
      this.from = [event.clientX, event.clientY];
      this.held = true;
      this.show();
    });
    element.addEventListener("pointermove", (event) => {
      if (event.pointerId !== this.pointer) return;
      this.x = deflection(event.clientX - this.from[0]);
      this.y = deflection(this.from[1] - event.clientY);
      this.show();
    });
    for (const end of ["pointerup", "pointercancel", "lostpointercapture"]) {
      element.addEventListener(end, (event) => event.pointerId === this.pointer && this.release());
    }
    element.addEventListener("contextmenu", (event) => event.preventDefault());
  }

  release() {
    this.pointer = null;
    this.held = false;
    this.x = this.y = 0;
    this.show();
  }

  show() {
    this.element.classList.toggle("held", this.held);
    if (this.knob) this.knob.style.transform = `translate(${this.x * WAY_PX}px, ${-this.y * WAY_PX}px)`;
  }
}

function deflection(pixels) {
  const share = Math.max(-1, Math.min(1, pixels / WAY_PX));
  return Math.abs(share) < DEAD_ZONE ? 0 : share;
}

export class Controls {
  constructor(document) {
    const pad = (id) => new Pad(document.getElementById(id));
    this.clutch = pad("clutch");
    this.stick = pad("stick");
    this.opens = pad("open");
    this.closes = pad("close");
    const release = () => this.release();
    window.addEventListener("blur", release);
    window.addEventListener("pagehide", release);
    document.addEventListener("visibilitychange", release);
  }

  release() {
    for (const pad of [this.clutch, this.stick, this.opens, this.closes]) pad.release();
  }

  // What a phone adds to its pose.
  read() {
    return {
      clutch: this.clutch.held,
      gripper: null,
      open: Number(this.opens.held) - Number(this.closes.held),
      move: [this.stick.x, this.clutch.y, -this.stick.y],
    };
  }
}
