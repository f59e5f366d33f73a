// The meaning of colours and marks: each scale in use with its ends, unit and drivers, and the marks in view with their counts.

import { byId, h, setChildren, setHidden, setPressed, setText } from "./dom.js";
import { count, figure, prefixed, range } from "./format.js";
import { DIMMED, FRESH, MARKS } from "./marks.js";
import { gradient } from "./palette.js";
import { CLEAR, inksOf, signOf } from "./signs.js";

const SIZE = 16;
const MIDDLE_LEVEL = 90; // for marks that show a value

export class Legend {
  #items = new Map(); // mark -> element
  #versions = "";

  /** @param {(scale: ?number[]) => void} choose called with the ends of the scale, null: as it fits. */
  constructor(choose) {
    this.low = byId("low");
    this.high = byId("high");
    this.marks = byId("marks");
    this.scales = byId("scales");
    this.factor = 1; // from the numbers that are shown to the unit of the values
    const both = () => {
      const scale = [this.low, this.high].map(({ valueAsNumber }) => valueAsNumber * this.factor);
      if (scale.every(Number.isFinite) && scale[0] < scale[1]) choose(scale);
    };
    this.low.addEventListener("change", both);
    this.high.addEventListener("change", both);
    byId("auto").addEventListener("click", () => choose(null));
  }

  setTheme(theme) {
    this.theme = theme;
    byId("gradient").style.background = gradient(theme);
    this.#items.clear();
    this.#versions = "";
    this.scales.replaceChildren();
  }

  /**
   * @param {Sheet[]} sheets what is drawn; @param {Sheet[]} chosen of these, those that are selected, or all.
   * @param {?number[]} fixed ends that a person chose; they hold for all sheets.
   */
  update(sheets, chosen, fixed) {
    const scales = scalesOf(chosen);
    const isCommon = unitsOf(sheets).size < 2;
    setHidden(byId("scale"), !isCommon);
    if (isCommon && scales.length) this.#setCommon(scales, fixed);
    setHidden(this.scales, isCommon && scales.length < 2);
    const rows = isCommon && scales.length < 2 ? [] : scales.map((scale) => this.#row(scale));
    if (rows.map(({ title }) => title).join() !== [...this.scales.children].map(({ title }) => title).join()) {
      this.scales.replaceChildren(...rows);
    }
    const versions = sheets.map(({ driver, marksVersion }) => `${driver.key}:${marksVersion}`).join();
    if (versions === this.#versions) return;
    this.#versions = versions;
    const counts = new Array(MARKS.length).fill(0);
    for (const { shown } of sheets) for (const mark of shown.marks) counts[mark & ~DIMMED]++;
    const present = MARKS.map((_, mark) => mark).filter((mark) => mark !== FRESH && counts[mark]);
    setChildren(this.marks, present.map((mark) => this.#item(mark, counts[mark])));
  }

  /** The ends that can be changed, of sheets of one unit; empty where the sheets have different ends. */
  #setCommon(scales, fixed) {
    const [{ low, high, unit }] = scales;
    const ends = fixed ?? (scales.length < 2 ? [low, high] : null);
    const isTyped = [this.low, this.high].includes(document.activeElement);
    const [factor, own] = isTyped ? [this.factor, byId("unit").textContent] : prefixed(unit, Math.max(...(ends ?? [0]).map(Math.abs)));
    this.factor = factor;
    for (const [input, end] of [[this.low, ends?.[0]], [this.high, ends?.[1]]]) {
      if (document.activeElement !== input) input.value = ends ? figure(end / factor).replaceAll(",", "") : "";
    }
    const words = ends ? `colours from ${range(...ends, unit).join(" to ")}` : "colours, see the scales of the drivers";
    byId("gradient").setAttribute("aria-label", words);
    setText(byId("unit"), own);
    setPressed(byId("auto"), fixed === null);
  }

  #row({ low, high, unit, names }) {
    const bar = h("div", { class: "gradient", "aria-hidden": "true" });
    bar.style.background = gradient(this.theme);
    const [from, to] = range(low, high, unit);
    const who = names.join(", ");
    return h("div", { class: "scale", title: `${from} to ${to}: ${who}` }, h("span", {}, from), bar, h("span", {}, to), h("span", {}, who));
  }

  #item(mark, n) {
    const item = this.#items.get(mark) ?? h("span", { class: "mark" }, picture(mark, this.theme), h("span"));
    this.#items.set(mark, item);
    setText(item.lastChild, `${MARKS[mark].name} ${count(n)}`);
    return item;
  }
}

/** The different scales of sheets: `low`, `high`, `unit`, and `names` of what has it. */
export function scalesOf(sheets) {
  const scales = new Map();
  for (const { shown, unit, driver, type } of sheets) {
    const [low, high] = shown.scale;
    const key = `${low} ${high} ${unit}`;
    if (!scales.has(key)) scales.set(key, { low, high, unit, names: [] });
    scales.get(key).names.push(`${driver.name} ${type}`);
  }
  return [...scales.values()];
}

/** The units of sheets; one scale that a person chooses can hold for one unit only. */
export function unitsOf(sheets) {
  return new Set(sheets.map(({ unit }) => unit));
}

/** A mark as it looks in the skin. */
export function picture(mark, theme) {
  const size = Math.round(SIZE * Math.min(devicePixelRatio, 2));
  const canvas = h("canvas", { width: size, height: size, class: "sign", "aria-hidden": "true" });
  const context = canvas.getContext("2d");
  const image = context.createImageData(size, size);
  const pixels = new Uint32Array(image.data.buffer);
  const inks = inksOf(theme)[CLEAR];
  const radius = size / 2;
  for (let at = 0; at < pixels.length; at++) {
    const [u, v] = [((at % size) + 0.5) / radius - 1, 1 - (Math.floor(at / size) + 0.5) / radius];
    const r = Math.hypot(u, v);
    if (r <= 1) pixels[at] = signOf(mark, u, v, r, radius, MIDDLE_LEVEL, inks);
  }
  context.putImageData(image, 0, 0);
  return canvas;
}
