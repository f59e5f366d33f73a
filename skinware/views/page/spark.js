// A line of values over the last seconds, as points of an SVG polyline.

const MARGIN = 3; // above and below

/**
 * @param {Float32Array} time_s rising; the last is now.
 * @param {Float32Array} value NaN: left out.
 * @returns {{points: string, low: ?number, high: ?number}} of each column the lowest and the highest
 *     value.
 */
export function polyline(time_s, value, width, height, shown_s) {
  const end = time_s.at(-1);
  let low = Infinity;
  let high = -Infinity;
  const columns = new Map();
  for (let k = 0; k < value.length; k++) {
    const x = Math.round(width * (1 - (end - time_s[k]) / shown_s));
    if (x < 0 || Number.isNaN(value[k])) continue;
    const column = columns.get(x);
    if (!column) columns.set(x, { first: value[k], low: value[k], high: value[k] });
    else {
      column.low = Math.min(column.low, value[k]);
      column.high = Math.max(column.high, value[k]);
    }
    low = Math.min(low, value[k]);
    high = Math.max(high, value[k]);
  }
  if (low > high) return { points: "", low: null, high: null };
  const y = (v) => (high === low ? height / 2 : height - MARGIN - ((v - low) / (high - low)) * (height - 2 * MARGIN));
  const points = [...columns].flatMap(([x, column]) => {
    const both = column.first - column.low < column.high - column.first ? ["low", "high"] : ["high", "low"];
    const ends = column.low === column.high ? ["low"] : both;
    return ends.map((of) => `${x},${y(column[of]).toFixed(1)}`);
  });
  return { points: points.join(" "), low, high };
}
