// Contacts and regions that services publish: their lists, and the places of contacts.

import { h, setChildren, setHidden, setText } from "./dom.js";
import { short } from "./format.js";

const CONTACTS = ["", "", "load", "mm/s", "s"];
const LOAD = CONTACTS.indexOf("load");

export class Touches {
  constructor(contacts, regions) {
    this.contacts = contacts;
    this.regions = regions;
    this.contactRows = h("tbody");
    this.regionRows = h("tbody");
    const headOf = (names) => h("tr", {}, ...names.map((name) => h("th", { scope: "col" }, name)));
    this.contactHead = headOf(CONTACTS);
    this.regionHead = headOf(["", "", ""]);
    contacts.append(h("h2", {}, "Contacts"), h("table", {}, h("thead", {}, this.contactHead), this.contactRows));
    regions.append(h("h2", {}, "Regions"), h("table", {}, h("thead", {}, this.regionHead), this.regionRows));
  }

  /** Take a turn; says where the contacts are: [{id, at, normal, area_m2}]. */
  update(skin, header) {
    const places = (header.contacts ?? []).map((contact) => ({ ...contact, at: placeOf(skin, contact) }));
    setHidden(this.contacts, this.contacts.hidden && !places.length); // once there were some, it stays
    const load = inUnit(places);
    setText(this.contactHead.cells[LOAD], load.unit ? `load, ${load.unit}` : "load");
    fill(
      this.contactRows,
      places.map((contact) => [
        `${contact.id}`,
        contact.kind ?? "",
        load.write(contact.load, contact.unit),
        (1000 * contact.speed).toFixed(0),
        short(contact.age_s),
      ]),
    );
    setHidden(this.regions, !header.regions?.length);
    const regions = header.regions ?? [];
    const region = inUnit(regions);
    setText(this.regionHead.cells[1], region.unit);
    fill(
      this.regionRows,
      regions.map(({ name, value, unit, touched }) => [name, region.write(value, unit), touched ? "◉ touched" : ""]),
    );
    return places.filter(({ at }) => at);
  }
}

/** The unit of all rows for the head of a column, and the text of a value; with several units, each value has its own. */
function inUnit(rows) {
  const units = new Set(rows.map(({ unit }) => unit ?? ""));
  if (units.size > 1) return { unit: "", write: (x, unit) => `${short(x)} ${unit ?? ""}`.trim() };
  return { unit: [...units][0] ?? "", write: short };
}

function placeOf(skin, { position, driver, sensor }) {
  if (position?.every(Number.isFinite)) return position;
  const found = sensor === undefined ? null : skin.find(driver, sensor);
  return found && [...found.sheet.place(found.i)];
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
