// The tree of drivers, buses and patches: what has a problem first; a row selects what it stands for.

import { h, setChildren, setText } from "./dom.js";
import { age, isKnown, percent, rate } from "./format.js";

const COLLAPSED_FROM = 40; // patches of a driver: more are folded, but for those with problems
export const [OLD, GONE] = [2, 3]; // how bad a state is, as in skinware/state.py

const SIGNS = ["●", "◔", "◑", "✕"]; // by badness: distinguishable without colour

/**
 * The rows of the tree, in order.
 * @param {Iterable<object>} drivers of skin.js.
 * @param {Map<number, object>} states what the newest state says of each driver.
 */
export function rowsOf(drivers, states) {
  const worst = (rows) => rows.toSorted((one, other) => other.bad - one.bad); // stable
  const rowOf = (level, key, name, report, more) => {
    return { level, key, name, report: report ?? {}, bad: report?.bad ?? 0, ...more };
  };
  const branches = [...drivers].map((driver) => {
    const state = states.get(driver.id);
    const buses = driver.buses.map((bus, b) => {
      const patches = driver.patches
        .map((patch, p) => ({ patch, p }))
        .filter(({ patch }) => patch.bus === b)
        .map(({ patch, p }) =>
          rowOf(3, `${driver.key}/${bus}/${patch.name}`, patch.name, state?.patches?.[p], { driver, bus: b, patch: p }),
        );
      const row = rowOf(2, `${driver.key}/${bus}`, bus, state?.buses?.[b], { driver, bus: b });
      return { ...row, children: worst(patches), bad: Math.max(row.bad, ...patches.map(({ bad }) => bad)) };
    });
    const row = rowOf(1, driver.key, driver.name, state, { driver });
    return { ...row, children: worst(buses), bad: Math.max(row.bad, ...buses.map(({ bad }) => bad)) };
  });
  return worst(branches);
}

export class Tree {
  #rows = new Map(); // key -> element
  #folded = new Map(); // key -> bool, where a person said so
  #shown = [];

