// From where to look at some taxels: a box around them, and a direction.

const FROM = [0, -0.86, 0.51]; // where a skin is looked at from, if its normals do not say
const AGREED = 0.25; // length of the mean of normals from which on they do
const FROM_ABOVE = 0.999;
const all = () => true;

/** Smallest and greatest coordinates of some taxels: [x, y, z, x, y, z], m; null of none. */
export function boxOf(sheets, isIn = all) {
  const box = [Infinity, Infinity, Infinity, -Infinity, -Infinity, -Infinity];
  for (const sheet of sheets) {
    for (let i = 0; i < sheet.n; i++) {
      if (!isIn(sheet, i)) continue;
      for (let c = 0; c < 3; c++) {
        const x = sheet.position[3 * i + c];
        if (x < box[c]) box[c] = x;
        if (x > box[3 + c]) box[3 + c] = x;
      }
    }
  }
  return box[0] === Infinity ? null : box;
}

/** A box with room for the discs of its taxels. */
export function withRoom(box, sheets) {
  const by = 1.2 * Math.max(...sheets.map(({ radius }) => radius[0] ?? 0));
  return box.map((x, c) => (c < 3 ? x - by : x + by));
}

/** From where most of some taxels are seen: along the mean of their normals; those laid out flat count if all are. */
export function directionOf(sheets, isIn = all) {
  const placed = sheets.filter((sheet) => sheet.placed);
  const sum = [0, 0, 0];
  let n = 0;
  for (const sheet of placed.length ? placed : sheets) {
    for (let i = 0; i < sheet.n; i++) {
      if (!isIn(sheet, i)) continue;
      for (let c = 0; c < 3; c++) sum[c] += sheet.normal[3 * i + c];
      n++;
    }
  }
  const mean = sum.map((x) => x / Math.max(n, 1));
  const length = Math.hypot(...mean);
  if (length < AGREED) return FROM;
  return Math.abs(mean[2]) > FROM_ABOVE * length ? [0, -1e-3, Math.sign(mean[2])] : mean;
}
