// The view in the part of the address behind "#": another browser that opens it shows the same.

const NUMBERS = /^-?[\d.]+(e-?\d+)?(,-?[\d.]+(e-?\d+)?)*$/;

/**
 * @param {object} view `camera` ({position, target}, of 3 numbers each), `mode`, `type`, `scale` ([low, high] or
 *     null), `shifts` (by which drivers are moved, by their keys), `selected` (key of a row or null), `pins` (texts), `plots` (lines of strips), `times` (s, of each recording), `normals`, `names`, `theme`, `flat`, `sharp`; what is missing is
 *     left out.
 */
export function toHash(view) {
  const parts = new URLSearchParams();
  if (view.camera) parts.set("eye", numbers([...view.camera.position, ...view.camera.target]));
  if (view.mode && view.mode !== "raw") parts.set("mode", view.mode);
  if (view.type) parts.set("type", view.type);
  if (view.scale) parts.set("scale", numbers(view.scale));
  if (view.selected) parts.set("selected", view.selected);
  for (const pin of view.pins ?? []) parts.append("pin", pin);
  for (const lines of view.plots ?? []) parts.append("plot", JSON.stringify(lines));
  for (const [key, shift] of Object.entries(view.shifts ?? {})) parts.append("at", `${numbers(shift)},${key}`);
  if (view.times) parts.set("t", view.times.map((time_s) => time_s.toFixed(3)).join(","));
  if (view.theme) parts.set("theme", view.theme);
  for (const how of ["normals", "flat", "sharp"]) if (view[how]) parts.set(how, "1");
  if (view.names === false) parts.set("names", "0");
  return `#${parts}`;
}

/**
 * The view of a hash; what is not in it, or not understood, is left out. Not of the view, but of how it is drawn:
 * `flat`, without WebGL; `sharp`, in all pixels also where that is slow.
 */
export function fromHash(hash) {
  const parts = new URLSearchParams(hash.replace(/^#/, ""));
  const list = (name, length) => {
    const text = parts.get(name);
    if (!text || !NUMBERS.test(text)) return null;
    const found = text.split(",").map(Number);
    return found.length === length && found.every(Number.isFinite) ? found : null;
  };
  const eye = list("eye", 6);
  const shifts = parts.getAll("at").map((text) => [text.split(",").slice(3).join(), text.split(",").slice(0, 3).map(Number)]);
  const theme = parts.get("theme");
  return {
    camera: eye && { position: eye.slice(0, 3), target: eye.slice(3) },
    mode: parts.get("mode") ?? undefined,
    type: parts.get("type") ?? undefined,
    scale: list("scale", 2),
    selected: parts.get("selected"),
    pins: parts.getAll("pin"),
    plots: parts.getAll("plot").flatMap(linesOf),
    times: NUMBERS.test(parts.get("t") ?? "") ? parts.get("t").split(",").map(Number) : null,
    shifts: Object.fromEntries(shifts.filter(([key, shift]) => key && shift.every(Number.isFinite))),
    normals: parts.get("normals") === "1",
    names: parts.get("names") !== "0",
    theme: theme === "dark" || theme === "light" ? theme : undefined,
    flat: parts.get("flat") === "1",
    sharp: parts.get("sharp") === "1",
  };
}

/** The lines of a strip, in a list; empty if they are none. */
function linesOf(text) {
  const isText = (...values) => values.every((value) => typeof value === "string");
  const isLine = (line) =>
    isText(line?.key, line?.label, line?.unit) && (isText(line.taxel) || (isText(line.driver, line.type) && Array.isArray(line.modules)));
  try {
    const lines = JSON.parse(text);
    return Array.isArray(lines) && lines.every(isLine) ? [lines] : [];
  } catch {
    return [];
  }
}

const numbers = (list) => list.map((x) => Number(x.toPrecision(5))).join(",");
