// The signs of taxels that are not fresh, for what draws without WebGL; cloud.js has the same ones as a shader.

import * as marks from "./marks.js";
import { GROUND, INK, ramp } from "./palette.js";

const STALE_FADE = 0.6;
const VEILS = [0, 0.7, 0.78];
export const [CLEAR, INSIDE, DIM] = [0, 1, 2]; // as it is; seen from inside; not selected

/** Colours of a theme, packed as in pixels of a canvas: one set for each way to be seen. */
export function inksOf(theme) {
  const colours = ramp(theme);
  const ground = GROUND[theme];
  const between = (one, share) => [0, 1, 2].map((c) => one[c] + share * (ground[c] - one[c]));
  return VEILS.map((veil) => {
    const veiled = (rgb) => packed(between(rgb, veil));
    const ofLevels = (colour) =>
      Uint32Array.from({ length: 256 }, (_, level) => veiled(colour(colours.subarray(4 * level, 4 * level + 3))));
    const [ink, soft, hollow] = [0, 0.55, 0.88].map((share) => veiled(between(INK[theme], share)));
    return {
      ground: packed(ground),
      ink,
      soft,
      hollow,
      fresh: ofLevels((own) => own),
      stale: ofLevels((own) => between(own, STALE_FADE)),
      away: ofLevels((own) => (apart(own, INK[theme]) > apart(own, ground) ? INK[theme] : ground)), // seen best on it
    };
  });
}

/**
 * The colour of one pixel of a taxel that is not fresh, packed.
 * @param {number} mark of marks.js.
 * @param {number} u to the right of its middle, in radii; @param {number} v upwards.
 * @param {number} r distance from its middle within the disc, 0 to 1.
 * @param {number} size of its radius, pixels: pens have a least width.
 * @param {number} level of its value.
 * @param {object} inks of `inksOf`.
 */
export function signOf(mark, u, v, r, size, level, { ground, ink, soft, hollow, away, fresh, stale }) {
  const pen = Math.min(Math.max(1.3 / size, 0.14), 0.4);
  const isRim = r > 1 - pen;
  switch (mark) {
    case marks.STALE:
      return isRim ? soft : r > 0.62 ? ground : stale[level];
    case marks.OUT_OF_RANGE:
      return isRim || (r > 1 - 3 * pen && r < 1 - 2 * pen) ? away[level] : fresh[level];
    case marks.SUSPECT:
      return r < 0.3 ? ink : r < 0.66 ? ground : fresh[level];
    case marks.UNHEALTHY:
      return Math.min(Math.abs(u), Math.abs(v)) < pen ? away[level] : fresh[level];
    case marks.NO_ACK: {
      const stripe = (u + v) * Math.min(1.6, size / 5);
      return isRim || stripe - Math.floor(stripe) < 0.42 ? soft : ground;
    }
    case marks.MASKED:
      return isRim || Math.abs(v) < 0.7 * pen ? soft : ground;
    case marks.NEVER_SEEN:
      return r < 0.42 ? ink : isRim ? soft : ground;
    case marks.NOT_CONNECTED:
      return Math.abs(Math.abs(u) - Math.abs(v)) < pen ? ink : ground;
    case marks.UNTOUCHED:
      return r > 1 - 1.8 * pen ? ink : hollow;
    default:
      return isRim ? soft : ground;
  }
}

const apart = (one, other) => Math.hypot(...[0, 1, 2].map((c) => one[c] - other[c]));

function packed(rgb) {
  const [r, g, b] = rgb.map(Math.round);
  return ((255 << 24) | (b << 16) | (g << 8) | r) >>> 0;
}
