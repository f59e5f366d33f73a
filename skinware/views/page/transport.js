// Time: pause, 30 s to scroll back, and the controls of recordings.

import { button, h, setChildren, setHidden, setPressed, setText } from "./dom.js";
import { clock } from "./format.js";
import { Timeline } from "./timeline.js";

const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 4, 8];
const MATCHES = {
  begin: ["their begins", () => 0],
  day: ["time of day", ({ began_s }) => -began_s],
  mark: ["first marks", (_, { events = [] }) => events.find(({ event }) => event === "mark")?.time_s],
};
const BY_HAND = "hand";
const NEAR_S = 0.2; // between matching times while both play, each that of its newest sample: two periods of a slow hand

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
    this.play = button("Pause", "Stop or go on (space)", () => this.toggle());
    this.back = button("Back", "One sample back (,)", () => this.step(-1));
    this.on = button("Step", "One sample on (.)", () => this.step(1));
    this.speed = h("select", { "aria-label": "Speed" }, ...SPEEDS.map((x) => h("option", { value: x }, `${x}×`)));
    this.speed.addEventListener("change", () => act("speed", Number(this.speed.value)));
    this.loop = button("Loop", "Begin again at the end", () => act("loop", !this.replays[0].loop));
    this.match = h("select", {}, ...Object.entries(MATCHES).map(([value, [text]]) => h("option", { value }, text)));
    this.match.append(h("option", { value: BY_HAND }, "by hand"));
    this.match.addEventListener("change", () => this.#rematch());
    this.matching = h("label", { class: "field", title: "What of the recordings is shown at the same moment" }, h("span", {}, "Match"), this.match);
    this.list = h("div", { class: "timelines" });
    host.append(this.play, this.back, this.on, this.speed, this.loop, this.matching, this.list);
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

  /** How much later than in the first recording the moment of each is that matches; undefined: it has none. */
  #offsets_s(of) {
    const at_s = this.replays.map((replay, i) => of(replay, this.outlines[i] ?? {}));
    return at_s.map((time_s) => time_s - at_s[0]);
  }

  /** Bring the others to the moment that matches the one of the first. */
  #rematch() {
    const of = MATCHES[this.match.value]?.[1];
    const [first] = this.replays;
    this.#offsets_s(of ?? (() => NaN)).forEach((offset_s, i) => i && !Number.isNaN(offset_s) && this.#seek(i, first.time_s + offset_s, { alone: true }));
  }

  /** Show by what the recordings match now; what none of them has cannot be chosen. */
  #showMatch() {
    setHidden(this.matching, this.replays.length < 2);
    if (this.replays.length < 2 || document.activeElement === this.match) return;
    const [first] = this.replays;
    const hasEnded = first.time_s >= first.duration_s;
    const doMatch = (offset_s, i) => {
      const { time_s, duration_s } = this.replays[i];
      const away_s = time_s - Math.max(0, Math.min(duration_s, first.time_s + offset_s));
      return Math.abs(away_s) < NEAR_S * Math.max(1, first.speed) || (hasEnded && away_s > 0);
    };
    const found = Object.entries(MATCHES).filter(([, [, of]], k) => {
      const offsets_s = this.#offsets_s(of);
      this.match.options[k].disabled = offsets_s.some(Number.isNaN);
      return offsets_s.every(doMatch);
    });
    const kept = found.find(([value]) => value === this.match.value) ?? found[0];
    this.match.value = kept ? kept[0] : BY_HAND;
  }

  update(replays, outlines) {
    setHidden(this.host, !replays.length);
    [this.replays, this.outlines] = [replays, outlines];
    this.#showMatch();
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
