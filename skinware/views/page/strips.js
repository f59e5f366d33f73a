// The strips: lines are dragged or clicked into them; they share one window of time and one cursor.

import { button, h, save, setChildren, setHidden, setPressed, setText, stamp } from "./dom.js";
import { figure, measure } from "./format.js";
import { CanvasPen, saveFigure } from "./pens.js";
import { KEPT_S, placeOf } from "./series.js";
import { colourOf, dashOf, drawFigure, drawSpectrum, drawTimes, figureHeight, MOST_LINES, plotOf, valueAt } from "./strip.js";

const MOST = 16; // lines in all
const LEAST_S = 0.05;
const ZOOM = 1.25;
const EVERY_MS = 90; // that a line moves by a pixel or two
const STEPS = 100; // of the cursor, from one end to the other
const FIGURE = { width: 720, height: 260 };
const NOTHING = { times: new Float64Array(0), values: new Float64Array(0) };

class Strip {
  constructor(strips, unit) {
    this.strips = strips;
    this.unit = unit;
    this.lines = [];
    this.chosen = 0; // the line whose spectrum is shown
    this.isSpectrum = false;
    this.cursor_hz = null;
    this.legend = h("ul", { class: "lines" });
    this.canvas = h("canvas", { tabindex: 0, role: "slider", "aria-valuemin": -KEPT_S, "aria-valuemax": 0, "data-role": "strip-canvas" });
    this.spectrum = button("Spectrum", "How much of a line swings at each frequency", () => this.toggle());
    const files = ["csv", "svg", "png"].map((kind) => button(kind.toUpperCase(), `Save as ${kind.toUpperCase()}`, () => this.save(kind)));
    const close = button("✕", "Close this strip", () => strips.close(this), { class: "plain", "aria-label": "Close this strip" });
    const tools = h("div", { class: "tools" }, this.spectrum, ...files, close);
    this.element = h("article", { class: "strip", "data-role": "strip" }, h("header", {}, this.legend, tools), this.canvas);
    this.#listen();
  }

