// The last 30 seconds of what was drawn, in bounded memory; the oldest is forgotten first.

import { PARTS } from "./skin.js";

const LONGEST_MS = 30_000;
const MOST_BYTES = 64e6;
const CONTACT_BYTES = 500; // about

export class Past {
  #series = new Map(); // sheet -> pictures, the oldest first: the parts of a sheet, at_ms, bytes

  constructor({ longest_ms = LONGEST_MS, most_bytes = MOST_BYTES } = {}) {
    this.longest_ms = longest_ms;
    this.most_bytes = most_bytes;
    this.bytes = 0;
  }

  /** Keep what a sheet shows now. */
  push(sheet, at_ms) {
    if (!this.#series.has(sheet)) this.#series.set(sheet, []);
    const series = this.#series.get(sheet);
    const kept = { at_ms, bytes: CONTACT_BYTES * (sheet.contacts?.length ?? 0) };
    for (const part of PARTS) {
      const isNew = ArrayBuffer.isView(sheet[part]) && part !== "status";
      kept[part] = isNew ? sheet[part].slice() : sheet[part]; // a status is one array until it changes
      if (isNew) kept.bytes += kept[part].byteLength;
    }
    if (sheet.status !== series.at(-1)?.status) kept.bytes += sheet.status.byteLength;
    series.push(kept);
    this.bytes += kept.bytes;
    this.#forget(at_ms);
  }

  /** The picture of a sheet at a time: the newest until then, or else the oldest; null for an unknown sheet. */
  at(sheet, at_ms) {
    const series = this.#series.get(sheet);
    if (!series?.length) return null;
    return series[Math.max(series.findLastIndex((kept) => kept.at_ms <= at_ms), 0)];
  }

  /** The time of the oldest picture, ms; null if there is none. */
  get oldest_ms() {
    const times = [...this.#series.values()].filter((series) => series.length).map((series) => series[0].at_ms);
    return times.length ? Math.min(...times) : null;
  }

  /** Forget all but some sheets. */
  keepOnly(sheets) {
    for (const [sheet, series] of this.#series) {
      if (sheets.includes(sheet)) continue;
      for (const { bytes } of series) this.bytes -= bytes;
      this.#series.delete(sheet);
    }
  }

  #forget(now_ms) {
    for (const series of this.#series.values()) {
      while (series.length > 1 && series[0].at_ms < now_ms - this.longest_ms) this.bytes -= series.shift().bytes;
    }
    while (this.bytes > this.most_bytes) {
      const all = [...this.#series.values()].filter((series) => series.length > 1);
      if (!all.length) return;
      const oldest = all.reduce((one, other) => (other[0].at_ms < one[0].at_ms ? other : one));
      this.bytes -= oldest.shift().bytes;
    }
  }
}
