// The state of the page for tests and scripts, as `window.skin`; nothing in it changes anything.

import { DIMMED, MARKS } from "./marks.js";
import { ramp } from "./palette.js";

/** @param {object} parts of main.js. */
export function hooks({ skin, stage, tree, probes, labels, rewind, replay, past, view, now, wipe, contacts, plotting }) {
  const pairOf = ({ sheet, i }) => [sheet.driver.id, sheet.index[i]];
  return {
    get connected() { return now.isAlive; },
    get turn() { return now.turn; },
    get drivers() {
      return [...skin.drivers.values()].map(({ id, name, state, generation }) => ({ id, name, state, generation }));
    },
    get problems() { return now.problems.map(({ text }) => text); },
    get contacts() { return contacts().map(({ of, ...contact }) => contact); },
    get names() { return labels().map(({ text, x, y, alpha, width }) => ({ text, x, y, alpha, width })); },
    get plots() { return plotting.strips.state; },
    get marks() { return plotting.marks; },
    get wipe() { return wipe.progress && { of: wipe.progress.of, touched: wipe.progress.touched, running: wipe.isRunning }; },
    get recording() { return now.recording; },
    get mode() { return view.mode; },
    get type() { return view.type ?? stage.sheets[0]?.type ?? null; },
    get drawnMode() { return skin.mode; },
    get theme() { return view.theme; },
    get selected() { return tree.selected; },
    get hovered() { return probes.hovered && pairOf(probes.hovered); },
    get pins() { return probes.pins.map(pairOf); },
    get untouched() { return wipe.progress?.untouched.map(pairOf) ?? []; },
    get replays() { return replay.replays; },
    get outlines() { return now.outlines; },
    get paused() { return rewind.isPaused; },
    get at_s() { return rewind.at_s; },
    get kept_bytes() { return past.bytes; },
    get camera() { return { position: stage.camera.position.toArray(), target: stage.controls.target.toArray() }; },
    get flat() { return !stage.isSolid; },
    get meshes() { return stage.meshes.length; },
    get fps() { return stage.fps; },
    get drawn() { return stage.drawn; },
    get ratio() { return stage.ratio; },

    /** The colour of a level, [r, g, b]. */
    colourOf: (level) => [...ramp(view.theme).slice(4 * level, 4 * level + 3)],

    /** Where a taxel is in the window, CSS pixels; null if it is not drawn. */
    pixelOf(driver, position) {
      const found = skin.find(driver, position);
      if (!found || !stage.sheets.includes(found.sheet)) return null;
      const box = stage.host.getBoundingClientRect();
      const [x, y] = stage.project(...found.sheet.place(found.i));
      return [box.left + x, box.top + y];
    },

    /** A taxel as it is shown; null if there is none. */
    stateOf(driver, position) {
      const found = skin.find(driver, position);
      if (!found) return null;
      const { sheet, i } = found;
      const { levels, status, marks } = sheet.shown;
      return {
        level: levels[i],
        status: status[i],
        mark: MARKS[marks[i] & ~DIMMED].name,
        dimmed: Boolean(marks[i] & DIMMED),
        value: sheet.valueOf(i),
        name: sheet.names?.[i] ?? null,
      };
    },
  };
}
