// From where to look at some taxels: a direction, and how near.

const FROM = [0, -0.86, 0.51]; // where a skin is looked at from, if its normals do not say
const AGREED = 0.6; // length of the mean of normals from which on they do
const RISES = [0.3, 0.6, 0.9, -0.5]; // of directions that are tried, rad above the ground
const TURNS = 12; // around it
const MANY = 500; // taxels that are looked at to choose
const FROM_ABOVE = 0.999;
const ROOM = 1.2; // of a taxel, in its radii
const LEAST = 0.02; // from the nearest taxel to the eye, m

/**
 * Where the eye is when it looks in a direction and some taxels fill the picture.
 *
 * Each taxel, with its disc, bounds how far the eye may go to each side and how near it may come; the farthest bounds
 * say where it is.
 * @param {number[]} towards from what is looked at to the eye.
 * @param {object} picture `right`, `left`, `top`, `bottom`: where its edges are, 1 m ahead of the eye, m.
 * @returns {?{position: number[], target: number[]}} null of no taxels.
 */
export function eyeOf(sheets, isIn, towards, { right, left, top, bottom }) {
  const z = unit(towards);
  const x = unit(cross([0, 0, 1], z));
  const y = cross(z, x);
  const [r, l, t, b] = [right, left, top, bottom].map((edge) => ({ edge, length: Math.hypot(1, edge), most: -Infinity }));
  let nearest = -Infinity, farthest = Infinity;
  for (const sheet of sheets) {
    for (let i = 0; i < sheet.n; i++) {
      if (!isIn(sheet, i)) continue;
      const at = sheet.position.subarray(3 * i, 3 * i + 3);
      const [u, v, w] = [dot(x, at), dot(y, at), dot(z, at)];
      for (const [side, s] of [[r, u], [l, -u], [t, v], [b, -v]]) {
        side.most = Math.max(side.most, s + side.edge * w + side.length * ROOM * sheet.radius[i]);
      }
      nearest = Math.max(nearest, w);
      farthest = Math.min(farthest, w);
    }
  }
  if (nearest === -Infinity) return null;
  const wide = (r.most + l.most) / (right + left);
  const tall = (t.most + b.most) / (top + bottom);
  const away = Math.max(wide, tall, nearest + LEAST);
  const middle = (one, other) => (one.most - other.most + (other.edge - one.edge) * away) / 2;
  const [u, v] = [middle(r, l), middle(t, b)];
  const at = (w) => [0, 1, 2].map((c) => u * x[c] + v * y[c] + w * z[c]);
  return { position: at(away), target: at((nearest + farthest) / 2) };
}

/**
 * From where to look: where the discs that face the eye fill most of the picture; along the mean of the normals, where
 * these agree about as well.
 */
export function directionOf(sheets, isIn, picture) {
  const few = someOf(sheets, isIn);
  const mean = [0, 1, 2].map((c) => few.reduce((sum, { normal }) => sum + normal[c], 0) / Math.max(few.length, 1));
  const length = Math.hypot(...mean);
  const along = Math.abs(mean[2]) > FROM_ABOVE * length ? [0, -1e-3, Math.sign(mean[2])] : mean;
  if (length > AGREED || !sheets.some(({ placed }) => placed)) return length > 0 ? along : FROM;
  let best = FROM, most = 1.15 * seenFrom(FROM, few, picture);
  for (const up of RISES) {
    for (let turn = 0; turn < TURNS; turn++) {
      const around = (2 * Math.PI * turn) / TURNS;
      const towards = [Math.cos(up) * Math.sin(around), -Math.cos(up) * Math.cos(around), Math.sin(up)];
      const seen = seenFrom(towards, few, picture);
      if (seen > most) [best, most] = [towards, seen];
    }
  }
  return best;
}

/** Up to MANY of some taxels, evenly; each as a sheet of its own, with its normal. */
function someOf(sheets, isIn) {
  const all = sheets.flatMap((sheet) => Array.from({ length: sheet.n }, (_, i) => ({ sheet, i })));
  const wanted = all.filter(({ sheet, i }) => isIn(sheet, i));
  const step = Math.ceil(wanted.length / MANY) || 1;
  return wanted
    .filter((_, k) => k % step === 0)
    .map(({ sheet, i }) => ({
      n: 1,
      position: sheet.position.subarray(3 * i, 3 * i + 3),
      normal: sheet.normal.subarray(3 * i, 3 * i + 3),
      radius: sheet.radius.subarray(i, i + 1),
    }));
}

/** How much of the picture the discs fill that face the eye, if it looks from there; no normal: half of a disc. */
function seenFrom(towards, few, picture) {
  const eye = eyeOf(few, () => true, towards, picture);
  if (!eye) return 0;
  const z = unit(towards);
  const area = ({ normal, radius }) => radius[0] ** 2 * (normal.some(Boolean) ? Math.max(0, dot(normal, z)) : 0.5);
  const away = few.map(({ position }) => dot(z, eye.position) - dot(z, position));
  const middle = away.reduce((sum, x) => sum + x, 0) / away.length;
  const counted = (middle + 2 * Math.max(...away)) / 3; // the farthest are to be seen, too
  return few.reduce((sum, disc) => sum + area(disc), 0) / counted ** 2;
}

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => a.map((x) => x / Math.hypot(...a));
