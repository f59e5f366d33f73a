// Name hands, fingers, pads and boards above their taxels, each while it is large enough in the picture.

import { setHidden } from "./dom.js";
import { measure } from "./format.js";

export const FONT = "600 11px system-ui, sans-serif";
const LINE = 14; // pixels
const [FADED, WHOLE] = [0.8, 1.3]; // size of a part, in widths of its name, from which that is seen, and is seen whole
const FAINTEST = 0.45; // of a name: one that cannot be read only covers taxels
const NUMBERED = 3; // times that size for one of many, "triangle 4", whose neighbours its name would cover
const LINES = [0, 1, 2, 3, 4, -1, -2]; // that a name may stand higher to be free, or lower
const LEAST_SHARE = 0.01; // of the scale, from which a load is in its name
const DIRECTIONS = [-1, 0, 1].flatMap((x) => [-1, 0, 1].flatMap((y) => [-1, 0, 1].map((z) => [x, y, z])));
const ruler = document.createElement("canvas").getContext("2d");
const widths = new Map();

/** Some taxels of a sheet that have one name. */
class Part {
  /** @param {number} size 0 for a pad; larger for what has parts itself. */
  constructor(size, name, sheet, taxels, modules) {
    Object.assign(this, { size, name, sheet, modules });
    this.low = [Infinity, Infinity, Infinity];
    this.high = this.low.map((x) => -x);
    this.normal = [0, 0, 0];
    for (const i of taxels) {
      for (let c = 0; c < 3; c++) {
        this.low[c] = Math.min(this.low[c], sheet.position[3 * i + c] - sheet.radius[i]);
        this.high[c] = Math.max(this.high[c], sheet.position[3 * i + c] + sheet.radius[i]);
        this.normal[c] += sheet.normal[3 * i + c];
      }
    }
    this.middle = this.low.map((low, c) => (low + this.high[c]) / 2);
    this.diameter = Math.hypot(...this.low.map((low, c) => this.high[c] - low));
    const { position } = sheet;
    const outermost = ([x, y, z]) => {
      const far = (i) => x * position[3 * i] + y * position[3 * i + 1] + z * position[3 * i + 2];
      return taxels.reduce((best, i) => (far(i) > far(best) ? i : best));
    };
    this.outline = [...new Set(DIRECTIONS.map(outermost))];
  }

  /** Sum or highest of its loads; null where they are not known. */
  get total() {
    return this.#totalOf(this.sheet.shown.totals);
  }

  /** @param {?Float32Array} loads of all modules; @param {number} from the first of them. */
  #totalOf(loads, from = 0) {
    const totals = loads && this.modules.map((module) => loads[from + module]);
    if (!totals) return null;
    return this.sheet.total === "highest" ? Math.max(...totals) : totals.reduce((sum, load) => sum + load, 0);
  }

  /** The load that its name has: now, or in the mode of peaks the most so far. */
  get load() {
    return this.sheet.shown.mode === "peak" ? this.peak : this.total;
  }

  /** Keep the most, also of the snapshots between two pictures. */
  hold() {
    const { between, driver } = this.sheet;
    if (this.total !== null) this.peak = Math.max(this.peak ?? -Infinity, this.total);
    for (let from = 0; from < (between?.length ?? 0); from += driver.modules.length) {
      this.peak = Math.max(this.peak ?? -Infinity, this.#totalOf(between, from));
    }
  }

  isAway(eye) {
    return this.normal.reduce((sum, n, c) => sum + n * (eye[c] - this.middle[c]), 0) < 0;
  }
}

export class Names {
  #parts = [];

  arrange(sheets) {
    const areSeveral = new Set(sheets.map(({ driver }) => driver)).size > 1;
    this.#parts = sheets.flatMap((sheet) => partsOf(sheet, areSeveral)).sort((a, b) => a.size - b.size);
  }

  /** Those with a load, for a list: hands, fingers, pads that have a name of their own, and boards, as they follow each other. */
  get listed() {
    const listed = this.#parts.filter((part) => part.total !== null && (part.size || !isNumbered(part.name)));
    const firstOf = ({ sheet, modules }) => 1e6 * sheet.driver.id + Math.min(...modules);
    return listed.sort((a, b) => firstOf(a) - firstOf(b) || b.size - a.size);
  }

