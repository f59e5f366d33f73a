// Time: pause, 30 s to scroll back, and the controls of a replay.

import { h, setHidden, setPressed, setText } from "./dom.js";
import { clock } from "./format.js";

const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 4, 8];

/** Pause and the slider of what was. */
export class Rewind {
  isPaused = false;
  at_s = 0; // how far back of the moment at which it was paused; 0 or less

  /**
   * @param {object} parts `pause`, `slider`, `when`: elements.
   * @param {object} past of history.js.
   * @param {() => void} changed another moment is shown.
   */
  constructor({ pause, slider, when }, past, changed) {
    Object.assign(this, { pause, slider, when, past, changed });
    pause.addEventListener("click", () => this.toggle());
    slider.addEventListener("input", () => this.scroll(Number(slider.value)));
  }

  /** The moment that is shown, ms; null: now. */
  get at_ms() {
    return this.isPaused ? this.paused_ms + 1000 * this.at_s : null;
  }

  toggle() {
    this.isPaused = !this.isPaused;
    this.paused_ms = performance.now();
    this.at_s = 0;
    this.#changed();
  }

  /** Show what was so many seconds before; pauses first. */
  scroll(at_s) {
    if (!this.isPaused) this.toggle();
    this.at_s = Math.max(this.#oldest_s(), Math.min(0, at_s));
    this.#changed();
  }

  #oldest_s() {
    const oldest = this.past.oldest_ms;
    return oldest === null ? 0 : Math.min(0, (oldest - this.paused_ms) / 1000);
  }

  #changed() {
    setPressed(this.pause, this.isPaused);
    setText(this.pause, this.isPaused ? "Go on" : "Pause");
    this.slider.value = String(this.at_s);
    setText(this.when, this.isPaused ? `${this.at_s.toFixed(1)} s` : "live");
    this.when.dataset.live = String(!this.isPaused);
    this.changed();
  }
}

/** The controls of a replay, where what is shown is one. */
export class ReplayControls {
  /** @param {(action: string, value: ?(number | boolean)) => void} act */
  constructor(host, act) {
    this.host = host;
    this.act = act;
    const button = (text, title, onclick) => h("button", { type: "button", title, onclick }, text);
    const toggle = () => act(this.replay.paused ? "resume" : "pause", null);
    this.play = button("Pause", "Stop or go on with the replay", toggle);
    this.back = button("Back", "One frame back (,)", () => this.step(-1));
    this.on = button("Step", "One frame on (.)", () => this.step(1));
    this.slider = h("input", { type: "range", min: 0, step: 0.1, "aria-label": "Time in the recording, seconds" });
    this.slider.addEventListener("change", () => act("seek", Number(this.slider.value)));
    this.speed = h("select", { "aria-label": "Speed" }, ...SPEEDS.map((x) => h("option", { value: x }, `${x}×`)));
    this.speed.addEventListener("change", () => act("speed", Number(this.speed.value)));
    this.loop = button("Loop", "Begin again at the end", () => act("loop", !this.replay.loop));
    this.when = h("output");
    const { play, back, on, slider, when, speed, loop } = this;
    host.append(h("span", { class: "name" }, "Replay"), play, back, on, slider, when, speed, loop);
  }

  /** Go so many frames on, or back. */
  step(frames) {
    if (this.replay) this.act("step", frames);
  }

  update(replay) {
    setHidden(this.host, !replay);
    this.replay = replay;
    if (!replay) return;
    setText(this.play, replay.paused ? "Play" : "Pause");
    setPressed(this.loop, Boolean(replay.loop));
    this.slider.max = replay.duration_s;
    if (!this.slider.matches(":active")) this.slider.value = replay.time_s;
    if (![...this.speed.options].some(({ value }) => Number(value) === replay.speed)) {
      this.speed.append(h("option", { value: replay.speed }, `${replay.speed}×`));
    }
    if (document.activeElement !== this.speed) this.speed.value = String(replay.speed);
    setText(this.when, `${clock(replay.time_s)} of ${clock(replay.duration_s)}`);
    this.host.title = replay.file ?? "";
  }
}
