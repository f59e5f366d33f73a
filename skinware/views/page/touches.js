// Contacts and regions, where services tell them: lists, and where contacts are drawn.

import { h, setChildren, setHidden, setText } from "./dom.js";
import { measure, short } from "./format.js";

const COLUMNS = ["", "", "load", "mm/s", "s"];

export class Touches {
  constructor(contacts, regions) {
    this.contacts = contacts;
    this.regions = regions;
    this.contactRows = h("tbody");
    this.regionRows = h("tbody");
    const head = h("tr", {}, ...COLUMNS.map((name) => h("th", { scope: "col" }, name)));
    contacts.append(h("h2", {}, "Contacts"), h("table", {}, h("thead", {}, head), this.contactRows));
    regions.append(h("h2", {}, "Regions"), h("table", {}, this.regionRows));
  }

  /** Take a turn; says where the contacts are: [{id, at, normal, area_m2}]. */
  update(skin, header) {
    const places = (header.contacts ?? []).map((contact) => ({ ...contact, at: placeOf(skin, contact) }));
    setHidden(this.contacts, this.contacts.hidden && !places.length); // once there were some, it stays
    fill(
      this.contactRows,
      places.map((contact) => [
        `${contact.id}`,
        contact.kind ?? "",
        short(contact.load),
        short(1000 * contact.speed),
        short(contact.age_s),
      ]),
    );
    setHidden(this.regions, !header.regions?.length);
    fill(
      this.regionRows,
      (header.regions ?? []).map(({ name, value, unit, touched }) => {
        return [name, measure(value, unit), touched ? "◉ touched" : ""];
      }),
    );
    return places.filter(({ at }) => at);
  }
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
