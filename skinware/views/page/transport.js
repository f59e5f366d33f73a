// Time: pause, 30 s to scroll back, and the controls of recordings.

import { h, setChildren, setHidden, setPressed, setText } from "./dom.js";
import { clock } from "./format.js";
import { Timeline } from "./timeline.js";

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

/** The controls of the recordings that are shown; all go together, unless one is moved on its timeline with shift. */
export class ReplayControls {
  #rows = []; // a timeline and a clock of each
  #from_s = []; // times at the begin of a drag

  /** @param {(action: string, value: ?(number | boolean), number: ?number) => void} act */
  constructor(host, act) {
    this.host = host;
    this.act = act;
    this.replays = [];
    const button = (text, title, onclick) => h("button", { type: "button", title, onclick }, text);
    this.play = button("Pause", "Stop or go on (space)", () => this.toggle());
    this.back = button("Back", "One sample back (,)", () => this.step(-1));
    this.on = button("Step", "One sample on (.)", () => this.step(1));
    this.speed = h("select", { "aria-label": "Speed" }, ...SPEEDS.map((x) => h("option", { value: x }, `${x}×`)));
    this.speed.addEventListener("change", () => act("speed", Number(this.speed.value)));
    this.loop = button("Loop", "Begin again at the end", () => act("loop", !this.replays[0].loop));
    this.list = h("div", { class: "timelines" });
    host.append(this.play, this.back, this.on, this.speed, this.loop, this.list);
  }

  get isPaused() {
    return this.replays.every(({ paused }) => paused);
  }

  /** Pause or go on; at the end, begin again. */
  toggle() {
    if (this.replays.every(({ time_s, duration_s }) => time_s >= duration_s)) this.act("seek", 0);
    this.act(this.isPaused ? "resume" : "pause", null);
  }

  /** Go so many samples on, or back. */
  step(samples) {
    if (this.replays.length) this.act("step", samples);
  }

  /** Go so far on, or back. */
  scroll(by_s) {
    this.#seek(0, this.replays[0].time_s + by_s);
  }

  /** @param {object} how `alone`: the others stay; `goesOn`: a drag, in which their distances stay. */
  #seek(number, time_s, { alone = false, goesOn = false } = {}) {
    if (!goesOn) this.#from_s = this.replays.map((replay) => replay.time_s);
    const by_s = time_s - this.#from_s[number];
    this.replays.forEach(({ duration_s }, i) => {
      if (!alone || i === number) this.act("seek", Math.max(0, Math.min(duration_s, this.#from_s[i] + by_s)), i);
    });
  }

  update(replays, outlines) {
    setHidden(this.host, !replays.length);
    this.replays = replays;
    if (!replays.length) return;
    while (this.#rows.length < replays.length) this.#rows.push(this.#row(this.#rows.length));
    this.#rows.length = replays.length;
    setChildren(this.list, this.#rows.map(({ row }) => row));
    setText(this.play, this.isPaused ? "Play" : "Pause");
    const [{ speed, loop }] = replays;
    setPressed(this.loop, Boolean(loop));
    if (![...this.speed.options].some(({ value }) => Number(value) === speed)) {
      this.speed.append(h("option", { value: speed }, `${speed}×`));
    }
    if (document.activeElement !== this.speed) this.speed.value = String(speed);
    replays.forEach((replay, i) => {
      const { row, name, timeline, when } = this.#rows[i];
      setText(name, replay.title ?? "Replay");
      setText(when, `${clock(replay.time_s)} of ${clock(replay.duration_s)}`);
      row.title = replay.file ?? "";
      timeline.update(replay, outlines[i] ?? {});
    });
  }

  #row(number) {
    const timeline = new Timeline((time_s, how) => this.#seek(number, time_s, how));
    const [name, when] = [h("span", { class: "name" }), h("output")];
    return { timeline, name, when, row: h("div", { class: "past" }, name, timeline.element, when) };
  }
}
