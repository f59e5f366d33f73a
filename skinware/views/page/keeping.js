// Save a picture of the view for papers, and control a recording, which the server makes.

import { h, setPressed, setText, stamp } from "./dom.js";
import { bytes, clock, range } from "./format.js";
import { scalesOf } from "./legend.js";
import { ramp, TOP } from "./palette.js";
import { saveFigure } from "./pens.js";
import { groundOf, inkOf, softOf } from "./strip.js";

const [MARGIN, ROW, BAR] = [12, 18, { width: 160, height: 9, steps: 50 }];

/**
 * Save what the view shows, with its scales, units, drivers and time.
 * @param {"png" | "svg"} kind
 * @param {string} footer what is shown, of whom and when.
 */
export function savePicture(kind, stage, overlay, theme, footer) {
  stage.draw(); // the browser keeps no picture by WebGL once it was shown
  const { canvas } = stage.view;
  const both = h("canvas", { width: canvas.width, height: canvas.height });
  for (const layer of [canvas, overlay.canvas]) both.getContext("2d").drawImage(layer, 0, 0, both.width, both.height);
  const { width, height } = stage;
  const scales = scalesOf(stage.sheets);
  const size = { width, height: height + ROW * (scales.length + 1) + MARGIN };
  const draw = (pen) => {
    pen.rect(0, 0, size.width, size.height, groundOf(theme));
    pen.image(0, 0, width, height, both.toDataURL());
    scales.forEach((scale, row) => drawScale(pen, scale, theme, height + ROW * row));
    pen.text(MARGIN, height + ROW * scales.length + 14, footer, softOf(theme));
  };
  return saveFigure(kind, `skin-${stamp()}`, size, draw, canvas.width / width);
}

function drawScale(pen, { low, high, unit, names }, theme, y) {
  const colours = ramp(theme);
  const [from, to] = range(low, high, unit);
  pen.text(MARGIN + 62, y + 14, from, inkOf(theme), { anchor: "end" });
  for (let step = 0; step < BAR.steps; step++) {
    const level = Math.round((step / (BAR.steps - 1)) * TOP);
    const x = MARGIN + 70 + (step * BAR.width) / BAR.steps;
    pen.rect(x, y + 6, BAR.width / BAR.steps + 0.5, BAR.height, `rgb(${colours.slice(4 * level, 4 * level + 3).join(",")})`);
  }
  pen.text(MARGIN + 78 + BAR.width, y + 14, `${to}   ${names.join(", ")}`, inkOf(theme));
}

/** Show on its button how far a recording has come; null: none is made. */
export function showRecording(button, recording) {
  setPressed(button, Boolean(recording));
  const missed = recording?.missed ? `, ${recording.missed} missed` : "";
  setText(button.lastElementChild, recording ? `${clock(recording.s)} · ${bytes(recording.bytes)}${missed}` : "Record");
  button.title = recording ? `${recording.file} (r ends it)` : "Record (r)";
}