  /** Keep the most of each part. */
  hold() {
    for (const part of this.#parts) part.hold();
  }

  /** Begin again with what is now the most. */
  release() {
    for (const part of this.#parts) part.peak = null;
    this.hold();
  }

  /** The names of a picture, none over another, no pad's over a ring: [{text, x, y, alpha}], of its middle, CSS pixels. */
  place(stage, rings) {
    const eye = stage.camera.position.toArray();
    const placed = [];
    for (const part of this.#parts) {
      const depth = stage.project(...part.middle)[2];
      const pixels = depth > 0 ? (part.diameter * stage.pixels) / depth : 0;
      const times = isNumbered(part.name) && !part.size ? NUMBERED : 1;
      if (pixels <= FADED * times * widthOf(part.name) || part.isAway(eye)) continue; // most, where there are many
      const { sheet, outline } = part;
      const seen = outline.map((i) => stage.project(...sheet.position.slice(3 * i, 3 * i + 3)));
      const [xs, ys] = [0, 1].map((c) => seen.map((at) => at[c]));
      const radius = (sheet.radius[outline[0]] * stage.pixels) / depth;
      if (isBeside(xs, stage.width) || isBeside(ys, stage.height)) continue;
      const middle = (Math.min(...xs) + Math.max(...xs)) / 2;
      const top = Math.max(Math.min(...ys) - radius - LINE / 2, LINE / 2 + 2);
      const share = (pixels / (times * widthOf(part.name)) - FADED) / (WHOLE - FADED);
      const alpha = Math.min(1, FAINTEST + (1 - FAINTEST) * share);
      const isSeen = part.load > LEAST_SHARE * (part.sheet.shown.scale[1] - part.sheet.shown.scale[0]);
      const whole = isSeen && (part.size || alpha === 1) ? [`${part.name}  ${measure(part.load, part.sheet.unit)}`] : [];
      const lines = part.size ? LINES : [0];
      for (const [text, line] of [...whole, part.name].flatMap((text) => lines.map((line) => [text, line]))) {
        const width = widthOf(text);
        const x = Math.max(width / 2 + 4, Math.min(middle, stage.width - width / 2 - 4));
        const label = { part, text, width, alpha, x, y: top - LINE * line };
        if (label.y < LINE / 2 || placed.some((other) => areOver(label, other))) continue;
        if (!part.size && rings.some((ring) => isOn(label, ring))) continue;
        placed.push(label);
        break;
      }
    }
    return placed;
  }
}

/** The name at a place of the picture; undefined if there is none. */
export function labelAt(labels, x, y) {
  return labels.find((label) => Math.abs(y - label.y) <= LINE / 2 && Math.abs(x - label.x) <= label.width / 2);
}

/** Names are drawn; so that they can be dragged and clicked, an element lies on the one that is pointed at. */
export class Grip {
  constructor(element) {
    this.element = element;
    element.addEventListener("pointerleave", ({ buttons }) => setHidden(element, !buttons)); // a drag may leave it fast
  }

  /** @param {?object} label that is pointed at; */
  show(label) {
    setHidden(this.element, !label);
    if (!label) return;
    this.part = label.part;
    const { x, y, width } = label;
    Object.assign(this.element.style, { left: `${x - width / 2}px`, top: `${y - LINE / 2}px`, width: `${width}px`, height: `${LINE}px` });
  }
}

function partsOf(sheet, areSeveral) {
  const { driver } = sheet;
  const taxels = new Map(); // by module
  for (let i = 0; i < sheet.n; i++) {
    if (!taxels.has(sheet.module[i])) taxels.set(sheet.module[i], []);
    taxels.get(sheet.module[i]).push(i);
  }
  const part = (size, name, modules) =>
    new Part(size, name, sheet, modules.flatMap((module) => taxels.get(module)), modules);
  const patches = groups([...taxels.keys()], (module) => driver.modules[module].patch);
  const parts = areSeveral ? [part(3, driver.name, [...taxels.keys()])] : [];
  for (const [patch, modules] of patches) {
    const { name } = driver.patches[patch];
    const ownName = (module) => driver.modules[module].name.replace(`${name}, `, "");
    if (!areSeveral || patches.size > 1) parts.push(part(2, name, modules));
    const pads = modules.filter((module) => taxels.get(module).length > 1 || !isNumbered(ownName(module)));
    if (modules.length > 1) parts.push(...pads.map((module) => part(0, ownName(module), [module])));
    for (const [finger, its] of groups(modules, (module) => fingerOf(ownName(module)))) {
      if (finger && its.length > 1 && its.length < modules.length) parts.push(part(1, finger, its));
    }
  }
  return parts;
}

const isBeside = (places, length) => Math.max(...places) < 0 || Math.min(...places) > length;
const isNumbered = (name) => /\d$/.test(name);

/** The finger of a pad, "index" of "index tip"; empty where the name counts: "triangle 4" is no part of a "triangle". */
const fingerOf = (name) => (isNumbered(name) ? "" : name.split(" ").slice(0, -1).join(" "));

function groups(items, keyOf) {
  const found = new Map();
  for (const item of items) found.set(keyOf(item), [...(found.get(keyOf(item)) ?? []), item]);
  return found;
}

/** Whether a name covers some of a ring, or of what is in it. */
function isOn({ x, y, width }, ring) {
  const [right, down] = [Math.abs(x - ring.x) - width / 2, Math.abs(y - ring.y) - LINE / 2].map((far) => Math.max(far, 0));
  return Math.hypot(right, down) < ring.size;
}

export function areOver(one, other) {
  return Math.abs(one.y - other.y) < LINE && Math.abs(one.x - other.x) < (one.width + other.width) / 2 + 4;
}

/** The width of a text in FONT, pixels: that of its characters, since a browser keeps what it knows of any other text. */
export function widthOf(text) {
  return [...text].reduce((sum, character) => sum + widthOfOne(character), 0);
}

function widthOfOne(character) {
  if (!widths.has(character)) {
    ruler.font = FONT;
    widths.set(character, ruler.measureText(character).width);
  }
  return widths.get(character);
}
