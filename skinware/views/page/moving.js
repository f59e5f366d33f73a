// Drag bodies apart: each driver's taxels together, where no file of links says their places.

import { pick } from "./picking.js";

const STEP_PX = 12; // of a key

/** How far something as far away as a place moves when the pointer does, m. */
function moveOf(stage, place, dx, dy) {
  const scale = stage.project(...place)[2] / stage.pixels;
  const m = stage.camera.matrixWorld.elements;
  return [0, 1, 2].map((c) => scale * (dx * m[c] - dy * m[4 + c]));
}

export class Moving {
  /**
   * @param {HTMLElement} host around the stage.
   * @param {Stage} stage
   * @param {object} actions `mayMove()`; `moved()`.
   */
  constructor(host, stage, { mayMove, moved }) {
    Object.assign(this, { stage, mayMove, moved });
    let held = null;
    const at = (event) => {
      const box = stage.host.getBoundingClientRect();
      return [event.clientX - box.left, event.clientY - box.top];
    };
    const begin = (event) => {
      const found = event.altKey && mayMove() && stage.host.contains(event.target) && pick(stage, stage.sheets, ...at(event));
      if (!found) return;
      event.stopPropagation(); // nothing turns, nothing is pinned
      held = { ...found, at: at(event) };
    };
    host.addEventListener("pointerdown", begin, true);
    addEventListener("pointermove", (event) => {
      if (!held) return;
      const [x, y] = at(event);
      const { sheet, i } = held;
      this.#move(sheet.driver, sheet.place(i), x - held.at[0], y - held.at[1]);
      held.at = [x, y];
    });
    addEventListener("pointerup", () => (held = null));
  }

  /** Move a driver by a step of a key. */
  step(driver, right, up) {
    const sheet = this.stage.sheets.find((one) => one.driver === driver);
    if (sheet && this.mayMove()) this.#move(driver, sheet.place(0), STEP_PX * right, -STEP_PX * up);
  }

  #move(driver, place, dx, dy) {
    driver.move(moveOf(this.stage, place, dx, dy));
    this.moved();
  }
}
