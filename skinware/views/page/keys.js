// The actions of keys, and the page that lists them.

import { h } from "./dom.js";
import { FRESH, MARKS } from "./marks.js";
import { picture } from "./legend.js";

const KEYS = [
  ["1 2 3 4", "values, change, peaks, wipe test"],
  ["t", "next type of sensor"],
  ["b", "zero: what is felt now becomes rest"],
  ["w l", "start or end the wipe test; save its list"],
  ["space", "pause, and go on; also a recording"],
  ["[ ]", "scroll back and forth while paused, and in a recording"],
  [", .", "a sample back or forth in a recording"],
  ["r", "record"],
  ["s S", "save a picture: PNG, SVG"],
  ["g", "plot the taxel that is pointed at, or what is selected"],
  ["m", "mark an event, also in the recording"],
  ["f", "show all; what is selected, if something is"],
  ["arrows + -", "go around, nearer, away"],
  ["j k", "next, previous taxel"],
  ["p", "pin the taxel that is pointed at, or let it go"],
  ["n", "normals"],
  ["h", "names of hands, fingers, pads and boards"],
  ["a", "scale as it fits"],
  ["d", "light, dark"],
  ["esc", "select nothing, let all pins go"],
  ["?", "this page"],
];

/** Fill the dialog of keys and marks. */
export function fillHelp(dialog, theme) {
  const keys = KEYS.flatMap(([names, text]) => [
    h("dt", {}, ...names.split(" ").map((name) => h("kbd", {}, name))),
    h("dd", {}, text),
  ]);
  const marks = MARKS.flatMap(({ name, sign }, mark) =>
    mark === FRESH ? [] : [h("dt", {}, picture(mark, theme)), h("dd", {}, `${name}: ${sign}`)],
  );
  const close = { type: "button", class: "plain", "aria-label": "Close", onclick: () => dialog.close() };
  const pointing =
    "The mouse turns, the right button or shift moves, the wheel zooms; " +
    "on a touch screen one finger turns, two move and zoom. " +
    "Drag a body with alt to move it, or select it and press shift and arrows; not where a file of links says its place.";
  dialog.replaceChildren(
    h("header", {}, h("h2", {}, "Keys and marks"), h("button", close, "✕")),
    h("div", { class: "columns" }, h("dl", {}, ...keys), h("dl", {}, ...marks)),
    h("p", { class: "hint" }, pointing),
  );
}

/**
 * Listen to keys.
 * @param {Object<string, Function>} actions by the key's name; those with alt, ctrl or meta are the browser's.
 */
export function onKeys(actions) {
  document.addEventListener("keydown", (event) => {
    if (event.altKey || event.ctrlKey || event.metaKey || event.defaultPrevented) return;
    if (event.target.closest("input:not([type=range]), select, dialog")) return;
    const isSpaceOfButton = event.key === " " && event.target.closest("button, [role=treeitem]");
    const hasArrows = event.target.closest("input, [role=treeitem], [role=radio]");
    const action = actions[event.key];
    if (!action || isSpaceOfButton || (hasArrows && event.key.startsWith("Arrow"))) return;
    event.preventDefault();
    action(event);
  });
}
