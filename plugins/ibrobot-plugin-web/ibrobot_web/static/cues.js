// Cues for an operator who looks at the robot, not at the page: tones, or words where the browser can speak.

import { h } from "./dom.js";

const TONES_HZ = { start: [880], ending: [660, 660], saved: [523, 659, 784] };
const WORDS = { start: "recording", ending: "three seconds", saved: "saved" };
const TONE_S = 0.12, STEP_S = 0.18, LOUD = 0.2;

export class Cues {
  constructor() {
    const names = { tones: "Sound: tones", words: "Sound: spoken", none: "Sound: off" };
    if (!window.speechSynthesis) delete names.words;
    this.choice = h("select", { "aria-label": "Sound when an episode begins, ends soon and is saved" },
      ...Object.entries(names).map(([value, text]) => h("option", { value }, text)));
    this.choice.value = localStorage.getItem("cues") in names ? localStorage.getItem("cues") : "tones";
    this.choice.addEventListener("change", () => {
      localStorage.setItem("cues", this.choice.value);
      this.play("start");
    });
  }

  // Plays the newest cue of the run, if this page has not played it.
  hear({ cues, cue }) {
    if (this.heard !== undefined && cues > this.heard) this.play(cue);
    this.heard = cues;
  }

  play(cue) {
    if (this.choice.value === "words") window.speechSynthesis.speak(new SpeechSynthesisUtterance(WORDS[cue]));
    if (this.choice.value !== "tones") return;
    sound(TONES_HZ[cue]);
  }
}

// What the operator hears when the guard begins to hold the arm back, if its option `sound` asks for it.
export const GUARD_HZ = [440, 330];
let context;

// Plays tones one after another; a browser is silent until the page was clicked or a key was pressed.
export function sound(frequencies) {
  context ??= new AudioContext();
  context.resume();
  frequencies.forEach((frequency, i) => {
    const tone = new OscillatorNode(context, { frequency }), volume = new GainNode(context, { gain: LOUD });
    tone.connect(volume).connect(context.destination);
    tone.start(context.currentTime + i * STEP_S);
    tone.stop(context.currentTime + i * STEP_S + TONE_S);
  });
}
