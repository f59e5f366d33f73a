// The line of figures: of each driver its rate, age, losses and load; how fast this page draws.

import { h, setChildren, setText } from "./dom.js";
import { age, count, percent, rate } from "./format.js";
import { badness } from "./tree.js";

export class Bar {
  #chips = new Map();

  constructor(host) {
    this.host = host;
    this.own = h("span", { class: "figure own", title: "Pictures that this page draws" });
  }

  update(skin, states, stage, recording) {
    for (const id of this.#chips.keys()) if (!skin.drivers.has(id)) this.#chips.delete(id);
    for (const [id, driver] of skin.drivers) {
      if (!this.#chips.has(id)) this.#chips.set(id, h("span", { class: "figure" }, h("b"), h("span")));
      const told = states.get(id) ?? {};
      const chip = this.#chips.get(id);
      chip.dataset.bad = badness(driver.isCut ? "stale" : told.state);
      chip.dataset.driver = driver.key;
      setText(chip.firstChild, driver.name);
      const state = driver.isCut ? "no connection" : badness(told.state) ? told.state : null;
      const fresh = told.fresh === undefined ? null : `${count(told.fresh)}/${count(told.sensors)} fresh`;
      const parts = [state, rate(told.rate_hz), age(told.age_ms), fresh, `lost ${count(told.lost)}`];
      if (told.load !== undefined && told.load !== null) parts.push(`load ${percent(told.load)}`);
      setText(chip.lastChild, parts.filter(Boolean).join(" · "));
    }
    const drawing = `${stage.fps.toFixed(0)} pictures/s`;
    setText(this.own, stage.isSolid ? drawing : `${drawing}, without WebGL`);
    setChildren(this.host, [...this.#chips.values(), this.own]);
  }
}
