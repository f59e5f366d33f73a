// Ways to handle what a person points at and presses.

import { h, setPressed } from "./dom.js";

const CLICK_PX = 4; // a mouse that moved less has clicked

/**
 * Listen to the mouse, or to fingers.
 * @param {HTMLElement} host
 * @param {object} actions `over(x, y)`: the mouse is there, or nowhere (null); `click(x, y)`; CSS pixels within it.
 */
export function onPointer(host, { over, click }) {
  let pressed = null;
  const within = (event) => {
    const box = host.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  };
  host.addEventListener("pointermove", (event) => {
    if (event.pointerType !== "touch" && !event.buttons) over(...within(event));
  });
  host.addEventListener("pointerleave", () => over(null, null));
  host.addEventListener("pointerdown", (event) => (pressed = within(event)));
  host.addEventListener("pointerup", (event) => {
    const [x, y] = within(event);
    if (pressed && event.button === 0 && Math.hypot(x - pressed[0], y - pressed[1]) <= CLICK_PX) click(x, y);
    pressed = null;
  });
}

const STEPS = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 };

/** Buttons of which one is chosen. */
export class Modes {
  /**
   * @param {HTMLElement} host
   * @param {Object<string, string>} names text of each mode's button.
   * @param {(mode: string) => void} choose
   */
  constructor(host, names, choose) {
    this.buttons = Object.entries(names).map(([mode, name]) => {
      const attributes = { type: "button", role: "radio", "data-role": "mode", "data-mode": mode };
      return h("button", { ...attributes, onclick: () => choose(mode) }, name);
    });
    host.append(...this.buttons);
    host.addEventListener("keydown", (event) => {
      if (!STEPS[event.key]) return;
      const n = this.buttons.length;
      const next = this.buttons[(this.buttons.indexOf(event.target) + STEPS[event.key] + n) % n];
      choose(next.dataset.mode);
      next.focus();
      event.preventDefault();
    });
  }

  show(mode) {
    for (const button of this.buttons) {
      const isChosen = button.dataset.mode === mode;
      button.setAttribute("aria-checked", String(isChosen));
      button.tabIndex = isChosen ? 0 : -1;
    }
  }
}

/** Tabs choose which panel is seen where there is room for one. */
export function useTabs(host) {
  const choose = (tab) => {
    for (const other of host.children) setPressed(other, other === tab);
    document.body.dataset.panel = tab.dataset.panel;
  };
  for (const tab of host.children) tab.addEventListener("click", () => choose(tab));
  choose(host.firstElementChild);
}
