// What is wrong, worst first.

import { h, setChildren, setHidden, setText } from "./dom.js";

const MOST = 12;

export class Problems {
  #items = [];

  constructor(host) {
    this.host = host;
    this.title = h("h2");
    this.list = h("ul");
    host.append(this.title, this.list);
  }

  /** @param {{severity: string, driver: string, text: string}[]} problems */
  update(problems) {
    setHidden(this.host, !problems.length);
    setText(this.title, problems.length === 1 ? "1 problem" : `${problems.length} problems`);
    const shown = problems.slice(0, MOST);
    while (this.#items.length < shown.length) this.#items.push(h("li"));
    shown.forEach((problem, i) => {
      setText(this.#items[i], problem.text);
      this.#items[i].dataset.severity = problem.severity;
    });
    const more = problems.length - shown.length;
    this.more ??= h("li", { class: "hint" });
    setText(this.more, `and ${more} more`);
    setChildren(this.list, more ? [...this.#items.slice(0, MOST), this.more] : this.#items.slice(0, shown.length));
  }
}