  /**
   * @param {(row: ?object) => void} choose called with the row that is clicked; null if it was selected already.
   * @param {(element: HTMLElement, find: () => object) => void} equip called with each new element.
   */
  constructor(host, choose, equip = () => {}) {
    this.equip = equip;
    this.host = host;
    this.choose = choose;
    this.selected = null;
    host.addEventListener("keydown", (event) => this.#key(event));
  }

  update(skin, states) {
    this.branches = rowsOf(skin.drivers.values(), states);
    this.draw();
  }

  /** The row of a key; undefined if there is none. */
  find(key) {
    const all = (rows) => rows.flatMap((row) => [row, ...all(row.children ?? [])]);
    return all(this.branches ?? []).find((row) => row.key === key);
  }

  /** Select a row; it comes into view. */
  select(key) {
    this.selected = key;
    this.draw();
    this.#rows.get(key)?.scrollIntoView({ block: "nearest" });
  }

  draw() {
    if (!this.branches) return;
    const open = (rows) =>
      rows.flatMap((row) => {
        if (!row.children?.length) return [row];
        const seen = this.#isFolded(row) ? row.children.filter(({ bad }) => row.level > 1 && bad) : row.children;
        return [row, ...open(seen)];
      });
    this.#shown = open(this.branches);
    const focused = document.activeElement?.closest?.("[role=treeitem]");
    const elements = this.#shown.map((row) => this.#element(row));
    if (!elements.length) elements.push((this.empty ??= h("p", { class: "hint" }, "No driver runs.")));
    setChildren(this.host, elements);
    for (const [key, element] of this.#rows) if (!element.isConnected) this.#rows.delete(key);
    if (focused?.isConnected && document.activeElement !== focused) focused.focus();
    const entry = elements.find((one) => one.dataset.key === this.selected) ?? elements[0];
    for (const element of elements) element.tabIndex = element === (focused?.isConnected ? focused : entry) ? 0 : -1;
  }

  #isFolded(row) {
    if (this.#folded.has(row.key)) return this.#folded.get(row.key);
    if (row.level === 1) return row.report.bad === GONE;
    return row.level === 2 && row.children.length > COLLAPSED_FROM;
  }

  #element(row) {
    let element = this.#rows.get(row.key);
    if (!element) {
      const cells = ["fold", "sign", "name", "state", "figures"].map((part) => h("span", { class: part }));
      const attributes = { role: "treeitem", class: "row", "data-role": "row", "data-key": row.key };
      element = h("div", { ...attributes, "aria-level": row.level }, ...cells);
      element.dataset.driver = row.driver.key;
      if (row.level > 1) element.dataset.bus = row.driver.buses[row.bus];
      if (row.level > 2) element.dataset.patch = row.name;
      element.addEventListener("click", (event) => this.#click(element.dataset.key, event.target));
      this.#rows.set(row.key, element);
      this.equip(element, () => this.find(element.dataset.key));
    }
    const [fold, sign, name, state, figures] = element.children;
    const own = row.report.bad ?? 0;
    setText(fold, row.children?.length ? (this.#isFolded(row) ? "▸" : "▾") : "");
    if (row.children?.length) element.setAttribute("aria-expanded", String(!this.#isFolded(row)));
    setText(sign, SIGNS[own]);
    element.dataset.bad = own;
    element.dataset.fresh = String(isFresh(row));
    setText(name, row.name);
    setText(state, own ? [row.report.shown ?? row.report.state, row.report.reason].filter(Boolean).join(": ") : "");
    const texts = figuresOf(row);
    while (figures.children.length < texts.length) figures.append(h("span"));
    texts.forEach((text, i) => setText(figures.children[i], text));
    element.setAttribute("aria-selected", String(row.key === this.selected));
    return element;
  }

  #click(key, target) {
    const row = this.find(key);
    if (!row) return;
    if (target.className === "fold" && row.children?.length) return this.#fold(row, !this.#isFolded(row));
    this.choose(key === this.selected ? null : row);
  }

  #fold(row, isFolded) {
    this.#folded.set(row.key, isFolded);
    this.draw();
  }

  #key(event) {
    const at = this.#shown.findIndex(({ key }) => key === event.target.dataset.key);
    if (at < 0) return;
    const row = this.#shown[at];
    const go = (to) => this.#shown[to] && this.#rows.get(this.#shown[to].key).focus();
    const actions = {
      ArrowDown: () => go(at + 1),
      ArrowUp: () => go(at - 1),
      Home: () => go(0),
      End: () => go(this.#shown.length - 1),
      ArrowRight: () => row.children?.length && (this.#isFolded(row) ? this.#fold(row, false) : go(at + 1)),
      ArrowLeft: () =>
        row.children?.length && !this.#isFolded(row)
          ? this.#fold(row, true)
          : go(this.#shown.findLastIndex(({ level }, i) => i < at && level < row.level)),
      Enter: () => this.#click(row.key, event.target),
      " ": () => this.#click(row.key, event.target),
    };
    if (!actions[event.key]) return;
    event.preventDefault();
    event.stopPropagation();
    actions[event.key]();
  }
}

/** Whether all sensors of a row are fresh: nothing else is green. */
function isFresh({ level, bad, report, children }) {
  if (level === 2) return children.length > 0 && children.every(isFresh);
  return !bad && report.sensors > 0 && report.fresh === report.sensors;
}

/** Texts of a row's figures; always as many for a row of a level. */
export function figuresOf({ level, report }) {
  if (level === 2) return [isKnown(report.load) ? percent(report.load) : ""];
  return [isKnown(report.rate_hz) ? rate(report.rate_hz) : "", isKnown(report.age_ms) ? age(report.age_ms) : ""];
}
