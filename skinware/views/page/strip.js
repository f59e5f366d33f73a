// One strip: lines of one unit over the same seconds, or the spectrum of one of them; drawn with either pen.

import { piecesOf, rangeOf, ticksOf } from "./curves.js";
import { clock, figure, measure, prefixed } from "./format.js";
import { GROUND, INK } from "./palette.js";
import { placeOf } from "./series.js";
import { spectrumOf } from "./spectrum.js";

export const MOST_LINES = 6;
const COLOURS = {
  dark: ["#56b4e9", "#e69f00", "#2fd6a3", "#e58cc0", "#f0e442", "#ff8a4c"],
  light: ["#0072b2", "#b85a00", "#00785a", "#a3357a", "#6f6000", "#3d3d3d"],
};
const DASHES = [[], [7, 3], [2, 2], [9, 3, 2, 3], [1, 3], [14, 4]]; // lines differ without colours, too
const [LEFT, RIGHT, TOP, BOTTOM] = [58, 10, 16, 18];
const [TICK_X, TICK_Y] = [90, 26]; // pixels between ticks, at least
const LEGEND_LINE = 15;

export const colourOf = (theme, k) => COLOURS[theme][k % MOST_LINES];
export const dashOf = (k) => DASHES[k % MOST_LINES];

/** The rectangle of a figure in which the lines are. */
export function plotOf({ width, height }) {
  return { x: LEFT, y: TOP, width: Math.max(1, width - LEFT - RIGHT), height: Math.max(1, height - TOP - BOTTOM) };
}

/** The value of a line at a time: of the newest sample until then; NaN without one. */
export function valueAt({ times, values }, time_ns) {
  const k = placeOf(times, time_ns + 1) - 1;
  return k < 0 ? NaN : values[k];
}

/**
 * Draw values over time.
 * @param {object} pen of pens.js.
 * @param {object} what `width`, `height`, `theme`, `from` and `to` (ns), `lines` ([{times, values}]), `unit`,
 *     `marks` ([{time_ns, text}]), `cursor_ns`, `moment_ns` (null: none), `isRecorded`: times began with a recording.
 */
export function drawTimes(pen, what) {
  const plot = plotOf(what);
  const { from, to } = what;
  const pieces = what.lines.map(({ times, values }) => piecesOf(times, values, { from, to, width: plot.width }));
  const [low, high] = roomFor(rangeOf(pieces.flat()));
  const xOf = (time_ns) => plot.x + ((time_ns - from) / (to - from)) * plot.width;
  const span_s = (to - from) / 1e9;
  const most = plot.width / TICK_X;
  const seconds = what.isRecorded
    ? ticksOf(from / 1e9, to / 1e9, most).filter((s) => s >= 0).map((s) => [xOf(1e9 * s), clock(s)])
    : ticksOf(-span_s, 0, most).map((s) => [xOf(to + 1e9 * s), `${figure(s)} s`]);
  const yOf = axes(pen, what, plot, [low, high], seconds);
  pen.within(plot.x, plot.y, plot.width, plot.height, () => {
    pieces.forEach((own, k) => {
      const style = { width: 1.5, dash: dashOf(k) };
      for (const piece of own) {
        const points = piece.map(([x, value]) => [plot.x + x, yOf(value)]);
        if (points.length === 1) points.push([points[0][0] + 1.5, points[0][1]]);
        pen.line(points, colourOf(what.theme, k), style);
      }
    });
    for (const { time_ns, text } of what.marks) {
      if (time_ns < from || time_ns > to) continue;
      upright(pen, plot, xOf(time_ns), inkOf(what.theme), { dash: [4, 3] });
      pen.text(xOf(time_ns) + 4, plot.y + 10, text, inkOf(what.theme));
    }
    for (const time_ns of [what.cursor_ns, what.moment_ns]) {
      if (time_ns !== null && time_ns !== undefined) upright(pen, plot, xOf(time_ns), inkOf(what.theme));
    }
  });
}

