// Problems, the worst first: what, since when, the evidence, and the command that helps; each selects its place.

import { h, setChildren, setHidden, setText } from "./dom.js";
import { age } from "./format.js";

const MOST = 12;
const COPIED_MS = 1500;
const SEVERITIES = ["error", "warning", "note"];

const rank = ({ severity }) => SEVERITIES.indexOf(severity);

/**
 * The problems that are seen and those that skin-doctor finds, together.
 * @param {object[]} seen `severity`, `text`, `key` (of a row; null: none), `driver`, `bus`, `patch` (names or null), `since_ns`.
 * @param {object[]} findings as of `skin-doctor --json`; each explains the problems of its place, or stands alone.
 * @returns {object[]} the worst first, each with its `findings`.
 */
export function explained(seen, findings) {
  const own = seen.map((problem) => ({ ...problem, findings: findings.filter((finding) => isAbout(finding, problem)) }));
  const known = new Set(own.flatMap((problem) => problem.findings));
  const others = findings.filter((finding) => !known.has(finding) && finding.severity !== "note");
  const alone = others.map((finding) => ({ severity: finding.severity, text: `${finding.where}: ${finding.what}`, key: null, findings: [finding] }));
  return [...own, ...alone].sort((one, other) => rank(one) - rank(other)); // stable
}

/** Whether a finding, of "driver torso, bus can0, board 9", explains a problem of this driver, bus or patch. */
function isAbout(finding, { driver, bus, patch, severity }) {
  const parts = finding.where.split(", ");
  if (rank(finding) > rank({ severity })) return false; // a lesser matter
  if (!parts.includes(`driver ${driver}`)) return false;
  return patch ? parts.includes(patch) : !bus || parts.includes(`bus ${bus.split("?")[0]}`);
}

class Item {
  constructor(choose) {
    this.what = h("button", { type: "button", class: "problem" });
    this.what.addEventListener("click", () => choose(this.key));
    this.since = h("small", { "aria-live": "off" }); // it changes all the time
    this.advice = h("div", { class: "advice" });
    this.more = h("details", {}, h("summary", {}, "What to do"), this.advice);
    this.element = h("li", {}, h("div", {}, this.what, " ", this.since, this.more));
  }

  update({ severity, text, key, since_ns, findings }, now_ns) {
    this.key = key;
    this.element.dataset.severity = severity;
    this.what.disabled = !key;
    setText(this.what, text);
    const since_ms = (now_ns - since_ns) / 1e6;
    setText(this.since, since_ns ? (since_ms < 1000 ? "just now" : `for ${age(since_ms)}`) : "");
    setHidden(this.more, !findings.length);
    const told = JSON.stringify(findings);
    if (told === this.told) return;
    this.told = told;
    this.advice.replaceChildren(...findings.flatMap(adviceOf));
  }
}

function adviceOf({ what, evidence, action, commands }) {
  return [h("p", {}, h("b", {}, what), `: ${evidence}`), h("p", {}, action), ...commands.map(commandOf)];
}

/** A command, with a button that copies it. */
function commandOf(command) {
  const copy = h("button", { type: "button", "aria-label": `Copy ${command}` }, "Copy");
  copy.addEventListener("click", async () => {
    setText(copy, (await copied(command)) ? "Copied" : "Select it");
    setTimeout(() => setText(copy, "Copy"), COPIED_MS);
  });
  return h("p", { class: "command" }, h("code", {}, command), copy);
}

/** Put a text on the clipboard; pages from other machines without TLS have none. */
async function copied(text) {
  try {
    await navigator.clipboard.writeText(text);
    return true;
  } catch {
    return false;
  }
}

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

  /** @param {object[]} problems as of `explained`; @param {number} now_ns of the server. */
  update(problems, now_ns) {
    setHidden(this.host, !problems.length);
    setText(this.title, problems.length === 1 ? "1 problem" : `${problems.length} problems`);
    const shown = problems.slice(0, MOST);
    while (this.#items.length < shown.length) this.#items.push(new Item(this.choose));
    shown.forEach((problem, i) => this.#items[i].update(problem, now_ns));
    const more = problems.length - shown.length;
    this.more ??= h("li", { class: "hint" });
    setText(this.more, `and ${more} more`);
    const elements = this.#items.slice(0, shown.length).map(({ element }) => element);
    setChildren(this.list, more ? [...elements, this.more] : elements);
  }
}
