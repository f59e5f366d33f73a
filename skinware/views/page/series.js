// The values of lines over the last minute: taxels, parts and contacts, each known again after a restart by its key.

import { resolve } from "./probes.js";

export const KEPT_S = 60;
const AHEAD_S = 5; // beyond the moment that is shown: values of recordings come before their time
const MOST = 65_536; // samples of a line
const FIRST = 1024;
const NUMBERS = 8; // choices whose values may still be on their way

/** Samples of a line, the oldest first; the room doubles until it is bounded. */
export class Series {
  #begin = 0;
  #end = 0;

  constructor() {
    this.time_ns = new Float64Array(2 * FIRST);
    this.value = new Float64Array(2 * FIRST);
  }

  get times() {
    return this.time_ns.subarray(this.#begin, this.#end);
  }

  get values() {
    return this.value.subarray(this.#begin, this.#end);
  }

  get newest_ns() {
    return this.#end > this.#begin ? this.time_ns[this.#end - 1] : -Infinity;
  }

  clear() {
    this.#begin = this.#end = 0;
  }

  /** Add a sample; one that is not newer than all before is known already. */
  push(time_ns, value) {
    if (time_ns <= this.newest_ns) return;
    if (this.#end === this.time_ns.length) this.#makeRoom();
    this.time_ns[this.#end] = time_ns;
    this.value[this.#end++] = value;
    if (this.#end - this.#begin > MOST) this.#begin++;
    while (this.time_ns[this.#begin] < time_ns - 1e9 * (KEPT_S + AHEAD_S)) this.#begin++;
  }

  #makeRoom() {
    const size = this.time_ns.length;
    const wanted = 2 * (this.#end - this.#begin) > size ? Math.min(2 * size, 2 * MOST) : size;
    for (const name of ["time_ns", "value"]) {
      const kept = this[name].subarray(this.#begin, this.#end);
      if (wanted === size) this[name].copyWithin(0, this.#begin, this.#end);
      else (this[name] = new Float64Array(wanted)).set(kept);
    }
    [this.#begin, this.#end] = [0, this.#end - this.#begin];
  }

  /** The samples as they are now, which later ones do not change. */
  copy() {
    return { times: this.times.slice(), values: this.values.slice() };
  }
}

/** The place of the first time that is not before another. */
export function placeOf(times, time_ns) {
  let [low, high] = [0, times.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (times[middle] < time_ns) low = middle + 1;
    else high = middle;
  }
  return low;
}

/** A line of a taxel, see `Probe`. */
export const taxelLine = ({ key, name, sheet }) => ({ key: `taxel ${key}`, taxel: key, label: name, unit: sheet.unit });

/** A line of the load on some modules of a sheet. */
export function partLine({ sheet, name, modules }) {
  const names = modules.map((module) => nameOf(sheet.driver, module));
  const { key } = sheet.driver;
  return { key: `part ${key} ${sheet.type} ${names.join("; ")}`, driver: key, type: sheet.type, modules: names, label: name, unit: sheet.unit };
}

export function contactLine(driver, { id, unit }) {
  return { key: `contact ${driver.key} ${id}`, driver: driver.key, contact: id, label: `contact ${id}`, unit: unit ?? "" };
}

const nameOf = (driver, module) => `${driver.patches[driver.modules[module].patch].name}, ${driver.modules[module].name}`;

/** What the server is asked for; null while what the line is of is not there. */
function asked(skin, line) {
  if (line.taxel) {
    const found = resolve(skin, line.taxel);
    return found && { driver: found.sheet.driver.id, position: found.sheet.index[found.i] };
  }
  const driver = [...skin.drivers.values()].find(({ key }) => key === line.driver);
  if (!driver) return null;
  if (line.function !== undefined) return { driver: driver.id, function: line.function };
  if (line.contact !== undefined) return { driver: driver.id, contact: line.contact };
  const modules = driver.modules.map((_, m) => m).filter((m) => line.modules.includes(nameOf(driver, m)));
  return { driver: driver.id, type: line.type, modules };
}

/** The lines that somebody looks at. */
export class Lines {
  #series = new Map(); // by key
  #numbers = new Map(); // of a choice -> the keys of its lines
  #number = 0;
  #asked = "[]";

  /** @param {(op: object) => void} send */
  constructor(send) {
    this.send = send;
    this.missed = 0;
  }

  get(key) {
    return this.#series.get(key);
  }

  /** Ask for these lines, and forget all others. @param {boolean} again also if they were asked for. */
  choose(skin, lines, again = false) {
    const wanted = new Map(lines.map((line) => [line.key, line]));
    for (const key of this.#series.keys()) if (!wanted.has(key)) this.#series.delete(key);
    for (const key of wanted.keys()) if (!this.#series.has(key)) this.#series.set(key, new Series());
    const there = [...wanted.values()].map((line) => [line.key, asked(skin, line)]).filter(([, op]) => op);
    const text = JSON.stringify(there);
    if (text === this.#asked && !again) return;
    this.#asked = text;
    this.#numbers.set(++this.#number, there.map(([key]) => key));
    this.#numbers.delete(this.#number - NUMBERS);
    this.send({ op: "plot", number: this.#number, lines: there.map(([, op]) => op) });
  }

  /** Take the values of a turn. */
  take({ header, blob }) {
    if (!header.plots) return;
    this.missed = header.plots.missed;
    for (const { number, of, lines, time_ns, values, begins } of header.plots.blocks) {
      const times = Float64Array.from(blob(time_ns, BigInt64Array), Number);
      const all = blob(values, Float64Array);
      lines.forEach((line, column) => {
        const series = this.#series.get(this.#numbers.get(number)?.[line]);
        if (!series) return;
        series.of = of;
        if (begins) series.clear();
        for (let k = 0; k < times.length; k++) series.push(times[k], all[k * lines.length + column]);
      });
    }
  }
}
