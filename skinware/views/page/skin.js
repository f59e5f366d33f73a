// The skin as the page knows it: drivers, their sheets of taxels, and the newest values.

import { fillMarks } from "./marks.js";
import { TOP } from "./palette.js";

const NOTHING = 255;
const DRAWN_PART = 0.44; // radius of a disc, of the distance to its neighbour

/** What a picture of a sheet consists of. */
export const PARTS = ["levels", "status", "shear", "totals", "contacts", "regions", "scale", "mode"];

/** n taxels of one type of a driver. */
class Sheet {
  constructor(driver, table, blob) {
    this.driver = driver;
    this.type = table.name;
    this.unit = table.unit;
    this.n = table.n;
    this.isTouch = table.touch;
    this.total = table.total; // of several taxels: "sum" or "highest"
    this.index = blob(table.index, Uint32Array); // positions in a frame
    this.uid = blob(table.uid, BigUint64Array);
    this.patch = blob(table.patch, Uint16Array);
    this.module = blob(table.module, Uint16Array);
    this.arrange(table, blob);
    this.names = null; // asked for when somebody points at one
    this.status = new Uint8Array(this.n).fill(1); // never seen, until a picture says more
    this.levels = new Uint8Array(this.n).fill(NOTHING);
    this.shear = null;
    this.totals = null; // by module
    this.between = null; // the same of each snapshot since the picture before
    this.contacts = [];
    this.regions = [];
    this.scale = [0, 1];
    this.mode = "raw";
    this.dimmed = null;
    this.shown = { marks: new Uint8Array(this.n) };
    this.marksVersion = 0;
    this.show();
  }

  /** Where the taxels are; that may change while they stay the same. */
  arrange(table, blob) {
    this.placed = table.placed;
    this.scenePosition = blob(table.position, Float32Array);
    this.moved();
    this.normal = blob(table.normal, Float32Array).map((x) => (Number.isNaN(x) ? 0 : x));
    this.radius = new Float32Array(this.n).fill(DRAWN_PART * table.neighbour_spacing_m);
  }

  /** Its driver was moved. */
  moved() {
    const { shift } = this.driver;
    this.position = this.scenePosition.map((x, i) => x + shift[i % 3]);
  }

  /** Take a picture of a turn; arrays are kept, never written to again. */
  take(picture, mode, blob) {
    this.levels = blob(picture.levels, Uint8Array);
    if (picture.status) this.status = blob(picture.status, Uint8Array);
    this.shear = picture.shear ? blob(picture.shear, Int8Array) : null;
    this.totals = picture.totals ? blob(picture.totals, Float32Array) : null;
    this.between = picture.between ? blob(picture.between, Float32Array) : null;
    const { shift } = this.driver;
    this.contacts = picture.contacts.map((contact) => ({ ...contact, at: contact.position.map((x, c) => x + shift[c]) }));
    this.regions = picture.regions;
    this.scale = picture.scale;
    this.mode = mode;
  }

  /** Show the newest, or a picture of the past, all of one moment. */
  show(picture = this) {
    for (const part of PARTS) this.shown[part] = picture[part];
    this.fill();
  }

  fill() {
    const { status, levels, marks, mode } = this.shown;
    const how = { dimmed: this.dimmed, isOld: this.driver.isOld, isWipe: mode === "wipe" };
    if (fillMarks(status, levels, marks, how)) this.marksVersion++;
  }

  /** The value of a taxel, as exact as its level; null without one. */
  valueOf(i) {
    const { levels, scale } = this.shown;
    return levels[i] > TOP ? null : scale[0] + (levels[i] / TOP) * (scale[1] - scale[0]);
  }

  /** Where a taxel is, m. */
  place(i) {
    return this.position.subarray(3 * i, 3 * i + 3);
  }
}

/** A driver of a generation. */
class Driver {
  constructor(table, blob, shift = [0, 0, 0]) {
    this.shift = shift; // by which a person moved it, m
    this.id = table.id;
    this.name = table.name;
    this.namespace = table.namespace;
    this.type = table.type;
    this.key = keyOf(table);
    this.generation = table.generation;
    this.buses = table.buses;
    this.patches = table.patches;
    this.modules = table.modules;
    this.state = "live";
    this.isCut = false; // the connection to the server is lost
    this.arrange(table, blob);
    this.sheets = new Map(table.types.map((type) => [type.name, new Sheet(this, type, blob)]));
  }

