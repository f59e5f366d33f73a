// Cards with everything about one taxel: the one under the pointer, and the pinned ones.

import { h, setChildren, setHidden, setText } from "./dom.js";
import { age, figure, measure, range } from "./format.js";
import { markOf, NO_ACK, statusText } from "./marks.js";
import { noiseOf, pathOf, piecesOf, rangeOf } from "./curves.js";
import { placeOf } from "./series.js";

const SVG = "http://www.w3.org/2000/svg";
const ROWS = ["raw", "age", "noise", "uid", "driver"];
const [WIDTH, HEIGHT, MARGIN] = [220, 44, 3];
const SHOWN_S = 10;

class Card {
  constructor(probe, plotting, close) {
    this.probe = probe;
    this.plotting = plotting;
    this.letter = h("b", { class: "letter" });
    this.name = h("strong");
    this.value = h("output", { class: "value" });
    this.status = h("span", { class: "status" });
    this.cells = Object.fromEntries(ROWS.map((row) => [row, h("dd")]));
    this.line = document.createElementNS(SVG, "path");
    this.svg = document.createElementNS(SVG, "svg");
    this.svg.setAttribute("viewBox", `0 0 ${WIDTH} ${HEIGHT}`);
    this.svg.setAttribute("preserveAspectRatio", "none");
    this.svg.setAttribute("role", "img");
    this.svg.append(this.line);
    this.span = h("small");
    this.element = h(
      "article",
      { class: "card", "data-role": close ? "pin" : null, "data-key": probe.key },
      h(
        "header",
        {},
        close ? this.letter : null,
        this.name,
        close ? plotting.button(() => plotting.taxel(probe)) : null,
        close ? h("button", { type: "button", class: "plain", "aria-label": "Let go", onclick: close }, "✕") : null,
      ),
      h("p", {}, this.value, this.status),
      this.svg,
      this.span,
      h("dl", {}, ...ROWS.flatMap((row) => [h("dt", {}, row), this.cells[row]])),
    );
    if (close) plotting.draggable(this.element, () => plotting.taxel(probe));
  }

  update(past) {
    const { probe } = this;
    const { sheet, i } = probe;
    const shown = past ? past(probe) : probe.exact;
    setText(this.letter, probe.letter);
    setText(this.name, probe.name);
    const status = shown?.status ?? sheet.shown.status[i];
    const value = markOf(status) < NO_ACK ? shown?.value : null;
    setText(this.value, `${past ? "≈ " : ""}${measure(value, sheet.unit)}`);
    const isOld = sheet.driver.isOld && !past;
    const text = isOld && status === 0 ? "stale: driver silent" : statusText(status);
    setText(this.status, [text, shown?.untouched && "only 0 so far", shown?.why].filter(Boolean).join("; "));
    this.status.dataset.fresh = String(status === 0 && !isOld);
    setText(this.cells.raw, figure(past ? null : shown?.raw));
    setText(this.cells.age, age(past ? null : shown?.age_ms));
    setText(this.cells.uid, `0x${sheet.uid[i].toString(16)}`);
    setText(this.cells.driver, `${sheet.driver.name}, sensor ${probe.position}`);
    this.#draw();
  }

  /** The line of the last seconds. */
  #draw() {
    const series = this.plotting.seriesOf(this.probe);
    const until_ns = this.plotting.until(this.probe);
    if (!series || this.drawn === until_ns) return;
    this.drawn = until_ns;
    const { times, values } = series;
    const window = { from: this.drawn - 1e9 * SHOWN_S, to: this.drawn, width: WIDTH };
    const pieces = piecesOf(times, values, window);
    const shown = values.subarray(placeOf(times, window.from), placeOf(times, window.to + 1));
    setText(this.cells.noise, measure(noiseOf(shown), this.probe.sheet.unit));
    const [low, high] = rangeOf(pieces) ?? [null, null];
    const yOf = (value) => (high === low ? HEIGHT / 2 : HEIGHT - MARGIN - ((value - low) / (high - low)) * (HEIGHT - 2 * MARGIN));
    this.line.setAttribute("d", pieces.map((piece) => pathOf(piece.map(([x, value]) => [x, yOf(value)]))).join(""));
    const text = pieces.length ? `last ${SHOWN_S} s: ${range(low, high, this.probe.sheet.unit).join(" to ")}` : "";
    setText(this.span, text);
    this.svg.setAttribute("aria-label", text || "no values yet");
  }
}

export class Cards {
  #cards = new Map();

  /**
   * @param {HTMLElement} tip where the card of the hovered taxel is.
   * @param {HTMLElement} pins where those of pinned taxels are.
   * @param {Plotting} plotting of plotting.js.
   * @param {(probe: object) => void} release called to unpin.
   */
  constructor(tip, pins, plotting, release) {
    this.plotting = plotting;
    this.tip = tip;
    this.pins = pins;
    this.release = release;
    this.at = [0, 0];
    this.empty = h(
      "p",
      { class: "hint" },
      "Point at a taxel to see its values; click to pin it here. Without a mouse: ",
      h("kbd", {}, "j"),
      " ",
      h("kbd", {}, "k"),
      " and ",
      h("kbd", {}, "p"),
      ". Click a name to plot its load.",
    );
  }

  /**
   * @param {object} probes
   * @param {?Function} past of a probe, what was shown of it then; null: now.
   */
  update(probes, past) {
    const hovered = probes.hovered && !probes.pins.includes(probes.hovered) ? probes.hovered : null;
    if (hovered !== this.hovered) {
      this.hovered = hovered;
      this.tipCard = hovered && new Card(hovered, this.plotting, null);
      this.tip.replaceChildren(...(hovered ? [this.tipCard.element] : []));
    }
    setHidden(this.tip, !hovered);
    this.tipCard?.update(past);
    if (hovered) this.place(...this.at);
    for (const probe of this.#cards.keys()) if (!probes.pins.includes(probe)) this.#cards.delete(probe);
    for (const probe of probes.pins) {
      if (!this.#cards.has(probe)) this.#cards.set(probe, new Card(probe, this.plotting, () => this.release(probe)));
      this.#cards.get(probe).update(past);
    }
    const cards = probes.pins.map((probe) => this.#cards.get(probe).element);
    setChildren(this.pins, cards.length ? cards : [this.empty]);
  }

  /** Put the card of the hovered taxel beside a place of the view. */
  place(x, y) {
    this.at = [x, y];
    const { clientWidth: width, clientHeight: height } = this.tip.parentElement;
    const left = x + 18 + this.tip.offsetWidth < width ? x + 18 : Math.max(4, x - 18 - this.tip.offsetWidth);
    const top = Math.max(4, Math.min(y - 20, height - this.tip.offsetHeight - 8));
    this.tip.style.transform = `translate(${Math.round(left)}px, ${Math.round(top)}px)`;
  }
}
