// From samples to what is drawn: points of a line within a window, the range of values, and the ticks of an axis.

import { placeOf } from "./series.js";

const DENSE = 3; // samples a column, from which on only the extremes of each are drawn

/**
 * The points of a line, in pieces between gaps.
 * @param {Float64Array} times rising; @param {Float64Array} values NaN: a gap.
 * @param {{from: number, to: number, width: number}} window times of its ends, and its width in columns.
 * @returns {[number, number][][]} x in columns, and the value; of each column its first, lowest, highest and last.
 */
export function piecesOf(times, values, { from, to, width }) {
  const begin = Math.max(0, placeOf(times, from) - 1);
  const end = Math.min(times.length, placeOf(times, to) + 1);
  const isDense = end - begin > DENSE * width;
  const pieces = [];
  let piece = null, column = null;
  const close = () => {
    if (column) for (const value of column.order()) piece.push([column.x, value]);
    column = null;
  };
  for (let k = begin; k < end; k++) {
    const value = values[k];
    if (Number.isNaN(value)) {
      close();
      piece = null;
      continue;
    }
    if (!piece) pieces.push((piece = []));
    const x = ((times[k] - from) / (to - from)) * width;
    if (!isDense) piece.push([x, value]);
    else if (column?.x === Math.floor(x)) column.add(value);
    else {
      close();
      column = new Column(Math.floor(x), value);
    }
  }
  close();
  return pieces;
}

class Column {
  constructor(x, value) {
    this.x = x;
    this.first = this.low = this.high = this.last = value;
  }

  add(value) {
    this.low = Math.min(this.low, value);
    this.high = Math.max(this.high, value);
    this.last = value;
  }

  order() {
    const inner = this.last >= this.first ? [this.low, this.high] : [this.high, this.low];
    const all = [this.first, ...inner, this.last];
    return all.filter((value, i) => i === 0 || value !== all[i - 1]);
  }
}

/** The lowest and the highest value of pieces; null without any. */
export function rangeOf(pieces) {
  let [low, high] = [Infinity, -Infinity];
  for (const piece of pieces) {
    for (const [, value] of piece) {
      low = Math.min(low, value);
      high = Math.max(high, value);
    }
  }
  return low <= high ? [low, high] : null;
}

/** The standard deviation of values from sample to sample, of which a steady rise is no part; null before the third. */
export function noiseOf(values) {
  const steps = [...values.subarray(1)].map((value, k) => value - values[k]).filter(Number.isFinite);
  const mean = steps.reduce((sum, step) => sum + step, 0) / steps.length;
  return steps.length < 2 ? null : Math.sqrt(steps.reduce((sum, step) => sum + (step - mean) ** 2, 0) / steps.length / 2);
}

/** Round numbers from low to high, about `most` of them. */
export function ticksOf(low, high, most) {
  const rough = (high - low) / Math.max(1, most);
  const unit = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((times) => times * unit).find((one) => one >= rough * 0.999);
  if (!Number.isFinite(step) || step <= 0) return [];
  const first = Math.ceil(low / step - 1e-9);
  return Array.from({ length: Math.floor(high / step + 1e-9) - first + 1 }, (_, k) => Number(((first + k) * step).toPrecision(12)));
}

/** Points as a path of SVG. */
export function pathOf(points) {
  return points.map(([x, y], k) => `${k ? "L" : "M"}${x.toFixed(1)} ${y.toFixed(1)}`).join("");
}
