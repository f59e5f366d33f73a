// The view without WebGL: the same discs, painted into the pixels of a 2-D canvas, the farthest first.

import { Matrix4 } from "./vendor/three.min.js";
import * as marks from "./marks.js";
import { BODY, GROUND } from "./palette.js";
import { CLEAR, DIM, INSIDE, inksOf, signOf } from "./signs.js";
import { outlinesOf } from "./skin.js";

const PLACE = 5; // numbers of a taxel's place: x, y, radius (negative: from inside), slopes of its disc

export class Flat {
  constructor(host, theme) {
    this.canvas = document.createElement("canvas");
    this.context = this.canvas.getContext("2d", { alpha: false, willReadFrequently: true });
    host.prepend(this.canvas);
    this.setTheme(theme);
    this.setSheets([]);
  }

  setTheme(theme) {
    this.theme = theme;
    this.inks = inksOf(theme);
    this.seenFrom = "";
  }

  setSheets(sheets) {
    this.sheets = sheets;
    this.n = sheets.reduce((sum, sheet) => sum + sheet.n, 0);
    this.levels = new Uint8Array(this.n);
    this.marks = new Uint8Array(this.n);
    this.places = new Float32Array(PLACE * this.n);
    this.depths = new Float32Array(this.n);
    this.order = new Uint32Array(this.n);
    this.seenFrom = "";
    this.update();
  }

  setMeshes() {} // a link without depth would only hide taxels

  update() {
    let at = 0;
    for (const { n, shown } of this.sheets) {
      this.levels.set(shown.levels, at);
      this.marks.set(shown.marks, at);
      at += n;
    }
  }

  resize(width, height, ratio) {
    this.canvas.width = Math.round(width * ratio);
    this.canvas.height = Math.round(height * ratio);
    this.image = this.context.createImageData(this.canvas.width, this.canvas.height);
    this.pixels = new Uint32Array(this.image.data.buffer);
    this.seenFrom = "";
  }

  render(camera) {
    if (!this.image) return;
    this.#place(camera);
    this.pixels.set(this.ground);
    for (const at of this.order) this.#paint(at);
    this.context.putImageData(this.image, 0, 0);
  }

  /** Where every taxel is on the canvas; computed again only when the eye or the canvas has moved. */
  #place(camera) {
    const { width, height } = this.canvas;
    const eye = camera.matrixWorldInverse.elements;
    const all = new Matrix4().multiplyMatrices(camera.projectionMatrix, camera.matrixWorldInverse).elements;
    const from = `${all.join()},${width},${height}`;
    if (from === this.seenFrom) return;
    this.seenFrom = from;
    const pixels = height / (2 * Math.tan((camera.fov * Math.PI) / 360));
    const row = (m, r, x, y, z, w) => m[r] * x + m[4 + r] * y + m[8 + r] * z + m[12 + r] * w;
    this.#drawGround((x, y, z) => {
      const depth = row(all, 3, x, y, z, 1);
      return [(0.5 + row(all, 0, x, y, z, 1) / (2 * depth)) * width, (0.5 - row(all, 1, x, y, z, 1) / (2 * depth)) * height];
    });
    let at = 0;
    for (const { n, position, normal, radius } of this.sheets) {
      for (let i = 0; i < n; i++, at++) {
        const x = position[3 * i], y = position[3 * i + 1], z = position[3 * i + 2];
        const a = normal[3 * i], b = normal[3 * i + 1], c = normal[3 * i + 2];
        const depth = row(all, 3, x, y, z, 1);
        const size = depth > 0 ? Math.max((radius[i] * pixels) / depth, 1.2) : 0;
        let facing = 1, up = 0, right = 0;
        if (a || b || c) {
          const nx = row(eye, 0, a, b, c, 0), ny = row(eye, 1, a, b, c, 0), nz = row(eye, 2, a, b, c, 0);
          facing = -(nx * row(eye, 0, x, y, z, 1) + ny * row(eye, 1, x, y, z, 1) + nz * row(eye, 2, x, y, z, 1));
          const steep = Math.abs(nz) < 0.2 ? (nz < 0 ? -0.2 : 0.2) : nz;
          if (size >= 3) {
            right = nx / steep;
            up = ny / steep;
          }
        }
        this.depths[at] = depth;
        this.places[PLACE * at] = (0.5 + row(all, 0, x, y, z, 1) / (2 * depth)) * width;
        this.places[PLACE * at + 1] = (0.5 - row(all, 1, x, y, z, 1) / (2 * depth)) * height;
        this.places[PLACE * at + 2] = facing < 0 ? -size : size;
        this.places[PLACE * at + 3] = right;
        this.places[PLACE * at + 4] = up;
      }
    }
    this.order.forEach((_, i, order) => (order[i] = i));
    this.order.sort((one, other) => this.depths[other] - this.depths[one]);
  }

  /** What is behind all taxels: the fingers and palms of nominal hands. */
  #drawGround(project) {
    const { context, canvas, theme } = this;
    context.fillStyle = `rgb(${GROUND[theme]})`;
    context.fillRect(0, 0, canvas.width, canvas.height);
    context.fillStyle = `rgb(${BODY[theme]})`;
    for (const { n, position } of outlinesOf(this.sheets)) {
      context.beginPath();
      for (let i = 0; i < n; i++) context.lineTo(...project(...position.subarray(3 * i, 3 * i + 3)));
      context.fill();
    }
    this.ground = new Uint32Array(context.getImageData(0, 0, canvas.width, canvas.height).data.buffer);
  }

  #paint(at) {
    const { places, pixels } = this;
    const size = Math.abs(places[PLACE * at + 2]);
    if (size === 0) return;
    const { width, height } = this.canvas;
    const x = places[PLACE * at] - 0.5, y = places[PLACE * at + 1] - 0.5; // as middles of pixels count
    const right = places[PLACE * at + 3], up = places[PLACE * at + 4];
    const mark = this.marks[at] & ~marks.DIMMED;
    const inks = this.inks[this.marks[at] & marks.DIMMED ? DIM : places[PLACE * at + 2] < 0 ? INSIDE : CLEAR];
    const level = this.levels[at];
    const fill = inks.fresh[level];
    const reach = size + 0.5; // half a pixel more: rims are smooth
    const x0 = Math.max(0, Math.ceil(x - reach)), x1 = Math.min(width - 1, Math.floor(x + reach));
    const y0 = Math.max(0, Math.ceil(y - reach)), y1 = Math.min(height - 1, Math.floor(y + reach));
    const inner = ((size - 0.5) / size) ** 2, outer = (reach / size) ** 2;
    for (let py = y0; py <= y1; py++) {
      const v = (y - py) / size;
      for (let px = x0; px <= x1; px++) {
        const u = (px - x) / size;
        const depth = right * u + up * v;
        const rr = u * u + v * v + depth * depth;
        if (rr > outer) continue;
        const colour = mark === marks.FRESH ? fill : signOf(mark, u, v, Math.sqrt(rr), size, level, inks);
        const to = py * width + px;
        pixels[to] = rr < inner ? colour : blended(pixels[to], colour, (1 - Math.sqrt(rr)) * size + 0.5);
      }
    }
  }

  dispose() {
    this.canvas.remove();
  }
}

/** One packed colour over another, of which a share of the pixel is covered. */
function blended(under, over, share) {
  let mixed = 0;
  for (const shift of [0, 8, 16]) {
    const [a, b] = [(under >> shift) & 255, (over >> shift) & 255];
    mixed |= Math.round(a + share * (b - a)) << shift;
  }
  return (mixed | (255 << 24)) >>> 0;
}
