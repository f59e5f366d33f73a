// Two pens with which the same figure is drawn: on a canvas, and as SVG for a file.

import { h, save } from "./dom.js";
import { pathOf } from "./curves.js";

const FONT_FAMILY = "system-ui, sans-serif";
const SCALE = 3; // pixels of a saved picture, of one on the screen

/** Draws on a canvas. */
export class CanvasPen {
  constructor(context) {
    this.context = context;
  }

  rect(x, y, width, height, colour) {
    this.context.fillStyle = colour;
    this.context.fillRect(x, y, width, height);
  }

  line(points, colour, { width = 1, dash = [] } = {}) {
    const { context } = this;
    context.beginPath();
    points.forEach(([x, y], k) => (k ? context.lineTo(x, y) : context.moveTo(x, y)));
    context.setLineDash(dash);
    context.lineWidth = width;
    context.strokeStyle = colour;
    context.lineJoin = "round";
    context.stroke();
  }

  text(x, y, text, colour, { anchor = "start", size = 11 } = {}) {
    const { context } = this;
    context.font = `${size}px ${FONT_FAMILY}`;
    context.textAlign = anchor === "middle" ? "center" : anchor;
    context.textBaseline = "alphabetic";
    context.fillStyle = colour;
    context.fillText(text, x, y);
  }

  /** Draw within a rectangle only. */
  within(x, y, width, height, draw) {
    this.context.save();
    this.context.beginPath();
    this.context.rect(x, y, width, height);
    this.context.clip();
    draw();
    this.context.restore();
  }
}

/** Writes SVG. */
class SvgPen {
  #parts = [];
  #clips = 0;

  rect(x, y, width, height, colour) {
    this.#parts.push(`<rect x="${x}" y="${y}" width="${width}" height="${height}" fill="${colour}"/>`);
  }

  line(points, colour, { width = 1, dash = [] } = {}) {
    const dashes = dash.length ? ` stroke-dasharray="${dash.join(" ")}"` : "";
    const stroke = `fill="none" stroke="${colour}" stroke-width="${width}" stroke-linejoin="round"${dashes}`;
    if (points.length) this.#parts.push(`<path d="${pathOf(points)}" ${stroke}/>`);
  }

  text(x, y, text, colour, { anchor = "start", size = 11 } = {}) {
    const font = `font-family="${FONT_FAMILY}" font-size="${size}"`;
    this.#parts.push(`<text x="${x}" y="${y}" ${font} text-anchor="${anchor}" fill="${colour}">${escaped(text)}</text>`);
  }

  image(x, y, width, height, url) {
    this.#parts.push(`<image x="${x}" y="${y}" width="${width}" height="${height}" href="${url}"/>`);
  }

  within(x, y, width, height, draw) {
    const id = `clip${this.#clips++}`;
    this.#parts.push(`<clipPath id="${id}"><rect x="${x}" y="${y}" width="${width}" height="${height}"/></clipPath>`);
    this.#parts.push(`<g clip-path="url(#${id})">`);
    draw();
    this.#parts.push("</g>");
  }

  /** The file. */
  toString(width, height) {
    const size = `width="${width}" height="${height}" viewBox="0 0 ${width} ${height}"`;
    return `<svg xmlns="http://www.w3.org/2000/svg" ${size}>\n${this.#parts.join("\n")}\n</svg>\n`;
  }
}

function escaped(text) {
  return text.replace(/[&<>"]/g, (letter) => `&#${letter.charCodeAt(0)};`);
}

/**
 * Save a figure as a file.
 * @param {"svg" | "png"} kind
 * @param {(pen: SvgPen) => void} draw
 */
export async function saveFigure(kind, name, { width, height }, draw, scale = SCALE) {
  const pen = new SvgPen();
  draw(pen);
  const svg = new Blob([pen.toString(width, height)], { type: "image/svg+xml" });
  if (kind === "svg") return save(svg, `${name}.svg`);
  const url = URL.createObjectURL(svg);
  const image = new Image();
  image.src = url;
  await image.decode();
  const canvas = h("canvas", { width: Math.round(width * scale), height: Math.round(height * scale) });
  canvas.getContext("2d").drawImage(image, 0, 0, canvas.width, canvas.height);
  URL.revokeObjectURL(url);
  canvas.toBlob((blob) => save(blob, `${name}.png`));
}
