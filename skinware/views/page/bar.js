// The line of figures: of each driver its rate, age, losses and load; how fast this page draws.

import { h, setChildren, setText } from "./dom.js";
import { count, percent } from "./format.js";
import { figuresOf, OLD } from "./tree.js";

export class Bar {
  #chips = new Map();

  constructor(host) {
    this.host = host;
    this.own = h("span", { class: "figure own", title: "Pictures that this page draws" });
  }

  update(skin, states, stage) {
    for (const id of this.#chips.keys()) if (!skin.drivers.has(id)) this.#chips.delete(id);
    for (const [id, driver] of skin.drivers) {
      if (!this.#chips.has(id)) this.#chips.set(id, h("span", { class: "figure" }, h("b"), h("span")));
      const figures = states.get(id) ?? {};
      const chip = this.#chips.get(id);
      const bad = driver.isCut ? OLD : (figures.bad ?? 0);
      chip.dataset.bad = bad;
      chip.dataset.driver = driver.key;
      setText(chip.firstChild, driver.name);
      const state = driver.isCut ? "no connection" : bad ? figures.shown : null;
      const fresh = figures.fresh === undefined ? null : `${count(figures.fresh)}/${count(figures.sensors)} fresh`;
      const parts = [state, ...figuresOf({ report: figures }), fresh, `dropped ${count(figures.dropped)}`];
      if (figures.load !== undefined && figures.load !== null) parts.push(`load ${percent(figures.load)}`);
      setText(chip.lastChild, parts.filter(Boolean).map((part) => part.replaceAll(" ", "\u00a0")).join(" · "));
    }
    const drawing = `${stage.fps.toFixed(0)} pictures/s`;
    setText(this.own, stage.isSolid ? drawing : `${drawing}, without WebGL`);
    setChildren(this.host, [...this.#chips.values(), this.own]);
  }
}
