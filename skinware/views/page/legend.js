// What colours and marks mean: the scale with its ends, and the marks that are in view with how many there are.

import { byId, h, setChildren, setPressed, setText } from "./dom.js";
import { count, figure } from "./format.js";
import { DIMMED, FRESH, MARKS } from "./marks.js";
import { gradient } from "./palette.js";
import { CLEAR, inksOf, signOf } from "./signs.js";

const SIZE = 16;
const MIDDLE_LEVEL = 90; // of marks that show a value

export class Legend {
  #items = new Map(); // mark -> element
  #versions = "";

  /** @param {(scale: ?number[]) => void} choose called with the ends of the scale, null: as it fits. */
  constructor(choose) {
    this.low = byId("low");
    this.high = byId("high");
    this.marks = byId("marks");
    const both = () => {
      const scale = [this.low.valueAsNumber, this.high.valueAsNumber];
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
  }

  /** @param {object} scale `low`, `high`, `unit` of what is shown; @param {?number[]} fixed what a person chose. */
  update(scale, fixed, sheets) {
    const ends = fixed ?? [scale.low, scale.high];
    for (const [input, end] of [[this.low, ends[0]], [this.high, ends[1]]]) {
      if (document.activeElement !== input) input.value = figure(end);
    }
    const [low, high] = ends.map(figure);
    byId("gradient").setAttribute("aria-label", `colours from ${low} to ${high} ${scale.unit}`);
    setText(byId("unit"), scale.unit || "");
    setPressed(byId("auto"), fixed === null);
    const versions = sheets.map(({ driver, marksVersion }) => `${driver.key}:${marksVersion}`).join();
    if (versions === this.#versions) return;
    this.#versions = versions;
    const counts = new Array(MARKS.length).fill(0);
    for (const { shown } of sheets) for (const mark of shown.marks) counts[mark & ~DIMMED]++;
    const present = MARKS.map((_, mark) => mark).filter((mark) => mark !== FRESH && counts[mark]);
    setChildren(this.marks, present.map((mark) => this.#item(mark, counts[mark])));
  }

  #item(mark, n) {
    const item = this.#items.get(mark) ?? h("span", { class: "mark" }, picture(mark, this.theme), h("span"));
    this.#items.set(mark, item);
    setText(item.lastChild, `${MARKS[mark].name} ${count(n)}`);
    return item;
  }
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
