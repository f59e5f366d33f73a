// Recordings in the page: which the address names, the moment that it leads to, and files that are dropped.

const SUFFIX = ".mcap";
const KEEP_EVERY_MS = 1000;

/** Names of the recordings that an address asks for. */
export const recordingsOf = (search) => new URLSearchParams(search).getAll("recording");

/** Brings recordings to the moment of an address, and also where they were before a connection was lost. */
export class Moments {
  #isDue = true;
  #kept_ms = 0;

  /** @param {?number[]} times_s of an address, one of each recording; null: play from the begin. */
  constructor(times_s, act) {
    this.times_s = times_s;
    this.plays = !times_s;
    this.act = act;
  }

  /** The server plays them from the begin, and paused. */
  connected() {
    this.#isDue = true;
  }

  /** @returns {boolean} the address should be kept. */
  take(replays) {
    if (!replays.some(({ title }) => title)) return false;
    if (this.#isDue) {
      this.#isDue = false;
      this.times_s?.forEach((time_s, i) => i < replays.length && this.act("seek", time_s, i));
      if (this.plays) this.act("resume", null);
      return false;
    }
    const times_s = replays.map(({ time_s }) => time_s);
    const hasMoved = times_s.some((time_s, i) => time_s !== this.times_s?.[i]);
    this.times_s = times_s;
    this.plays = replays.some(({ paused }) => !paused);
    if (!hasMoved || (this.plays && performance.now() - this.#kept_ms < KEEP_EVERY_MS)) return false;
    this.#kept_ms = performance.now();
    return true;
  }
}

/**
 * Open recordings that are dropped on the page: one, several beside each other, or one beside the one that is shown.
 * @param {(text: string) => void} notify
 */
export function onDrop(notify) {
  const hasFiles = (event) => event.dataTransfer?.types.includes("Files");
  document.addEventListener("dragover", (event) => hasFiles(event) && event.preventDefault());
  document.addEventListener("drop", async (event) => {
    if (!hasFiles(event)) return;
    event.preventDefault();
    const files = [...event.dataTransfer.files];
    const other = files.find(({ name }) => !name.endsWith(SUFFIX));
    if (other) return notify(`${other.name} is no recording: those end with ${SUFFIX}.`);
    const sizes = await Promise.all(files.map(async ({ name }) => (await fetch(`recordings/${encodeURIComponent(name)}`)).text()));
    const unseen = files.find(({ size }, i) => Number(sizes[i]) !== size);
    if (unseen) {
      const folder = "a browser does not say in which folder it is. Where it is, type:";
      return notify(`skin-view does not find this ${unseen.name}; ${folder} skin-view ${files.map(({ name }) => name).join(" ")}`);
    }
    const shown = recordingsOf(location.search);
    const names = files.map(({ name }) => name);
    const all = shown.length === 1 && names.length === 1 && !shown.includes(names[0]) ? [...shown, ...names] : names;
    const query = new URLSearchParams(location.search);
    query.delete("recording");
    for (const name of all) query.append("recording", name);
    location.assign(`${location.pathname}?${query}`);
  });
}
