// Draw over the taxels: normals, shear, contacts, names of parts, and rings around chosen taxels.

import { isCurrent } from "./marks.js";
import { areOver, FONT, widthOf } from "./names.js";
import { GROUND, INK } from "./palette.js";

const MOST_ARROWS = 8000;
const NORMAL_LENGTH = 1.6; // in radii of a taxel
const SHEAR_LENGTH = 2.4; // in radii, of the strongest shear
const LEAST_SHEAR = 3; // of 127
const CORNERS = [[1, -1], [-1, -1], [1, 1], [-1, 1]]; // of a contact, right and down, for its number
const HIDDEN = 0.35; // how much of a contact on the far side is seen

export class Overlay {
  constructor(host) {
    this.canvas = document.createElement("canvas");
    this.canvas.className = "over";
    this.context = this.canvas.getContext("2d");
    host.append(this.canvas);
  }

  /**
   * Draw one moment whole; nothing of an earlier one stays.
   * @param {object} stage where things are, with the sheets that are shown.
   * @param {object} what `theme`, `normals` (shown or not), `names` (as Names.place makes them), `contacts`,
   *     `hovered` ({sheet, i} or null), `pins` ([{sheet, i, letter}]).
   */
  draw(stage, what) {
    const ratio = Math.min(devicePixelRatio, 2);
    const [width, height] = [Math.round(stage.width * ratio), Math.round(stage.height * ratio)];
    if (this.canvas.width !== width) this.canvas.width = width;
    if (this.canvas.height !== height) this.canvas.height = height;
    this.context.resetTransform();
    this.context.clearRect(0, 0, width, height);
    this.context.scale(ratio, ratio);
    this.ink = `rgb(${INK[what.theme]})`;
    this.ground = `rgb(${GROUND[what.theme]})`;
    for (const sheet of stage.sheets) {
      if (what.normals) this.#normals(stage, sheet);
      if (sheet.shown.shear) this.#shear(stage, sheet);
    }
    const labels = [...what.names]; // and numbers of the largest contacts; those without a free place are left out
    for (const contact of [...what.contacts].sort((a, b) => b.load - a.load)) this.#contact(stage, contact, labels);
    for (const name of what.names) this.#name(name);
    for (const { sheet, i, letter } of what.pins) this.#ring(stage, sheet, i, letter);
    if (what.hovered) this.#ring(stage, what.hovered.sheet, what.hovered.i, "");
  }

