// The mark of a taxel's status: one for all its bits, in the same order as in skin-top.

export const FRESH = 0;
export const STALE = 1;
export const OUT_OF_RANGE = 2;
export const SUSPECT = 3;
export const UNHEALTHY = 4;
export const NO_ACK = 5; // from here on the value means nothing and is not drawn
export const MASKED = 6;
export const NEVER_SEEN = 7;
export const NOT_CONNECTED = 8;
export const UNTOUCHED = 9;
const WITHOUT_VALUE = 10;
const SETTLING = 11;
const ALL_BITS = 0xff; // of a status: the baseline is not known yet

export const DIMMED = 0x80; // beside the mark: not part of what is selected

export const MARKS = [
  { name: "fresh", sign: "" },
  { name: "stale", sign: "small and faded, in a rim" },
  { name: "out of range", sign: "a second rim" },
  { name: "suspect", sign: "a target" },
  { name: "unhealthy", sign: "a plus" },
  { name: "no answer", sign: "hatched" },
  { name: "switched off", sign: "a bar" },
  { name: "never seen", sign: "hollow, with a dot" },
  { name: "not connected", sign: "crossed" },
  { name: "not touched", sign: "a bold rim" },
  { name: "no value", sign: "hollow" },
  { name: "settling", sign: "hollow, until its baseline is known" },
];

const BITS = [
  [NOT_CONNECTED, 16],
  [NEVER_SEEN, 1],
  [MASKED, 32],
  [NO_ACK, 8],
  [STALE, 2],
  [SUSPECT, 64],
  [UNHEALTHY, 128],
  [OUT_OF_RANGE, 4],
];

const MARK_OF = Uint8Array.from({ length: 256 }, (_, status) => {
  if (status === ALL_BITS) return SETTLING;
  const found = BITS.find(([, bit]) => status & bit);
  return found ? found[0] : FRESH;
});

/** The mark of a status: of several bits the one that says most. */
export const markOf = (status) => MARK_OF[status];

/** Whether a mark is that of a value of now. */
export const isCurrent = (mark) => (mark & ~DIMMED) !== STALE && (mark & ~DIMMED) < NO_ACK;

/** The names of a status' bits; "fresh" if there are none. */
export function statusText(status) {
  if (status === ALL_BITS) return MARKS[SETTLING].name;
  const names = BITS.filter(([, bit]) => status & bit).map(([mark]) => MARKS[mark].name);
  return names.length ? names.join(", ") : MARKS[FRESH].name;
}

const TOUCHED_LEVEL = 250; // in a wipe test: moved as far as a touch moves it
const NO_LEVEL = 255;

/**
 * The marks of n taxels, one byte each.
 * @param {Uint8Array} status
 * @param {Uint8Array} levels 255: no value.
 * @param {Uint8Array} marks where to put them.
 * @param {object} how
 * @param {?Uint8Array} how.dimmed 1: not part of what is selected.
 * @param {boolean} how.isOld the driver is gone or silent: nothing of it is fresh.
 * @param {boolean} how.isWipe levels are those of a wipe test: below 250 is not touched yet.
 * @returns {boolean} some mark is another one than before.
 */
export function fillMarks(status, levels, marks, { dimmed = null, isOld = false, isWipe = false } = {}) {
  let differs = false;
  for (let i = 0; i < marks.length; i++) {
    let mark = MARK_OF[status[i]];
    if (mark < NO_ACK) {
      if (levels[i] === NO_LEVEL) mark = WITHOUT_VALUE;
      else if (isWipe && levels[i] < TOUCHED_LEVEL) mark = UNTOUCHED;
      else if (isOld) mark = STALE;
    }
    if (dimmed?.[i]) mark |= DIMMED;
    if (marks[i] !== mark) {
      marks[i] = mark;
      differs = true;
    }
  }
  return differs;
}