/** Draw the spectrum of a line; `cursor_hz` is null without a cursor. @returns {?object} see spectrum.js. */
export function drawSpectrum(pen, what, { times, values }, k) {
  const plot = plotOf(what);
  const spectrum = spectrumOf(times, values);
  if (!spectrum) {
    pen.rect(0, 0, what.width, what.height, groundOf(what.theme));
    pen.text(plot.x + plot.width / 2, plot.y + plot.height / 2, "too few values for a spectrum", inkOf(what.theme), { anchor: "middle" });
    return null;
  }
  const { step_hz, amplitude } = spectrum;
  const most_hz = step_hz * (amplitude.length - 1);
  const highest = amplitude.reduce((one, other) => Math.max(one, other), 0) || 1;
  const xOf = (hz) => plot.x + (hz / most_hz) * plot.width;
  const hertz = ticksOf(0, most_hz, plot.width / TICK_X).map((hz) => [xOf(hz), `${figure(hz)} Hz`]);
  const yOf = axes(pen, what, plot, [0, highest * 1.08], hertz);
  pen.within(plot.x, plot.y, plot.width, plot.height, () => {
    const points = [...amplitude].map((value, bin) => [xOf(bin * step_hz), yOf(value)]);
    pen.line(points, colourOf(what.theme, k), { width: 1.5 });
    if (what.cursor_hz !== null && what.cursor_hz !== undefined) upright(pen, plot, xOf(what.cursor_hz), inkOf(what.theme));
  });
  const peak = amplitude.indexOf(highest);
  const text = `${figure(peak * step_hz)} Hz: ${measure(highest, what.unit)}`;
  const isRight = peak > amplitude.length / 2;
  pen.text(xOf(peak * step_hz) + (isRight ? -6 : 6), plot.y + 12, text, inkOf(what.theme), { anchor: isRight ? "end" : "start" });
  return spectrum;
}

/** Draw a figure for a file: the strip, its legend, and whose values of when they are. */
export function drawFigure(pen, what, labels, footer, draw) {
  pen.rect(0, 0, what.width, what.height + LEGEND_LINE * (labels.length + 1) + 8, groundOf(what.theme));
  draw(pen, what);
  labels.forEach(({ k, text }, row) => {
    const y = what.height + LEGEND_LINE * (row + 1) - 2;
    pen.line([[LEFT, y - 4], [LEFT + 26, y - 4]], colourOf(what.theme, k), { width: 1.5, dash: dashOf(k) });
    pen.text(LEFT + 32, y, text, inkOf(what.theme));
  });
  pen.text(LEFT, what.height + LEGEND_LINE * (labels.length + 1) + 1, footer, softOf(what.theme), { size: 10 });
}

export const figureHeight = (height, labels) => height + LEGEND_LINE * (labels + 1) + 8;

/** Draw the ground, the axes and the unit. @returns {(value: number) => number} heights of values. */
function axes(pen, { width, height, theme, unit }, plot, [low, high], along) {
  const yOf = (value) => plot.y + plot.height * (1 - (value - low) / (high - low));
  const [factor, own] = prefixed(unit, Math.max(Math.abs(low), Math.abs(high)));
  pen.rect(0, 0, width, height, groundOf(theme));
  for (const value of ticksOf(low, high, plot.height / TICK_Y)) {
    pen.line([[plot.x, yOf(value)], [plot.x + plot.width, yOf(value)]], lineOf(theme), {});
    if (yOf(value) < plot.y + 6) continue; // the unit is there
    pen.text(plot.x - 6, yOf(value) + 4, figure(value / factor), softOf(theme), { anchor: "end" });
  }
  for (const [x, text] of along) {
    pen.line([[x, plot.y + plot.height], [x, plot.y + plot.height + 4]], softOf(theme), {});
    const anchor = x < plot.x + 20 ? "start" : x > plot.x + plot.width - 20 ? "end" : "middle";
    pen.text(x, height - 4, text, softOf(theme), { anchor });
  }
  pen.line([[plot.x, plot.y], [plot.x, plot.y + plot.height], [plot.x + plot.width, plot.y + plot.height]], softOf(theme), {});
  pen.text(plot.x - 6, 11, own, softOf(theme), { anchor: "end" });
  return yOf;
}

function upright(pen, plot, x, colour, style = {}) {
  pen.line([[x, plot.y], [x, plot.y + plot.height]], colour, style);
}

/** A range with some room; also where all values are the same. */
function roomFor(range) {
  if (!range) return [0, 1];
  const [low, high] = range;
  const room = high > low ? 0.06 * (high - low) : Math.abs(high) * 0.05 || 1;
  return [low - room, high + room];
}

const css = (rgb) => `rgb(${rgb.map(Math.round).join(",")})`;
const between = (theme, share) => css(GROUND[theme].map((x, c) => x + share * (INK[theme][c] - x)));
export const groundOf = (theme) => css(GROUND[theme]);
export const inkOf = (theme) => css(INK[theme]);
export const softOf = (theme) => between(theme, 0.66);
const lineOf = (theme) => between(theme, 0.14);
