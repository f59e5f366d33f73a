// Figures as people read them.

const NONE = "–";
export const isKnown = (x) => x !== null && x !== undefined && !Number.isNaN(x);

/** Milliseconds as an age: "4 ms", "1.2 s", "3 min". */
export function age(ms) {
  if (!isKnown(ms)) return NONE;
  if (ms < 10) return `${ms.toFixed(1)} ms`;
  if (ms < 1000) return `${ms.toFixed(0)} ms`;
  if (ms < 100_000) return `${(ms / 1000).toFixed(1)} s`;
  return `${(ms / 60_000).toFixed(0)} min`;
}

export function rate(hz) {
  if (!isKnown(hz)) return NONE;
  return `${hz < 10 && hz > 0 ? hz.toFixed(1) : hz.toFixed(0)} Hz`;
}

/** A part of 1 in per cent. */
export function percent(part) {
  return isKnown(part) ? `${(100 * part).toFixed(0)} %` : NONE;
}

/** A number with about four digits. */
export function figure(x) {
  if (!isKnown(x)) return NONE;
  if (x !== 0 && (Math.abs(x) >= 1e6 || Math.abs(x) < 1e-3)) return x.toExponential(2);
  return String(Number(x.toPrecision(4)));
}

/** A number with about three digits, where there is little room. */
export function short(x) {
  if (!isKnown(x)) return NONE;
  return Math.abs(x) >= 100 ? x.toFixed(0) : String(Number(x.toPrecision(3)));
}

export function measure(x, unit) {
  return isKnown(x) && unit ? `${figure(x)} ${unit}` : figure(x);
}

export function count(n) {
  return isKnown(n) ? n.toLocaleString("en").replaceAll(",", "\u202f") : NONE;
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
