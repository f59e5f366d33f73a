// Save a picture of the view, and control a recording, which the server makes.

import { h, save, setPressed, setText, stamp } from "./dom.js";
import { bytes, clock } from "./format.js";

/** Save what the view shows as a PNG file. */
export function savePicture(stage, overlay) {
  stage.draw(); // the browser keeps no picture by WebGL once it was shown
  const { canvas } = stage.view;
  const both = h("canvas", { width: canvas.width, height: canvas.height });
  const context = both.getContext("2d");
  for (const layer of [canvas, overlay.canvas]) context.drawImage(layer, 0, 0, both.width, both.height);
  both.toBlob((blob) => save(blob, `skin-${stamp()}.png`));
}

/** Show on its button how far a recording has come; null: none is made. */
export function showRecording(button, recording) {
  setPressed(button, Boolean(recording));
  const missed = recording?.missed ? `, ${recording.missed} missed` : "";
  setText(button.lastElementChild, recording ? `${clock(recording.s)} · ${bytes(recording.bytes)}${missed}` : "Record");
  button.title = recording ? `${recording.file} (r ends it)` : "Record (r)";
}
