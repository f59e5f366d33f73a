// Problems, the worst first; each selects its driver, bus or patch.

import { h, setChildren, setHidden, setText } from "./dom.js";

const MOST = 12;

export class Problems {
  #items = [];

  /** @param {(key: string) => void} choose called with the key of the row in the tree of what is clicked. */
  constructor(host, choose) {
    this.host = host;
    this.choose = choose;
    this.title = h("h2");
    this.list = h("ul");
    host.append(this.title, this.list);
  }

  /** @param {{severity: string, text: string, key: ?string}[]} problems */
  update(problems) {
    setHidden(this.host, !problems.length);
    setText(this.title, problems.length === 1 ? "1 problem" : `${problems.length} problems`);
    const shown = problems.slice(0, MOST);
    while (this.#items.length < shown.length) this.#items.push(this.#item());
    shown.forEach(({ severity, text, key }, i) => {
      const item = this.#items[i];
      const button = item.firstChild;
      setText(button, text);
      item.dataset.severity = severity;
      item.dataset.key = key ?? "";
      button.disabled = !key;
    });
    const more = problems.length - shown.length;
    this.more ??= h("li", { class: "hint" });
    setText(this.more, `and ${more} more`);
    setChildren(this.list, more ? [...this.#items.slice(0, MOST), this.more] : this.#items.slice(0, shown.length));
  }

  #item() {
    const item = h("li", {}, h("button", { type: "button", class: "problem" }));
    item.firstChild.addEventListener("click", () => this.choose(item.dataset.key));
    return item;
  }
}
