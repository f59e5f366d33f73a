// The chosen taxels, one under the pointer and some pinned, with the exact values that the server sends.

const LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ";
const MOST_PINS = 12;

/** One taxel, known again after a restart by its driver, type and uid. */
class Probe {
  constructor(sheet, i) {
    this.letter = "";
    this.exact = null; // {value, raw, age_ms, status} of the server
    this.key = keyOf(sheet, i);
    this.sheet = sheet;
    this.i = i;
  }

  get position() {
    return this.sheet.index[this.i];
  }

  get name() {
    return this.sheet.names?.[this.i] ?? `sensor ${this.position}`;
  }
}

function keyOf(sheet, i) {
  return `${sheet.driver.key}:${sheet.type}:${sheet.uid[i].toString(16)}`;
}

/** The taxel of a key: {sheet, i}; null if there is no such one now. */
export function resolve(skin, key) {
  const [driver, type, id] = key.split(":");
  const sheet = skin.sheets(type).find((one) => one.driver.key === driver);
  if (!sheet || !/^[0-9a-f]+$/.test(id ?? "")) return null;
  const i = sheet.uid.indexOf(BigInt(`0x${id}`));
  return i < 0 ? null : { sheet, i };
}

export class Probes {
  hovered = null;
  pins = [];
  #lost = []; // keys of pins whose driver is not there
  #named = new Set();
  #asked = "[]";

  /** @param {(op: object) => void} send @param {() => void} changed called when others are looked at. */
  constructor(send, changed) {
    this.send = send;
    this.changed = changed;
  }

  get all() {
    return this.hovered && !this.pins.some(({ key }) => key === this.hovered.key)
      ? [...this.pins, this.hovered]
      : this.pins;
  }

  /** Keys of all pins, also of those whose driver is away. */
  get keys() {
    return [...this.pins.map(({ key }) => key), ...this.#lost];
  }

  hover(found) {
    const key = found && keyOf(found.sheet, found.i);
    if (key === (this.hovered?.key ?? null)) return false;
    this.hovered = found && (this.pins.find((pin) => pin.key === key) ?? new Probe(found.sheet, found.i));
    this.ask();
    return true;
  }

  /** Pin a taxel, or let it go. */
  toggle({ sheet, i }) {
    const key = keyOf(sheet, i);
    const at = this.pins.findIndex((pin) => pin.key === key);
    if (at >= 0) this.pins.splice(at, 1);
    else if (this.pins.length < MOST_PINS) {
      const pin = this.hovered?.key === key ? this.hovered : new Probe(sheet, i);
      pin.letter = [...LETTERS].find((letter) => !this.pins.some((other) => other.letter === letter));
      this.pins.push(pin);
    }
    this.ask();
  }

  clear() {
    this.pins = [];
    this.#lost = [];
    this.ask();
  }

  /** The structure is another one, or keys come from an address: find everything again. */
  find(skin, keys = this.keys) {
    this.hovered = null;
    this.#lost = [];
    this.#named.clear();
    const before = this.pins;
    this.pins = [];
    for (const key of keys) {
      const found = resolve(skin, key);
      if (!found) this.#lost.push(key);
      else if (!this.pins.some((pin) => pin.key === key)) this.toggle(found);
      const letter = before.find((pin) => pin.key === key)?.letter;
      if (found && letter) this.pins.at(-1).letter = letter;
    }
    this.#asked = "";
    this.ask();
  }

  /** Ask the server for what is looked at now. */
  ask() {
    const sensors = this.all.map((probe) => [probe.sheet.driver.id, probe.position]);
    const text = JSON.stringify(sensors);
    if (text !== this.#asked) {
      this.#asked = text;
      this.send({ op: "exact", sensors });
      this.changed();
    }
    for (const { sheet } of this.all) {
      if (sheet.names || this.#named.has(sheet)) continue;
      this.#named.add(sheet);
      this.send({ op: "names", driver: sheet.driver.id, type: sheet.type });
    }
  }

  take(header) {
    for (const exact of header.exact ?? []) {
      const { driver, position } = exact;
      const probe = this.all.find((one) => one.sheet.driver.id === driver && one.position === position);
      if (probe) probe.exact = exact;
    }
  }
}
