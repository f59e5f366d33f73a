// What is plotted: which lines, asked of the server, drawn in strips, and events that a person marks.

import { h } from "./dom.js";
import { clock } from "./format.js";
import { contactLine, Lines, partLine, taxelLine } from "./series.js";
import { Strips } from "./strips.js";

export class Plotting {
  #dragged = null;
  #isMarking = false;
  #functions = new Set(); // names of those that are plotted, or were

  /**
   * @param {HTMLElement} host
   * @param {object} parts `send(op)`, `skin`, `probes`, `stage`, `rewind`, `notify(text)`, `keep()`.
   */
  constructor(host, parts) {
    Object.assign(this, parts);
    this.marks = [];
    this.server_ns = 0;
    this.moments = []; // of recordings, where each is, in the order of their titles
    this.events = [];
    this.offset_ms = 0; // from the server's clock to the time of day
    this.lines = new Lines(this.send);
    this.strips = new Strips(host, this.lines, {
      now_ns: () => this.now_ns,
      shift_ns: (line) => this.#shift_ns(driverOf(line)),
      isRecorded: () => this.isRecorded,
      marks: () => (this.isRecorded ? this.events : this.marks),
      moment_s: () => (this.rewind.isPaused ? this.rewind.at_s : null),
      footer: (lines, time_ns) => this.footer(lines.map(driverOf), time_ns),
      changed: () => {
        this.ask();
        this.keep();
      },
      refuse: this.notify,
      find: () => this.#dragged,
    });
    document.addEventListener("dragend", () => this.#drag(null));
  }

  /** Ask for all lines that are looked at: those of strips, and those of cards. */
  ask(again = false) {
    this.lines.choose(this.skin, [...this.strips.all, ...this.probes.all.map(taxelLine)], again);
  }

  take(taken) {
    this.server_ns = Number(taken.header.now_ns);
    this.offset_ms = Date.now() - this.server_ns / 1e6;
    this.lines.take(taken);
  }

  /** The recordings that are shown are at these moments, or others are. */
  takeReplays(replays, outlines) {
    this.moments = replays.filter(({ title }) => title).map(({ title, time_s }) => ({ title, ns: 1e9 * time_s }));
    const marks = (at) => (outlines[at]?.events ?? []).filter(({ event }) => event === "mark");
    this.events = this.moments.flatMap(({ ns }, at) =>
      marks(at).map(({ time_s, text }) => ({ time_ns: 1e9 * time_s + this.moments[0].ns - ns, text })),
    );
  }

  /** Times of plots are those in a recording, the first one that is shown. */
  get isRecorded() {
    return this.moments.length > 0;
  }

  get now_ns() {
    return this.isRecorded ? this.moments[0].ns : this.server_ns;
  }

  /** From times in the recording of a driver to those in the first: what is shown at once is at one time. */
  #shift_ns(driver) {
    const own = this.moments.find(({ title }) => driver.startsWith(`${title}/`));
    return own ? this.moments[0].ns - own.ns : 0;
  }

  /** The newest time of a taxel's values that is not after what is shown. */
  until(probe) {
    const newest_ns = this.seriesOf(probe)?.newest_ns;
    return this.isRecorded ? this.now_ns - this.#shift_ns(probe.sheet.driver.key) : newest_ns;
  }

  takeState({ marks = [], recording = null, functions = [] }) {
    for (const { name, driver: id, unit } of functions) {
      const driver = this.skin.drivers.get(id)?.key;
      if (!driver || this.#functions.has(name)) continue;
      this.#functions.add(name);
      this.strips.add({ key: `function ${name}`, driver, function: name, label: name, unit });
    }
    this.marks = marks.map(({ time_ns, text }) => ({ time_ns: Number(time_ns), text }));
    const last = marks.at(-1);
    if (!this.#isMarking || !last) return;
    this.#isMarking = false;
    this.notify(last.is_recorded ? `${last.text} is in ${recording?.file ?? "the recording"}` : `${last.text}; nothing is recorded (r records)`);
  }

  mark() {
    this.#isMarking = true;
    this.send({ op: "mark", text: `mark ${this.marks.length + 1}` });
  }

  seriesOf(probe) {
    return this.lines.get(taxelLine(probe).key);
  }

  /** Of a taxel. @param {object} probe */
  taxel(probe) {
    const nameOf = () => this.#named(probe.sheet.driver, probe.name);
    return { ...taxelLine(probe), get label() { return nameOf(); } };
  }

  /** Of a hand, finger, pad or board. */
  part({ sheet, name, modules }) {
    return partLine({ sheet, name: this.#named(sheet.driver, name), modules });
  }

  /** A name, with that of its driver where there are several. */
  #named(driver, name) {
    return this.skin.drivers.size < 2 || name === driver.name ? name : `${driver.name}, ${name}`;
  }

  contact(driver, contact) {
    return contactLine(driver, contact);
  }

  /** Of a driver or a patch of the tree; null of another row, or if it has no taxels in the picture. */
  row({ driver, level, name, patch }) {
    const sheet = this.stage.sheets.find((one) => one.driver === driver);
    const modules = driver.modules.map((_, m) => m).filter((m) => level === 1 || driver.modules[m].patch === patch);
    return sheet && level !== 2 && modules.length ? this.part({ sheet, name, modules }) : null;
  }

  /** Let an element be dragged into a strip. @param {() => ?object} lineOf it stands for. */
  draggable(element, lineOf) {
    element.draggable = true;
    element.addEventListener("dragstart", (event) => {
      const line = lineOf();
      if (!line) return event.preventDefault();
      event.dataTransfer.setData("text/plain", line.label);
      event.dataTransfer.effectAllowed = "copyMove";
      setTimeout(() => this.#drag(line)); // a change of the page at once would end it
    });
    return element;
  }

  /** Let an element be dragged into a strip, or clicked, or chosen with Enter. */
  plottable(element, lineOf) {
    this.draggable(element, lineOf);
    element.addEventListener("click", () => this.strips.add(lineOf()));
    element.addEventListener("keydown", (event) => event.key === "Enter" && this.strips.add(lineOf()));
  }

  /** A button that plots. */
  button(lineOf) {
    const add = () => this.strips.add(lineOf());
    return h("button", { type: "button", class: "plain", title: "Plot it (g)", "aria-label": "Plot it", onclick: add }, "∿");
  }

  #drag(line) {
    this.#dragged = line;
    document.body.toggleAttribute("data-dragging", Boolean(line));
  }

  /** Whose values, and of when. @param {string[]} keys of drivers. */
  footer(keys, time_ns = this.now_ns) {
    const drivers = [...this.skin.drivers.values()].filter(({ key }) => keys.includes(key));
    const names = drivers.map(({ name, type }) => (name === type ? name : `${name} (${type})`));
    const of_day = () => new Date(time_ns / 1e6 + this.offset_ms).toISOString().replace("T", " ").replace(/\.\d+Z/, " UTC");
    return [...names, this.isRecorded ? `${this.moments[0].title} at ${clock(time_ns / 1e9)}` : of_day()].join(", ");
  }
}

const driverOf = ({ driver, taxel }) => driver ?? taxel.split(":")[0];
