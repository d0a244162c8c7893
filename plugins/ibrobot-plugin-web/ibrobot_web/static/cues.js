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
    this.context ??= new AudioContext();
    this.context.resume();
    TONES_HZ[cue].forEach((frequency, i) => {
      const tone = new OscillatorNode(this.context, { frequency }), volume = new GainNode(this.context, { gain: LOUD });
      tone.connect(volume).connect(this.context.destination);
      tone.start(this.context.currentTime + i * STEP_S);
      tone.stop(this.context.currentTime + i * STEP_S + TONE_S);
    });
  }
}
