// The 3D view: the main thread's side. Drawing happens in a worker, so that a slow graphics card delays neither the
// deadman nor the stop.

import { h, say } from "./dom.js";

const STEP = 0.1;

export class View3D {
  // `scene`: the address of the robot's shapes; null to give it later, to `load`.
  constructor(section, { onTool = () => {}, onGoal = () => {}, scene = "/api/scene" } = {}) {
    this.section = section;
    this.canvas = h("canvas", {
      tabindex: "0", role: "img",
      "aria-label": "The robot in 3D. Arrow keys turn the view, plus and minus zoom.",
    });
    this.note = h("p", { class: "note" });
    this.legend = h("p", { class: "legend" },
      h("span", { class: "measured" }, "measured"), h("span", { class: "commanded" }, "commanded"),
      h("span", { class: "planned" }, "plan"));
    section.append(this.canvas, this.note, this.legend);
    this.frames = 0;
    this.slides = []; // joints whose positions are metres
    this.ages = [];
    if (!this.canvas.transferControlToOffscreen) {
      say(this.note, "3D needs a newer browser.");
      return;
    }
    this.worker = new Worker("/static/view3d.worker.js", { type: "module" });
    const offscreen = this.canvas.transferControlToOffscreen();
    this.worker.postMessage({ do: "start", canvas: offscreen }, [offscreen]);
    this.worker.onerror = (event) => { say(this.note, `3D failed: ${event.message}`); };
    this.worker.onmessage = ({ data }) => {
      if (data.slides) this.slides = data.slides;
      if (data.problem !== undefined) say(this.note, data.problem);
      if (data.drawn) {
        this.frames += 1;
        this.at = data.handle;
        this.ages = [...this.ages.slice(-499), Date.now() - data.drawn];
      }
      if (data.tool) onTool(data.tool);
      if (data.goal) onGoal(data.goal);
    };
    new ResizeObserver(() => this.resize()).observe(this.canvas);
    this.resize();
    this.listen();
    if (scene) this.load(scene);
  }

  async load(scene) {
    say(this.note, "The server makes the robot's shapes …");
    try {
      const response = await fetch(scene);
      if (!response.ok) throw new Error(await response.text());
      say(this.note, "Loading the robot's shapes …");
      this.tell({ do: "scene", scene: await response.json() });
      say(this.note, "Drawing the robot …");
    } catch (error) {
      say(this.note, `The robot's shapes cannot be loaded: ${error.message}`);
    }
  }

  // Where the tool's handle is in the window [px].
  handle() {
    const box = this.canvas.getBoundingClientRect();
    return [box.left + this.at[0], box.top + this.at[1]];
  }

  tell(message) { this.worker?.postMessage(message); }

  resize() {
    const { width, height } = this.canvas.getBoundingClientRect();
    this.tell({ do: "size", width, height, ratio: Math.min(window.devicePixelRatio, 2) });
  }

  listen() {
    const pointers = new Map();
    const at = (event) => {
      const box = this.canvas.getBoundingClientRect();
      return [event.clientX - box.left, event.clientY - box.top];
    };
    this.canvas.addEventListener("pointerdown", (event) => {
      this.canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, at(event));
      const pan = event.button === 2 || event.shiftKey;
      this.tell({ do: "down", at: at(event), pan, fingers: pointers.size, press: performance.now() });
    });
    this.canvas.addEventListener("pointermove", (event) => {
      if (!pointers.has(event.pointerId)) return;
      const before = [...pointers.values()];
      pointers.set(event.pointerId, at(event));
      const now = [...pointers.values()];
      if (now.length === 2) this.tell({ do: "pinch", before, now });
      else this.tell({ do: "move", at: at(event) });
    });
    for (const name of ["pointerup", "pointercancel", "lostpointercapture"]) {
      this.canvas.addEventListener(name, (event) => {
        if (pointers.delete(event.pointerId)) this.tell({ do: "up" });
      });
    }
    this.canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.tell({ do: "zoom", factor: Math.exp(event.deltaY * 0.001) });
    }, { passive: false });
    this.canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    const keys = { ArrowLeft: [-STEP, 0], ArrowRight: [STEP, 0], ArrowUp: [0, STEP], ArrowDown: [0, -STEP] };
    this.canvas.addEventListener("keydown", (event) => {
      if (event.key in keys) this.tell({ do: "turn", by: keys[event.key] });
      else if (event.key === "+" || event.key === "=") this.tell({ do: "zoom", factor: 0.9 });
      else if (event.key === "-") this.tell({ do: "zoom", factor: 1.1 });
      else return;
      event.preventDefault();
    });
  }
}
