// The course of a recording: density of samples, losses, contacts, events; where it plays, and a way to go elsewhere.

import { h, setHidden, setText } from "./dom.js";
import { clock } from "./format.js";

const [HEIGHT, BAND, NEAR_PX] = [30, 5, 5];
const STEP_S = 1; // of an arrow key
const [MARK, FAULT, NOTE] = ["--accent", "--bad", "--soft"];
const COLOURS = { mark: MARK, paused: NOTE, closed: NOTE, clock_stepped: NOTE }; // others are faults
const words = ({ event, service, text, why }) => [service, text ?? event.replace("_", " "), why].filter(Boolean).join(": ");

/** What an event is called, and the time at which it was. */
const nameOf = (event) => `${clock(event.time_s)} ${words(event)}`;

export class Timeline {
  #drawn = "";
  #outline = {};
  #replay = { time_s: 0, duration_s: 0 };

  /** @param {(time_s: number, how: object) => void} seek `alone`: with shift; `goesOn`: this is a drag. */
  constructor(seek) {
    this.seek = seek;
    this.canvas = h("canvas", { height: HEIGHT });
    this.tip = h("span", { class: "at", hidden: true });
    this.element = h("div", { class: "timeline", role: "slider", tabindex: 0, "aria-valuemin": 0, "aria-label": "Time in the recording" }, this.canvas, this.tip);
    this.element.addEventListener("pointerdown", (event) => {
      if (event.button) return;
      this.element.setPointerCapture(event.pointerId);
      this.#go(event, false);
    });
    this.element.addEventListener("pointermove", (event) => {
      this.#point(event);
      if (event.buttons & 1) this.#go(event, true);
    });
    this.element.addEventListener("pointerleave", () => setHidden(this.tip, true));
    this.element.addEventListener("keydown", (event) => {
      const { time_s, duration_s } = this.#replay;
      const to = { ArrowRight: time_s + STEP_S, ArrowLeft: time_s - STEP_S, Home: 0, End: duration_s }[event.key];
      if (to === undefined) return;
      event.preventDefault();
      seek(to, { alone: event.shiftKey });
    });
    new ResizeObserver(() => this.draw(true)).observe(this.element);
  }

  /** @param {object} replay its state. @param {object} outline so far; empty where there is none. */
  update(replay, outline) {
    [this.#replay, this.#outline] = [replay, outline];
    this.element.setAttribute("aria-valuemax", replay.duration_s);
    this.element.setAttribute("aria-valuenow", replay.time_s);
    this.element.setAttribute("aria-valuetext", `${clock(replay.time_s)} of ${clock(replay.duration_s)}`);
    this.draw();
  }

  /** The event at a place, CSS pixels; null if there is none. */
  #eventAt(x) {
    const away = (event) => Math.abs(this.#x(event.time_s) - x);
    const near = (this.#outline.events ?? []).filter((event) => away(event) <= NEAR_PX);
    return near.reduce((best, event) => (best && away(best) <= away(event) ? best : event), null);
  }

  #x(time_s) {
    return (time_s / (this.#replay.duration_s || 1)) * this.element.clientWidth;
  }

  #timeAt({ clientX }) {
    const box = this.element.getBoundingClientRect();
    const x = Math.max(0, Math.min(box.width, clientX - box.left));
    return { x, event: this.#eventAt(x), time_s: (x / box.width) * this.#replay.duration_s };
  }

  #go(pointer, goesOn) {
    const { event, time_s } = this.#timeAt(pointer);
    this.seek(event ? event.time_s : time_s, { alone: pointer.shiftKey, goesOn });
  }

  #point(pointer) {
    const { x, event, time_s } = this.#timeAt(pointer);
    const bin = Math.min(Math.floor((time_s / this.#replay.duration_s) * (this.#outline.samples?.length ?? 0)), (this.#outline.samples?.length ?? 1) - 1);
    const [missed = 0, contacts = null] = [this.#outline.missed?.[bin], this.#outline.contacts?.[bin]];
    const facts = [event ? nameOf(event) : clock(time_s)];
    if (missed) facts.push(`${missed} samples missed`);
    if (contacts) facts.push(`${contacts} contact${contacts > 1 ? "s" : ""}`);
    setText(this.tip, facts.join(", "));
    setHidden(this.tip, false);
    this.tip.style.left = `${Math.max(0, Math.min(this.element.clientWidth - this.tip.offsetWidth, x - this.tip.offsetWidth / 2))}px`;
  }

  draw(isForced = false) {
    const { clientWidth: width } = this.element;
    const style = getComputedStyle(this.element);
    const colour = (name) => style.getPropertyValue(name).trim();
    const at = Math.round(this.#x(this.#replay.time_s) * devicePixelRatio);
    const state = [width, at, this.#outline.until_s, colour(MARK)].join();
    if (!width || (state === this.#drawn && !isForced)) return;
    this.#drawn = state;
    this.canvas.width = Math.round(width * devicePixelRatio);
    this.canvas.height = HEIGHT * devicePixelRatio;
    const pen = this.canvas.getContext("2d");
    pen.scale(devicePixelRatio, devicePixelRatio);
    const bar = (from, wide, top, high, name, alpha = 1) => {
      pen.globalAlpha = alpha;
      pen.fillStyle = colour(name);
      pen.fillRect(from, top, wide, high);
    };
    const { samples = [], missed = [], contacts, events = [] } = this.#outline;
    const [wide, most, touched] = [width / (samples.length || 1), Math.max(1, ...samples), Math.max(1, ...(contacts ?? []))];
    const room = HEIGHT - BAND - 2;
    samples.forEach((count, i) => bar(i * wide, wide + 0.3, HEIGHT - (count / most) * room, (count / most) * room, NOTE, 0.35));
    contacts?.forEach((count, i) => count && bar(i * wide, wide + 0.3, 0, BAND, "--good", 0.35 + (0.65 * count) / touched));
    missed.forEach((count, i) => count && bar(i * wide, Math.max(2, wide), HEIGHT - room, room, FAULT));
    for (const event of events) bar(this.#x(event.time_s) - 1, 2, 0, HEIGHT, COLOURS[event.event] ?? FAULT);
    bar(Math.min(at / devicePixelRatio, width - 2), 2, 0, HEIGHT, "--text");
  }
}