  /** The fingers and palms of its nominal hands; they may move while the driver stays the same. */
  arrange(table, blob) {
    this.sceneOutlines = (table.bodies ?? []).map((outline) => blob(outline, Float32Array));
  }

  /** The corners of each, as places of something that has no size. */
  get outlines() {
    return this.sceneOutlines.map((outline) => {
      const position = outline.map((x, i) => x + this.shift[i % 3]);
      return { n: position.length / 3, position, radius: new Float32Array(position.length / 3) };
    });
  }

  move(by) {
    this.shift = this.shift.map((x, c) => x + by[c]);
    for (const sheet of this.sheets.values()) sheet.moved();
  }

  get isOld() {
    return this.isCut || this.state !== "live";
  }
}

export class Skin {
  drivers = new Map(); // by id
  links = [];
  namespaces = [];
  names = []; // of the drivers that are followed; empty: all
  recordings = []; // titles of those that are shown; empty: drivers are live
  isPosed = false; // a file says where coordinate frames are
  mode = "raw"; // of the newest pictures
  shifts = {}; // of drivers that a person moved, by key

  /**
   * Take tables, names and values from a turn.
   * @returns {boolean} the structure is another one.
   */
  take(header, blob) {
    if (header.skin) {
      this.namespaces = header.skin.namespaces ?? [];
      this.names = header.skin.names ?? [];
      this.recordings = header.skin.recordings ?? [];
      this.isPosed = header.skin.posed ?? false;
      for (const { key, shift } of this.drivers.values()) if (shift.some(Boolean)) this.shifts[key] = shift;
      this.links = header.skin.links ?? [];
      this.drivers = new Map(header.skin.drivers.map((table) => [table.id, this.#driver(table, blob)]));
    }
    this.mode = header.mode ?? this.mode;
    for (const table of header.state?.drivers ?? []) {
      const driver = this.drivers.get(table.id);
      if (driver) driver.state = table.state;
    }
    for (const picture of header.pictures ?? []) {
      const sheet = this.sheet(picture.driver, picture.type);
      if (sheet && sheet.driver.generation === picture.generation) sheet.take(picture, this.mode, blob);
    }
    const named = header.names && this.sheet(header.names.driver, header.names.type);
    if (named) named.names = header.names.of;
    return Boolean(header.skin);
  }

  /** A driver whose structure is known is kept, with what is known of its taxels. */
  #driver(table, blob) {
    const driver = this.drivers.get(table.id);
    if (driver?.generation !== table.generation || driver.key !== keyOf(table)) return new Driver(table, blob, this.shifts[keyOf(table)]);
    for (const type of table.types) driver.sheets.get(type.name).arrange(type, blob);
    driver.arrange(table, blob);
    return driver;
  }

  sheet(driver, type) {
    return this.drivers.get(driver)?.sheets.get(type);
  }

  /** All sheets, or those of a type. */
  sheets(type) {
    const all = [...this.drivers.values()].flatMap((driver) => [...driver.sheets.values()]);
    return type === undefined ? all : all.filter((sheet) => sheet.type === type);
  }

  /** The sheets to draw: those of a type, or without a type the first of each driver. */
  shown(type) {
    const firsts = [...this.drivers.values()].map((driver) => driver.sheets.values().next().value);
    return type ? this.sheets(type) : firsts.filter(Boolean);
  }

  /** Names of the types, the most taxels first. */
  types() {
    const counts = new Map();
    for (const sheet of this.sheets()) counts.set(sheet.type, (counts.get(sheet.type) ?? 0) + sheet.n);
    return [...counts].sort((a, b) => b[1] - a[1]).map(([name]) => name);
  }

  /** Where a sensor of a driver is drawn: its sheet and the taxel's place in it; null if it is not. */
  find(driver, position) {
    for (const sheet of this.drivers.get(driver)?.sheets.values() ?? []) {
      const i = sheet.index.indexOf(position);
      if (i >= 0) return { sheet, i };
    }
    return null;
  }

  /** The connection is lost, or back. */
  cut(isCut) {
    for (const driver of this.drivers.values()) driver.isCut = isCut;
    for (const sheet of this.sheets()) sheet.fill();
  }
}

/** The outlines of all drivers of sheets. */
export const outlinesOf = (sheets) => [...new Set(sheets.map(({ driver }) => driver))].flatMap(({ outlines }) => outlines);

const keyOf = ({ namespace, name }) => `${namespace}/${name}`;
