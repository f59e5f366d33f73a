// Which taxel is under the pointer.

const REACH = 9; // CSS pixels around a small taxel

/**
 * The taxel at a place of the canvas.
 * @param {object} stage with `project` and `pixels`, see stage.js.
 * @returns {?{sheet: object, i: number}} the nearest to the eye of those under it; else the nearest to it; null.
 */
export function pick(stage, sheets, x, y) {
  let best = null;
  let bestScore = Infinity;
  const eye = stage.camera.position;
  for (const sheet of sheets) {
    const { position: p, normal } = sheet;
    for (let i = 0; i < sheet.n; i++) {
      const [px, py, depth] = stage.project(p[3 * i], p[3 * i + 1], p[3 * i + 2]);
      if (depth <= 0) continue;
      const distance = Math.hypot(px - x, py - y);
      const size = (sheet.radius[i] * stage.pixels) / depth;
      if (distance > Math.max(size, REACH)) continue;
      const away =
        normal[3 * i] * (eye.x - p[3 * i]) +
          normal[3 * i + 1] * (eye.y - p[3 * i + 1]) +
          normal[3 * i + 2] * (eye.z - p[3 * i + 2]) <
        0;
      // Those seen from inside only where there is no other; then what is in front; a small taxel may be missed a bit.
      const score = (away ? 1000 : 0) + depth / stage.camera.far + Math.max(0, distance - size) / REACH;
      if (score < bestScore) [best, bestScore] = [{ sheet, i }, score];
    }
  }
  return best;
}
