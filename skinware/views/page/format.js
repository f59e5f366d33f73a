// Figures for people: ages, rates and counts as skinware/text.py writes them.

const NONE = "–";
export const isKnown = (x) => x !== null && x !== undefined && !Number.isNaN(x);

/** An age in milliseconds: "0.6 ms", "12 ms", "1.2 s", "3 min", "2 h". */
export function age(ms) {
  if (!isKnown(ms)) return NONE;
  const milliseconds = Math.max(0, ms);
  if (milliseconds > 0 && milliseconds < 0.0995) return `${Math.max(1, Math.round(1000 * milliseconds))} us`;
  if (milliseconds < 9.95) return `${milliseconds.toFixed(1)} ms`;
  if (milliseconds < 999.5) return `${milliseconds.toFixed(0)} ms`;
  const seconds = milliseconds / 1000;
  if (seconds < 99.95) return `${seconds.toFixed(1)} s`;
  const minutes = seconds / 60;
  return minutes < 99.5 ? `${minutes.toFixed(0)} min` : `${(minutes / 60).toFixed(0)} h`;
}

/** A rate: "0.25 Hz", "20.0 Hz", "1000 Hz". */
export function rate(hz) {
  if (!isKnown(hz)) return NONE;
  if (hz > 0 && hz < 1) return `${hz.toFixed(2)} Hz`;
  return `${hz < 999.95 ? hz.toFixed(1) : hz.toFixed(0)} Hz`;
}

/** A part of 1 in per cent. */
export function percent(part) {
  return isKnown(part) ? `${(100 * part).toFixed(0)} %` : NONE;
}

/** A number with about four digits, large ones whole: "0.012", "150", "20,000". */
export function figure(x) {
  if (!isKnown(x)) return NONE;
  if (x !== 0 && (Math.abs(x) >= 1e8 || Math.abs(x) < 1e-3)) return x.toExponential(2);
  return Math.abs(x) >= 1e4 ? count(Math.round(x)) : String(Number(x.toPrecision(4)));
}

/** A number with about three digits, where there is little room. */
export function short(x) {
  if (!isKnown(x)) return NONE;
  return Math.abs(x) >= 100 ? figure(Math.round(x)) : String(Number(x.toPrecision(3)));
}

const PREFIXES = [[1e6, "M"], [1e3, "k"], [1, ""], [1e-3, "m"], [1e-6, "u"]];

/** By what to divide values for people, and their unit then: pascals, teslas and metres with the prefix that fits the greatest. */
export function prefixed(unit, greatest) {
  if (!["Pa", "T", "m"].includes(unit) || !greatest) return [1, unit];
  const [factor, prefix] = PREFIXES.find(([one]) => Math.abs(greatest) >= one) ?? PREFIXES.at(-1);
  return [factor, prefix + unit];
}

export function measure(x, unit) {
  if (!isKnown(x) || !unit) return figure(x);
  const [factor, own] = prefixed(unit, x);
  return `${figure(x / factor)} ${own}`;
}

/** Two ends of a range, with their unit: ["0", "101.6 kPa"]. */
export function range(low, high, unit) {
  const [factor, own] = prefixed(unit, Math.max(Math.abs(low ?? 0), Math.abs(high ?? 0)));
  return [figure(isKnown(low) ? low / factor : low), isKnown(high) && own ? `${figure(high / factor)} ${own}` : figure(high)];
}

/** A count: "30,848". */
export function count(n) {
  return isKnown(n) ? n.toLocaleString("en") : NONE;
}

export function bytes(n) {
  if (!isKnown(n)) return NONE;
  const units = ["B", "kB", "MB", "GB", "TB"];
  let at = 0;
  while (n >= 1000 && at < units.length - 1) [n, at] = [n / 1000, at + 1];
  return `${at && n < 100 ? n.toFixed(1) : n.toFixed(0)} ${units[at]}`;
}

/** Seconds as minutes: "1:05.2". */
export function clock(s) {
  if (!isKnown(s)) return NONE;
  const tenths = Math.round(10 * s);
  const minutes = Math.floor(tenths / 600);
  return `${minutes}:${(tenths / 10 - 60 * minutes).toFixed(1).padStart(4, "0")}`;
}