  #listen() {
    const { canvas, strips } = this;
    const at = (event) => (event.clientX - canvas.getBoundingClientRect().left - this.plot.x) / this.plot.width;
    let dragged = null;
    const fingers = new Map(); // by pointer, where they are on the canvas
    const pinched = () => Math.max(1e-2, Math.abs([...fingers.values()].reduce((one, other) => one - other)));
    canvas.addEventListener("pointermove", (event) => {
      if (fingers.size === 2 && fingers.has(event.pointerId)) {
        const before = pinched();
        fingers.set(event.pointerId, at(event));
        return strips.zoom(before / pinched(), [...fingers.values()].reduce((one, other) => (one + other) / 2));
      }
      if (dragged !== null && event.buttons) dragged = strips.pan(dragged, at(event));
      this.point(at(event));
    });
    canvas.addEventListener("pointerdown", (event) => {
      dragged = at(event);
      if (event.pointerType === "touch") fingers.set(event.pointerId, dragged);
      canvas.setPointerCapture(event.pointerId);
    });
    for (const end of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(end, ({ pointerId }) => {
        fingers.delete(pointerId);
        dragged = null;
      });
    }
    canvas.addEventListener("pointerleave", () => this.point(null));
    canvas.addEventListener("dblclick", () => strips.zoom(Infinity));
    const wheel = (event) => {
      event.preventDefault();
      strips.zoom(event.deltaY < 0 ? 1 / ZOOM : ZOOM, at(event));
    };
    canvas.addEventListener("wheel", wheel, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      const actions = {
        ArrowLeft: () => strips.step(this, -1),
        ArrowRight: () => strips.step(this, 1),
        "+": () => strips.zoom(1 / ZOOM),
        "-": () => strips.zoom(ZOOM),
        Home: () => this.point(0),
        End: () => this.point(1),
      };
      if (!actions[event.key]) return;
      event.preventDefault();
      actions[event.key]();
    });
    this.element.addEventListener("dragover", (event) => event.preventDefault());
    this.element.addEventListener("drop", (event) => strips.drop(event, this));
  }

  get plot() {
    return plotOf({ width: this.canvas.clientWidth, height: this.canvas.clientHeight });
  }

  toggle() {
    this.isSpectrum = !this.isSpectrum;
    this.cursor_hz = null;
    this.strips.draw();
  }

  /** The cursor is at a part of the width; null: nowhere. */
  point(part) {
    const isIn = part !== null && part >= 0 && part <= 1;
    if (this.isSpectrum) this.cursor_hz = isIn && this.shown ? part * this.shown.step_hz * (this.shown.amplitude.length - 1) : null;
    else this.strips.point(isIn ? part : null);
    this.strips.draw();
  }

  #what(size, theme) {
    const window = this.strips.window;
    const lines = this.lines.map((line) => this.strips.dataOf(line));
    return { ...size, ...window, theme, lines, unit: this.unit, cursor_hz: this.cursor_hz };
  }

  /** The values of the line whose spectrum is shown, within the window. */
  #within({ from, to, lines }) {
    const { times, values } = lines[this.chosen] ?? NOTHING;
    const [begin, end] = [placeOf(times, from), placeOf(times, to + 1)];
    return { times: times.subarray(begin, end), values: values.subarray(begin, end) };
  }

  #paint(pen, what) {
    if (this.isSpectrum) this.shown = drawSpectrum(pen, what, this.#within(what), this.chosen);
    else drawTimes(pen, what);
  }

  draw(isWhole) {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!width || !height) return;
    const ratio = Math.min(devicePixelRatio, 2);
    const [wide, tall] = [Math.round(width * ratio), Math.round(height * ratio)];
    if (this.canvas.width !== wide) this.canvas.width = wide;
    if (this.canvas.height !== tall) this.canvas.height = tall;
    const context = this.canvas.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    const what = this.#what({ width, height }, this.strips.theme);
    this.#paint(new CanvasPen(context), what);
    if (!isWhole) return;
    setPressed(this.spectrum, this.isSpectrum);
    this.#label(what);
  }

  /** The legend, with the values at the cursor, or the newest. */
  #label(what) {
    const { theme } = what;
    while (this.legend.children.length < this.lines.length) this.legend.append(this.#item());
    setChildren(this.legend, [...this.legend.children].slice(0, this.lines.length));
    const texts = this.lines.map((line, k) => {
      const item = this.legend.children[k];
      const [name, value] = item.children;
      name.style.setProperty("--line", colourOf(theme, k));
      name.style.setProperty("--style", dashOf(k).length ? "dashed" : "solid");
      name.setAttribute("aria-pressed", String(this.isSpectrum && k === this.chosen));
      setText(name, labelOf(line, this.strips.lines));
      const found = this.#valueOf(what, k);
      setText(value, found);
      return `${line.label} ${found}`;
    });
    const now_s = what.cursor_ns === null ? 0 : (what.cursor_ns - what.to) / 1e9;
    this.canvas.setAttribute("aria-label", `Plot of ${this.lines.map(({ label }) => label).join(", ")}; arrows move the cursor, + and - zoom`);
    this.canvas.setAttribute("aria-valuenow", now_s.toFixed(2));
    this.canvas.setAttribute("aria-valuetext", `${now_s.toFixed(2)} s: ${texts.join(", ")}`);
  }

  #valueOf(what, k) {
    if (!this.isSpectrum) return measure(valueAt(what.lines[k], what.cursor_ns ?? what.to), this.unit);
    if (k !== this.chosen || !this.shown || this.cursor_hz === null) return "";
    const bin = Math.round(this.cursor_hz / this.shown.step_hz);
    return `${figure(bin * this.shown.step_hz)} Hz: ${measure(this.shown.amplitude[bin], this.unit)}`;
  }

  #item() {
    const item = h("li", {}, h("button", { type: "button", class: "plain line", title: "Its spectrum" }), h("output"));
    const place = () => [...this.legend.children].indexOf(item);
    item.firstChild.addEventListener("click", () => {
      if (!this.isSpectrum || this.chosen === place()) this.isSpectrum = !this.isSpectrum;
      this.chosen = place();
      this.strips.draw();
    });
    const remove = h("button", { type: "button", class: "plain", "aria-label": "Remove this line" }, "✕");
    remove.addEventListener("click", () => this.strips.remove(this.lines[place()]));
    item.append(remove);
    return item;
  }

  /** Save what is shown: the values as a table, or the figure on a light ground. */
  save(kind) {
    const name = `skin-plot-${stamp()}`;
    const what = this.#what(FIGURE, "light");
    if (kind === "csv") return save(new Blob([this.#table(what)], { type: "text/csv" }), `${name}.csv`);
    const shown = this.isSpectrum ? [this.chosen] : this.lines.map((_, k) => k);
    const labels = shown.map((k) => ({ k, text: labelOf(this.lines[k], this.strips.lines) }));
    const size = { width: FIGURE.width, height: figureHeight(FIGURE.height, labels.length) };
    const footer = `${this.isSpectrum ? "Amplitudes. " : ""}${this.strips.footer(this.lines, what.to)}`;
    const clean = { ...what, cursor_ns: null, moment_ns: null, cursor_hz: null };
    return saveFigure(kind, name, size, (pen) => drawFigure(pen, clean, labels, footer, (own, all) => this.#paint(own, all)));
  }

  #table({ from, to, lines }) {
    const rows = new Map(); // time -> a cell of each line
    lines.forEach(({ times, values }, k) => {
      for (let i = placeOf(times, from); i < times.length && times[i] <= to; i++) {
        if (Number.isNaN(values[i])) continue;
        if (!rows.has(times[i])) rows.set(times[i], lines.map(() => ""));
        rows.get(times[i])[k] = String(values[i]);
      }
    });
    const head = this.lines.map((line) => `"${labelOf(line, this.strips.lines).replaceAll('"', "'")} [${this.unit}]"`);
    const sorted = [...rows].sort((one, other) => one[0] - other[0]);
    return [["time_ns", ...head].join(), ...sorted.map(([time_ns, cells]) => [String(time_ns), ...cells].join()), ""].join("\n");
  }
}

/** What a line is called; a sum of raw values is no load. */
function labelOf(line, lines) {
  if (line.modules === undefined) return line.label;
  const isLoad = lines.get(line.key)?.of === "calm" || line.unit.endsWith("N");
  return `${line.label}, ${isLoad ? "load" : "sum"}`;
}

export class Strips {
  #strips = [];
  #frozen = null; // copies of the values, while time stands still
  #span_s = KEPT_S;
  #end_ns = null; // of the window; null: now
  #drawn_ms = 0;

  /**
   * @param {HTMLElement} host
   * @param {Lines} lines of series.js.
   * @param {object} parts `now_ns()`; `shift_ns(line)`: from its times to those of the axis; `isRecorded()`: times are
   *     those since a recording began; `marks()`; `moment_s()`: seconds back of what is shown, null: none;
   *     `footer(lines, time_ns)`: whose values, of when; `changed()`: other lines; `refuse(text)`; `find(key)`: the
   *     line that is dragged.
   */
  constructor(host, lines, parts) {
    Object.assign(this, { host, lines, parts, theme: "dark", cursor_ns: null });
    this.span = h("output");
    const step = (text, label, times) => button(text, label, () => this.zoom(times), { "aria-label": label });
    const zoom = h("div", { class: "group" }, step("−", "More seconds", ZOOM), step("+", "Fewer seconds", 1 / ZOOM));
    this.head = h("header", {}, h("h2", {}, "Plots"), this.span, zoom);
    this.hint = h("p", { class: "hint drop" }, "Drop it here for a strip of its own.");
    this.list = h("div", { class: "strips" });
    host.append(this.head, this.list, this.hint);
    this.hint.addEventListener("dragover", (event) => event.preventDefault());
    this.hint.addEventListener("drop", (event) => this.drop(event, null));
  }

  footer(lines, time_ns) {
    return this.parts.footer(lines, time_ns);
  }

  /** All lines, the upper strips' first. */
  get all() {
    return this.#strips.flatMap(({ lines }) => lines);
  }

  /** Add a line to a strip; undefined: where lines of its unit are; null: to one of its own. */
  add(line, strip = undefined) {
    if (this.all.some(({ key }) => key === line.key)) {
      if (strip === undefined) return;
      this.remove(line);
    }
    if (this.all.length >= MOST) return this.parts.refuse(`${MOST} lines are shown: remove one first.`);
    const fits = (one) => one.unit === line.unit && one.lines.length < MOST_LINES;
    let into = strip && fits(strip) && this.#strips.includes(strip) ? strip : strip === undefined ? this.#strips.find(fits) : null;
    if (!into) this.#strips.push((into = new Strip(this, line.unit)));
    into.lines.push(line);
    this.#changed();
  }

  /** What an address keeps, strip by strip; contacts come and go. */
  get kept() {
    const plain = ({ key, label, unit, taxel, driver, type, modules }) => ({ key, label, unit, taxel, driver, type, modules });
    const strips = this.#strips.map(({ lines }) => lines.filter(({ contact }) => contact === undefined).map(plain));
    return strips.filter((lines) => lines.length);
  }

  /** Show the lines of an address. */
  restore(kept) {
    for (const lines of kept) lines.forEach((line, i) => this.add(line, i ? this.#strips.at(-1) : null));
  }

  remove(line) {
    for (const strip of this.#strips) strip.lines = strip.lines.filter(({ key }) => key !== line.key);
    this.#strips = this.#strips.filter(({ lines }) => lines.length);
    for (const strip of this.#strips) strip.chosen = Math.min(strip.chosen, strip.lines.length - 1);
    this.#changed();
  }

  close(strip) {
    strip.lines = [];
    this.remove({ key: "" });
  }

  /** Something was dropped on a strip, or beside all. */
  drop(event, strip) {
    event.preventDefault();
    const line = this.parts.find(event.dataTransfer.getData("text/plain"));
    if (line) this.add(line, strip);
  }

  #changed() {
    setChildren(this.list, this.#strips.map(({ element }) => element));
    setHidden(this.head, !this.#strips.length);
    setHidden(this.host, !this.#strips.length);
    this.parts.changed();
    this.draw();
  }

  /** Let time stand still, or go on. */
  freeze(isFrozen) {
    const kept = this.parts.isRecorded() ? [] : this.all; // what was recorded stays as it is
    this.#frozen = isFrozen ? new Map(kept.map(({ key }) => [key, this.lines.get(key)?.copy()])) : null;
    this.frozen_ns = this.parts.now_ns();
    this.#end_ns = null;
    this.draw();
  }

  dataOf(line) {
    const kept = this.#frozen?.get(line.key) ?? this.lines.get(line.key);
    if (!kept) return NOTHING;
    const shift_ns = this.parts.shift_ns(line);
    return { times: shift_ns ? kept.times.map((time_ns) => time_ns + shift_ns) : kept.times, values: kept.values };
  }

  get #now_ns() {
    return this.#frozen ? this.frozen_ns : this.parts.now_ns();
  }

  /** What of time is shown. */
  get window() {
    const to = this.#end_ns ?? this.#now_ns;
    const back_s = this.parts.moment_s();
    const moment_ns = this.#frozen && back_s !== null ? this.frozen_ns + 1e9 * back_s : null;
    const isRecorded = this.parts.isRecorded();
    return { from: to - 1e9 * this.#span_s, to, isRecorded, marks: this.parts.marks(), cursor_ns: this.cursor_ns, moment_ns };
  }

  point(part) {
    const { from, to } = this.window;
    this.cursor_ns = part === null ? null : from + part * (to - from);
  }

  step(strip, by) {
    const { from, to } = this.window;
    const part = strip.isSpectrum ? (strip.cursor_hz ?? 0) / (strip.shown?.rate_hz / 2 || 1) : ((this.cursor_ns ?? to) - from) / (to - from);
    strip.point(Math.max(0, Math.min(1, part + by / STEPS)));
  }

  /** Show so many times the seconds; while time stands still, what is at a part of the width stays there. */
  zoom(times, part = 1) {
    const { to } = this.window;
    const before_s = this.#span_s;
    this.#span_s = Math.min(KEPT_S, Math.max(LEAST_S, before_s * times));
    if (this.#frozen) this.#end_ns = this.#bounded(to - 1e9 * (1 - part) * (before_s - this.#span_s));
    this.draw();
  }

  /** Move the window, while time stands still. @returns {number} the part of the width that the pointer has now. */
  pan(from, to) {
    if (!this.#frozen) return to;
    this.#end_ns = this.#bounded(this.window.to - 1e9 * (to - from) * this.#span_s);
    return to;
  }

  #bounded(end_ns) {
    return Math.min(this.frozen_ns, Math.max(this.frozen_ns - 1e9 * (KEPT_S - this.#span_s), end_ns));
  }

  /** @param {boolean} isWhole with the figures beside the lines; else the lines, as often as their movement needs. */
  draw(isWhole = true) {
    if (!this.#strips.length || (!isWhole && performance.now() - this.#drawn_ms < EVERY_MS)) return;
    this.#drawn_ms = performance.now();
    const missed = this.lines.missed ? `, ${this.lines.missed} samples missed` : "";
    setText(this.span, `${figure(this.#span_s)} s${missed}`);
    for (const strip of this.#strips) strip.draw(isWhole);
  }

  /** What is shown, for tests: lines, with their newest samples. */
  get state() {
    return this.#strips.map(({ lines, unit, isSpectrum, shown }) => ({
      unit,
      spectrum: isSpectrum && shown ? { step_hz: shown.step_hz, amplitude: [...shown.amplitude] } : null,
      span_s: this.#span_s,
      lines: lines.map((line) => {
        const { times, values } = this.dataOf(line);
        return { key: line.key, label: line.label, times: [...times], values: [...values] };
      }),
    }));
  }
}
