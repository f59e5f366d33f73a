// The lists of loads of hands, fingers and pads, and of contacts and regions that services publish.

import { h, setChildren, setHidden, setText } from "./dom.js";
import { isKnown, prefixed, short } from "./format.js";

const CONTACTS = ["No.", "kind", "load", "mm/s", "s"];
const LOAD = CONTACTS.indexOf("load");
const MOST_PARTS = 60;

export class Touches {
  /**
   * @param {(row: HTMLElement, lineOf: () => object) => void} equip called with each new row that can be plotted.
   * @param {{contact: Function, part: Function}} lines the line of a contact, and of a part.
   * @param {() => void} release called to begin again with peaks.
   */
  constructor({ loads, contacts, regions }, equip, lines, release) {
    Object.assign(this, { equip, lines, loads });
    this.contacts = contacts;
    this.regions = regions;
    this.contactRows = h("tbody");
    this.regionRows = h("tbody");
    const headOf = (names) => h("tr", {}, ...names.map((name) => h("th", { scope: "col" }, name)));
    this.contactHead = headOf(CONTACTS);
    this.regionHead = headOf(["Region", "load", "touch"]);
    this.partRows = h("tbody");
    this.partHead = headOf(["Part", "load", "most"]);
    const reset = h("button", { type: "button", title: "Begin again with what is now the most", onclick: release }, "Reset");
    loads.append(h("header", {}, h("h2", {}, "Loads"), reset), h("table", {}, h("thead", {}, this.partHead), this.partRows));
    contacts.append(h("h2", {}, "Contacts"), h("table", {}, h("thead", {}, this.contactHead), this.contactRows));
    regions.append(h("h2", {}, "Regions"), h("table", {}, h("thead", {}, this.regionHead), this.regionRows));
  }

  /** @param {object[]} parts with loads; @param {object[]} contacts that are shown; @param {object[]} regions */
  update(parts, contacts, regions) {
    this.parts = parts.slice(0, MOST_PARTS);
    setHidden(this.loads, !parts.length);
    while (this.partRows.rows.length < this.parts.length) this.partRows.append(this.#row((at) => this.lines.part(this.parts[at])));
    const part = inUnit(this.parts.map(({ sheet }) => sheet), this.parts.map(({ peak }) => peak));
    setText(this.partHead.cells[LOAD - 1], part.unit ? `load, ${part.unit}` : "load");
    fill(this.partRows, this.parts.map(({ name, total, peak, sheet: { unit } }) => [name, part.write(total, unit), part.write(peak, unit)]));
    this.parts.forEach(({ size }, row) => (this.partRows.rows[row].dataset.size = size));
    setHidden(this.contacts, this.contacts.hidden && !contacts.length); // once there were some, it stays
    const load = inUnit(contacts, contacts.map((contact) => contact.load));
    this.shown = contacts;
    while (this.contactRows.rows.length < contacts.length) this.contactRows.append(this.#row((at) => this.lines.contact(this.shown[at])));
    setText(this.contactHead.cells[LOAD], load.unit ? `load, ${load.unit}` : "load");
    fill(
      this.contactRows,
      contacts.map((contact) => [
        `${contact.id}`,
        contact.kind ?? "",
        load.write(contact.load, contact.unit),
        (1000 * contact.speed).toFixed(0),
        short(contact.age_s),
      ]),
    );
    setHidden(this.regions, !regions.length);
    const region = inUnit(regions, regions.map(({ value }) => value));
    setText(this.regionHead.cells[1], region.unit);
    fill(
      this.regionRows,
      regions.map(({ name, value, unit, touched }) => [name, region.write(value, unit), touched ? "◉ touched" : ""]),
    );
  }

  #row(lineOf) {
    const row = h("tr", { tabindex: 0, title: "Plot its load (Enter)" });
    this.equip(row, () => lineOf(row.sectionRowIndex));
    return row;
  }
}

/** The unit of all rows for the head of a column, and the text of a value; with several units, each value has its own. */
function inUnit(rows, values) {
  const units = new Set(rows.map(({ unit }) => unit ?? ""));
  const write = (x, [factor, unit]) => `${short(isKnown(x) ? x / factor : x)} ${unit}`.trim();
  if (units.size > 1) return { unit: "", write: (x, unit) => write(x, prefixed(unit ?? "", x)) };
  const [factor, unit] = prefixed([...units][0] ?? "", Math.max(0, ...values.map((x) => Math.abs(x ?? 0))));
  return { unit, write: (x) => write(x, [factor, ""]) };
}

function fill(body, rows) {
  while (body.rows.length < rows.length) body.append(h("tr"));
  setChildren(body, [...body.rows].slice(0, rows.length));
  rows.forEach((cells, r) => {
    const row = body.rows[r];
    while (row.cells.length < cells.length) row.append(h("td"));
    cells.forEach((text, c) => setText(row.cells[c], text));
  });
}
