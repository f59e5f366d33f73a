// What colours and marks mean: the scale with its ends, and the marks that are in view with how many there are.

import { byId, h, setChildren, setPressed, setText } from "./dom.js";
import { count, figure } from "./format.js";
import { DIMMED, FRESH, MARKS } from "./marks.js";
import { gradient, GROUND, INK } from "./palette.js";

const SIZE = 16;

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
    byId("gradient").setAttribute("aria-label", `colours from ${figure(scale.low)} to ${figure(scale.high)} ${scale.unit}`);
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
    if (!this.#items.has(mark)) this.#items.set(mark, h("span", { class: "mark" }, picture(mark, this.theme), h("span")));
    const item = this.#items.get(mark);
    setText(item.lastChild, `${MARKS[mark].name} ${count(n)}`);
    return item;
  }
}

/** A mark as it looks in the skin. */
export function picture(mark, theme) {
  const ratio = Math.min(devicePixelRatio, 2);
  const canvas = h("canvas", { width: SIZE * ratio, height: SIZE * ratio, class: "sign", "aria-hidden": "true" });
  const context = canvas.getContext("2d");
  const [ground, ink] = [GROUND[theme], INK[theme]];
  const soft = ground.map((x, c) => 0.55 * x + 0.45 * ink[c]);
  const css = (rgb) => `rgb(${rgb.map(Math.round)})`;
  context.scale((SIZE * ratio) / 2, (SIZE * ratio) / 2);
  context.translate(1, 1);
  context.beginPath();
  context.arc(0, 0, 0.84, 0, 7);
  context.clip();
  context.fillStyle = mark <= 4 ? css(theme === "dark" ? [59, 91, 142] : [116, 191, 194]) : css(ground);
  if (mark === 1) context.fillStyle = css(soft.map((x, c) => 0.5 * x + 0.5 * ground[c]));
  context.fillRect(-1, -1, 2, 2);
  context.strokeStyle = context.fillStyle = [2, 3, 4, 8, 9].includes(mark) ? css(ink) : css(soft);
  context.lineWidth = 0.3;
  const circle = (r) => context.beginPath() || context.arc(0, 0, r, 0, 7);
  const lines = (...all) => {
    context.beginPath();
    for (const [x1, y1, x2, y2] of all) context.moveTo(x1, y1) || context.lineTo(x2, y2);
    context.stroke();
  };
  if (mark === 3 || mark === 7) circle(0.3) || context.fill();
  if (mark === 2) circle(0.45) || context.stroke();
  if (mark === 4) lines([-0.6, 0, 0.6, 0], [0, -0.6, 0, 0.6]);
  if (mark === 5) lines([-1, 0, 0, -1], [-1, 1, 1, -1], [0, 1, 1, 0]);
  if (mark === 6) lines([-1, 0, 1, 0]);
  if (mark === 8) lines([-1, -1, 1, 1], [-1, 1, 1, -1]);
  context.lineWidth = mark === 9 ? 0.6 : 0.34;
  if (mark !== 3 && mark !== 4 && mark !== 8) circle(0.84) || context.stroke();
  return canvas;
}
