// The wipe test: a hand goes over what is selected; what does not answer is listed.

import { button, h, save, setHidden, setText, stamp } from "./dom.js";
import { count } from "./format.js";
import { DIMMED, MASKED } from "./marks.js";
import { TOP } from "./palette.js";

/**
 * How far a test is; taxels that are switched off do not count.
 * @returns {?{of: number, touched: number, untouched: {sheet, i}[]}} null if no test is shown.
 */
export function progressOf(sheets, isIn) {
  const tested = sheets.filter(({ shown }) => shown.mode === "wipe");
  if (!tested.length) return null;
  const untouched = [];
  let of = 0;
  for (const sheet of tested) {
    const { marks, levels } = sheet.shown;
    for (let i = 0; i < sheet.n; i++) {
      if (!isIn(sheet, i) || (marks[i] & ~DIMMED) === MASKED) continue;
      of++;
      if (levels[i] !== TOP) untouched.push({ sheet, i });
    }
  }
  return { of, touched: of - untouched.length, untouched };
}

/** The list as a text: a line for each, with its place in a frame, its uid and its name. */
function listOf({ touched, of, untouched }) {
  const title = `# ${touched} of ${of} touched; those that were not:`;
  const head = [title, "# driver, position in a frame, uid, name"];
  const rows = untouched.map(({ sheet, i }) =>
    [sheet.driver.name, sheet.index[i], `0x${sheet.uid[i].toString(16)}`, sheet.names?.[i] ?? ""].join("\t"),
  );
  return [...head, ...rows, ""].join("\n");
}

export class Wipe {
  /** @param {object} actions `start()`, `stop()`. */
  constructor(host, actions) {
    this.host = host;
    this.actions = actions;
    this.isRunning = false;
    this.progress = null;
    this.text = h("strong", { role: "status" });
    this.meter = h("progress", { "aria-label": "Taxels touched" });
    this.run = button("Stop", "Start or end the test (w)", () => this.toggle());
    this.list = button("Save the list", "Of those that were not touched (l)", () => this.save());
    host.append(this.text, this.meter, h("div", { class: "group" }, this.run, this.list));
  }

  /** @param {boolean} isShown the mode is that of the test. */
  show(isShown) {
    if (isShown === !this.host.hidden) return;
    setHidden(this.host, !isShown);
    this.#run(isShown);
    this.update(null, "");
  }

  toggle() {
    this.#run(!this.isRunning);
    this.actions[this.isRunning ? "start" : "stop"]();
  }

  #run(isRunning) {
    this.isRunning = isRunning;
    setText(this.run, isRunning ? "Stop" : "Start again");
  }

  /** @param {?object} progress of `progressOf`; @param {string} name of what is selected; empty: the whole skin. */
  update(progress, name) {
    this.progress = progress;
    const { touched, of } = progress ?? { touched: 0, of: 1 };
    const done = progress ? `${count(touched)} of ${count(of)} touched` : `Wipe over ${name || "the whole skin"}`;
    setText(this.text, progress && name ? `${name}: ${done}` : done);
    this.meter.max = Math.max(of, 1);
    this.meter.value = touched;
  }

  save() {
    if (!this.progress) return;
    save(new Blob([listOf(this.progress)], { type: "text/plain" }), `never-touched-${stamp()}.txt`);
  }
}