  #normals(stage, sheet) {
    const { context } = this;
    context.beginPath();
    for (let i = 0; i < Math.min(sheet.n, MOST_ARROWS); i++) {
      const { at, normal, isAway } = facing(stage, sheet, i);
      if (isAway || !(normal[0] || normal[1] || normal[2])) continue;
      const length = NORMAL_LENGTH * sheet.radius[i];
      const [x, y, depth] = stage.project(...at);
      if (depth <= 0) continue;
      context.moveTo(x, y);
      context.lineTo(...stage.project(...at.map((v, c) => v + length * normal[c])).slice(0, 2));
    }
    this.#stroke(1);
  }

  /** Arrows in the plane of the skin; those too short to mean anything are left out. */
  #shear(stage, sheet) {
    const { shear, marks } = sheet.shown;
    const { context } = this;
    context.beginPath();
    for (let i = 0; i < Math.min(sheet.n, MOST_ARROWS); i++) {
      const [along, across] = [shear[2 * i], shear[2 * i + 1]];
      if (Math.hypot(along, across) < LEAST_SHEAR || !isCurrent(marks[i])) continue;
      const { at, normal, isAway } = facing(stage, sheet, i);
      if (isAway) continue;
      const [e1, e2] = planeOf(normal);
      const scale = (SHEAR_LENGTH * sheet.radius[i]) / 127;
      const tip = at.map((v, c) => v + scale * (along * e1[c] + across * e2[c]));
      const [x1, y1, depth] = stage.project(...at);
      if (depth <= 0) continue;
      const [x2, y2] = stage.project(...tip);
      arrow(context, x1, y1, x2, y2);
    }
    this.#stroke(1.6);
  }

  #contact(stage, contact, labels) {
    const { at } = contact;
    const { x, y, size } = ringOf(stage, contact);
    if (!size) return;
    const { context } = this;
    const eye = stage.camera.position.toArray();
    const normal = contact.normal ?? [0, 0, 0];
    const isAway = normal.reduce((sum, n, c) => sum + n * (eye[c] - at[c]), 0) < 0;
    context.globalAlpha = isAway ? HIDDEN : 1;
    context.beginPath();
    context.arc(x, y, size, 0, 2 * Math.PI);
    this.#stroke(2);
    if (normal.some((n) => n)) {
      context.beginPath();
      const [nx, ny] = stage.project(...at.map((v, c) => v + 0.02 * normal[c]));
      arrow(context, x, y, nx, ny);
      this.#stroke(2);
    }
    const text = String(contact.id);
    const away = 0.72 * size + 8;
    const places = CORNERS.map(([right, down]) => ({ width: widthOf(text) + 10, x: x + right * away, y: y + down * away }));
    const number = places.find((place) => !labels.some((other) => areOver(place, other)));
    if (number) {
      labels.push(number);
      this.#tag(text, number.x, number.y);
    }
    context.globalAlpha = 1;
  }

  #name({ text, x, y, alpha }) {
    const { context } = this;
    context.globalAlpha = alpha;
    context.font = FONT;
    context.textAlign = "center";
    context.textBaseline = "middle";
    context.lineWidth = 3;
    context.lineJoin = "round";
    context.strokeStyle = this.ground;
    context.strokeText(text, x, y);
    context.fillStyle = this.ink;
    context.fillText(text, x, y);
    context.globalAlpha = 1;
  }

  #ring(stage, sheet, i, letter) {
    const [x, y, depth] = stage.project(...sheet.place(i));
    if (depth <= 0) return;
    const size = Math.max((sheet.radius[i] * stage.pixels) / depth, 3) + 3;
    this.context.beginPath();
    this.context.arc(x, y, size, 0, 2 * Math.PI);
    this.#stroke(1.8);
    if (letter) this.#tag(letter, x + 0.7 * size + 8, y - 0.7 * size - 8);
  }

  /** Ink with a hem of the ground, which is seen on every colour. */
  #stroke(width) {
    const { context } = this;
    context.lineWidth = width + 2;
    context.strokeStyle = this.ground;
    context.stroke();
    context.lineWidth = width;
    context.strokeStyle = this.ink;
    context.stroke();
  }

  #tag(text, x, y) {
    const { context } = this;
    context.font = FONT;
    context.textAlign = "center";
    context.textBaseline = "middle";
    const half = Math.max(8, widthOf(text) / 2 + 5);
    context.beginPath();
    context.roundRect(x - half, y - 8, 2 * half, 16, 8);
    context.fillStyle = this.ink;
    context.fill();
    context.fillStyle = this.ground;
    context.fillText(text, x, y + 0.5);
  }
}

/** The ring of a contact in the picture, CSS pixels; its size is 0 behind the eye. */
export function ringOf(stage, { at, area_m2 }) {
  const [x, y, depth] = stage.project(...at);
  return { x, y, size: depth > 0 && Math.max(10, (Math.sqrt((area_m2 || 0) / Math.PI) * stage.pixels) / depth) };
}

function facing(stage, sheet, i) {
  const at = [...sheet.place(i)];
  const normal = [...sheet.normal.subarray(3 * i, 3 * i + 3)];
  const eye = stage.camera.position;
  const isAway = normal[0] * (eye.x - at[0]) + normal[1] * (eye.y - at[1]) + normal[2] * (eye.z - at[2]) < 0;
  return { at, normal, isAway };
}

/** Two directions in the plane of a normal: the first as near to x as it can be. */
export function planeOf([x, y, z]) {
  if (!(x || y || z)) return [[1, 0, 0], [0, 1, 0]];
  const first = Math.abs(x) < 0.95 ? [1 - x * x, -x * y, -x * z] : [-y * x, 1 - y * y, -y * z];
  const length = Math.hypot(...first);
  const e1 = first.map((v) => v / length);
  return [e1, [y * e1[2] - z * e1[1], z * e1[0] - x * e1[2], x * e1[1] - y * e1[0]]];
}

function arrow(context, x1, y1, x2, y2) {
  context.moveTo(x1, y1);
  context.lineTo(x2, y2);
  const angle = Math.atan2(y2 - y1, x2 - x1);
  const head = Math.min(6, 0.4 * Math.hypot(x2 - x1, y2 - y1));
  for (const side of [-0.5, 0.5]) {
    context.moveTo(x2, y2);
    context.lineTo(x2 - head * Math.cos(angle + side), y2 - head * Math.sin(angle + side));
  }
}
