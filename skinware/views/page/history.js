// The last 30 seconds of what was drawn, in bounded memory; the oldest is forgotten first.

const LONGEST_MS = 30_000;
const MOST_BYTES = 64e6;

export class Past {
  #series = new Map(); // sheet -> [{at_ms, levels, status, shear, scale, mode, bytes}], oldest first

  constructor({ longest_ms = LONGEST_MS, most_bytes = MOST_BYTES } = {}) {
    this.longest_ms = longest_ms;
    this.most_bytes = most_bytes;
    this.bytes = 0;
  }

  /** Keep what a sheet shows now. */
  push(sheet, at_ms) {
    if (!this.#series.has(sheet)) this.#series.set(sheet, []);
    const series = this.#series.get(sheet);
    const before = series.at(-1);
    const status = before && same(before.status, sheet.status) ? before.status : sheet.status.slice();
    const kept = { at_ms, levels: sheet.levels.slice(), status, shear: sheet.shear?.slice() ?? null };
    Object.assign(kept, { scale: sheet.scale, mode: sheet.mode });
    kept.bytes = kept.levels.length + (status === before?.status ? 0 : status.length) + (kept.shear?.length ?? 0);
    series.push(kept);
    this.bytes += kept.bytes;
    this.#forget(at_ms);
  }

  /** The picture of a sheet at a time: the newest until then, or else the oldest; null for an unknown sheet. */
  at(sheet, at_ms) {
    const series = this.#series.get(sheet);
    if (!series?.length) return null;
    let low = 0;
    let high = series.length;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (series[middle].at_ms <= at_ms) low = middle + 1;
      else high = middle;
    }
    return series[Math.max(low - 1, 0)];
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

function same(one, other) {
  return one === other || (one.length === other.length && one.every((byte, i) => byte === other[i]));
}
