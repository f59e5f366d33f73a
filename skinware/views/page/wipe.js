// The wipe test: a hand goes over the whole skin; what does not answer is listed.

import { h, save, setHidden, setText, stamp } from "./dom.js";
import { count } from "./format.js";
import { UNTOUCHED } from "./marks.js";

/** Taxels that have not answered: [{sheet, i}]. */
export function untouched(sheets) {
  return sheets.flatMap((sheet) =>
    [...sheet.shown.marks].flatMap((mark, i) => ((mark & 0x7f) === UNTOUCHED ? [{ sheet, i }] : [])),
  );
}

/** The list as a text: a line for each, with its place in a frame, its uid and its name. */
function listOf(sheets, progress) {
  const found = untouched(sheets);
  const title = `# ${progress.touched} of ${progress.of} touched; those that were not:`;
  const head = [title, "# driver, position in a frame, uid, name"];
  const rows = found.map(({ sheet, i }) =>
    [sheet.driver.name, sheet.index[i], `0x${sheet.uid[i].toString(16)}`, sheet.names?.[i] ?? ""].join("\t"),
  );
  return [...head, ...rows, ""].join("\n");
}

export class Wipe {
  /** @param {object} actions `start()`, `stop()`, `sheets()`. */
  constructor(host, actions) {
    this.host = host;
    this.actions = actions;
    this.isRunning = false;
    this.text = h("strong", { role: "status" });
    this.meter = h("progress", { "aria-label": "Taxels touched" });
    const button = (text, title, onclick) => h("button", { type: "button", title, onclick }, text);
    this.run = button("Stop", "Start or end the test (w)", () => this.toggle());
    this.list = button("Save the list", "Of those that were not touched (l)", () => this.save());
    host.append(this.text, this.meter, h("div", { class: "group" }, this.run, this.list));
  }

  /** @param {boolean} isShown the mode is that of the test. */
  show(isShown) {
    if (isShown === !this.host.hidden) return;
    setHidden(this.host, !isShown);
    this.isRunning = isShown;
    this.progress = null;
    setText(this.text, "Wipe over the whole skin");
    setText(this.run, "Stop");
  }

  toggle() {
    this.isRunning = !this.isRunning;
    setText(this.run, this.isRunning ? "Stop" : "Start anew");
    this.actions[this.isRunning ? "start" : "stop"]();
  }

  update(progress) {
    if (!progress) return;
    this.progress = progress;
    this.isRunning = progress.running ?? this.isRunning;
    setText(this.run, this.isRunning ? "Stop" : "Start anew");
    setText(this.text, `${count(progress.touched)} of ${count(progress.of)} touched`);
    this.meter.max = Math.max(progress.of, 1);
    this.meter.value = progress.touched;
  }

  save() {
    if (!this.progress) return;
    save(new Blob([listOf(this.actions.sheets(), this.progress)], { type: "text/plain" }), `never-touched-${stamp()}.txt`);
  }
}
