// Puts the parts together: each turn of the server goes to the model, then to everything that shows something of it.

import * as address from "./address.js";
import { Bar } from "./bar.js";
import { Cards } from "./cards.js";
import { byId, h, save, setHidden, setPressed, setText, stamp } from "./dom.js";
import { bytes, clock, measure } from "./format.js";
import { Past } from "./history.js";
import { fillHelp, listen } from "./keys.js";
import { Legend } from "./legend.js";
import { Link, PROTOCOL } from "./link.js";
import { MARKS, DIMMED } from "./marks.js";
import { fetchMeshes } from "./meshes.js";
import { Overlay } from "./overlay.js";
import { GROUND, ramp } from "./palette.js";
import { pick } from "./picking.js";
import { Probes } from "./probes.js";
import { Problems } from "./problems.js";
import { boxOf, Skin } from "./skin.js";
import { Stage } from "./stage.js";
import { Touches } from "./touches.js";
import { ReplayControls, Rewind } from "./transport.js";
import { Tree } from "./tree.js";
import { decode } from "./turn.js";
import { untouched, Wipe } from "./wipe.js";

const MODES = { raw: "Values", change: "Change", peak: "Peaks", wipe: "Wipe test" };
const FROM = [0, -0.86, 0.51]; // where a skin is looked at from, if its normals do not say
const TURN = 0.12; // rad, of a key
const CLICK_PX = 4; // a mouse that moved less has clicked
const HIDDEN_MS = 1000; // between turns of a page that nobody sees
const NOTICE_MS = 6000;
const TELL_EVERY_MS = 90; // figures that change more often cannot be read

const wanted = address.fromHash(location.hash);
const query = new URLSearchParams(location.search);
const system = matchMedia("(prefers-color-scheme: light)");

const skin = new Skin();
const past = new Past();
const states = new Map();
const view = {
  mode: wanted.mode in MODES ? wanted.mode : "raw",
  type: wanted.type ?? null,
  scale: wanted.scale,
  normals: wanted.normals,
  theme: wanted.theme ?? stored() ?? (system.matches ? "light" : "dark"),
  isThemeChosen: Boolean(wanted.theme ?? stored()),
};
let isAlive = false; // turns come
let contacts = [];
let problems = [];
let recording = null;
let wipeTold = null;
let turnNumber = 0;
let told_ms = 0; // when figures were brought up to date

const stage = new Stage(byId("stage"), {
  flat: query.has("flat") || wanted.flat,
  sharp: wanted.sharp,
  theme: view.theme,
  drawOver: (its) =>
    overlay.draw(its, { theme: view.theme, normals: view.normals, contacts, hovered: probes.hovered, pins: probes.pins }),
  moved: () => keep(),
  changed: () => notify(stage.isSolid ? "" : "WebGL is lost: drawn without it", NOTICE_MS),
});
const overlay = new Overlay(byId("stage"));
const link = new Link(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/live${location.search}`, {
  open: connected,
  lost: disconnected,
  error: (text) => notify(text, NOTICE_MS),
  turn,
});
const send = (op) => link.send(op);
const probes = new Probes(send);
const cards = new Cards(byId("tip"), byId("pins"), (probe) => pin(probe));
const tree = new Tree(byId("tree"), choose);
const bar = new Bar(byId("bar"));
const list = new Problems(byId("problems"));
const touches = new Touches(byId("contacts"), byId("regions"));
const legend = new Legend((scale) => {
  view.scale = scale;
  look();
});
const rewind = new Rewind({ pause: byId("pause"), slider: byId("past"), when: byId("when") }, past, () => {
  show();
  tell();
});
const replay = new ReplayControls(byId("replay"), (action, value) => send({ op: "replay", action, value }));
const wipe = new Wipe(byId("wipe"), {
  start: () => send({ op: "wipe", action: "start" }),
  stop: () => send({ op: "wipe", action: "stop" }),
  sheets: () => stage.sheets,
});

// -- what comes from the server ---------------------------------------------------------------------------------

/** What a connection is worth shows at its first turn; until then what is shown stays old. */
function connected() {
  isAlive = false;
  sendLook();
}

function alive() {
  isAlive = true;
  setHidden(byId("lost"), true);
  skin.cut(false);
}

function disconnected(reason, wait_ms) {
  isAlive = false;
  const why = reason ? ` (${reason})` : "";
  setText(byId("lost"), `No connection to skin-view${why}. What is shown is old. Trying again in ${(wait_ms / 1000).toFixed(1)} s.`);
  setHidden(byId("lost"), false);
  skin.cut(true);
  show();
  tell();
}

function turn(message) {
  const told = decode(message);
  const { header } = told;
  if (!isAlive) alive();
  if (header.skin?.protocol && header.skin.protocol !== PROTOCOL) return reload();
  turnNumber = header.turn;
  if (header.error) notify(header.error, NOTICE_MS);
  if (skin.take(header, told.blob)) restructured();
  if (header.names) skin.sheet(header.names.driver, header.names.type).names = header.names.of;
  if (header.state) takeState(header.state);
  if (header.wipe) wipeTold = header.wipe;
  contacts = touches.update(skin, { contacts: lastOf("contacts", header), regions: lastOf("regions", header) });
  probes.take(told, performance.now());
  wipe.update(header.wipe);
  if (!rewind.isPaused) {
    remember(header.pictures);
    if (header.pictures || header.state || header.skin) show();
  }
  if (performance.now() - told_ms > TELL_EVERY_MS) tell();
  afterFrame(() => link.next());
}

const newest = {};

/** What a turn tells of something, or the one before it. */
function lastOf(name, header) {
  if (name in header) newest[name] = header[name];
  return newest[name];
}

function restructured() {
  past.keepOnly(skin.sheets());
  for (const id of states.keys()) if (!skin.drivers.has(id)) states.delete(id);
  for (const name of Object.keys(newest)) delete newest[name];
  fillTypes();
  sheetsChanged();
  probes.find(skin, turnNumber === 1 && !probes.keys.length ? wanted.pins : undefined);
  tree.update(skin, states);
  if (tree.selected === null && wanted.selected) tree.select(wanted.selected);
  wanted.selected = null;
  dim();
  fetchMeshes(skin.links, (text) => notify(text, NOTICE_MS)).then((meshes) => stage.setMeshes(meshes));
}

function takeState(state) {
  for (const told of state.drivers ?? []) states.set(told.id, told);
  const nameOf = (id) => skin.drivers.get(id)?.name;
  problems = (state.problems ?? []).map((problem) => {
    const name = nameOf(problem.driver) ?? problem.driver;
    return { ...problem, text: name === null || name === undefined ? problem.text : `${name}: ${problem.text}` };
  });
  recording = state.recording ?? null;
  tree.update(skin, states);
  list.update(problems);
  replay.update(state.replay);
  setPressed(byId("record"), Boolean(recording));
  const lost = recording?.lost ? `, ${recording.lost} lost` : "";
  setText(byId("record").lastElementChild, recording ? `${clock(recording.s)} · ${bytes(recording.bytes)}${lost}` : "Record");
  byId("record").title = recording?.file ?? "Record (r)";
}

function remember(pictures) {
  const now = performance.now();
  for (const { driver, type } of pictures ?? []) {
    const sheet = skin.sheet(driver, type);
    if (sheet) past.push(sheet, now);
  }
}

// -- what is shown ------------------------------------------------------------------------------------------------

/** Show the moment that is looked at. */
function show() {
  const at_ms = rewind.at_ms;
  for (const sheet of stage.sheets) sheet.show((at_ms === null ? null : past.at(sheet, at_ms)) ?? sheet);
  stage.update();
}

/** Bring everything beside the picture up to date. */
function tell() {
  told_ms = performance.now();
  const isPast = rewind.isPaused;
  cards.update(probes, isPast ? ({ sheet, i }) => ({ value: sheet.valueOf(i), status: sheet.shown.status[i] }) : null);
  bar.update(skin, states, stage, recording);
  const first = stage.sheets[0];
  const scale = first ? { low: first.shown.scale[0], high: first.shown.scale[1], unit: first.unit } : skin.scale;
  legend.update(scale, view.scale, stage.sheets);
  setHidden(byId("view").querySelector(".legend"), !stage.sheets.length);
}

function sheetsChanged() {
  stage.setSheets(skin.shown(view.type));
  if (stage.isTurned || !stage.sheets.length) return;
  if (wanted.camera) {
    stage.look(...[wanted.camera.position, wanted.camera.target].map(([x, y, z]) => ({ x, y, z })));
    stage.isTurned = true;
  } else frameAll(true);
}

/** Bring all taxels, or those selected, into view. */
function frameAll(isFirst = false) {
  const isIn = selection();
  const box = boxOf(stage.sheets, isIn ?? undefined);
  if (box) stage.frame(grown(box), isFirst || isIn ? direction(isIn ?? undefined) : null);
}

/** From where most of some taxels are seen: against the mean of their normals. */
function direction(isIn = () => true) {
  const sum = [0, 0, 0];
  let n = 0;
  const placed = stage.sheets.filter((sheet) => sheet.placed);
  for (const sheet of placed.length ? placed : stage.sheets) {
    for (let i = 0; i < sheet.n; i++) {
      if (!isIn(sheet, i)) continue;
      for (let c = 0; c < 3; c++) sum[c] += sheet.normal[3 * i + c];
      n++;
    }
  }
  const mean = sum.map((x) => x / Math.max(n, 1));
  if (Math.hypot(...mean) < 0.25) return FROM;
  return Math.abs(mean[2]) > 0.999 * Math.hypot(...mean) ? [0, -1e-3, Math.sign(mean[2])] : mean;
}

function grown(box) {
  const by = 1.2 * Math.max(...stage.sheets.map(({ radius }) => radius[0] ?? 0));
  return box.map((x, c) => (c < 3 ? x - by : x + by));
}

/** Whether a taxel is selected: (sheet, i) => bool; null if nothing is. */
function selection() {
  const row = tree.selected && tree.find(tree.selected);
  if (!row) return null;
  const buses = row.driver.patches.map(({ bus }) => bus);
  return (sheet, i) =>
    sheet.driver === row.driver &&
    (row.level < 2 || (row.level === 2 ? buses[sheet.patch[i]] === row.bus : sheet.patch[i] === row.patch));
}

/** Taxels beside those that are selected step back. */
function dim() {
  const isIn = selection();
  for (const sheet of skin.sheets()) {
    sheet.dimmed = isIn && Uint8Array.from({ length: sheet.n }, (_, i) => Number(!isIn(sheet, i)));
  }
  show();
}

function choose(row) {
  tree.select(row?.key ?? null);
  dim();
  if (row) frameAll();
  keep();
}

// -- what a person does -------------------------------------------------------------------------------------------

function sendLook() {
  send({ op: "look", mode: view.mode, type: view.type, scale: view.scale, fps: 30 });
}

/** Look otherwise: at another mode, type or scale. */
function look() {
  sendLook();
  for (const button of byId("modes").children) {
    button.setAttribute("aria-checked", String(button.dataset.mode === view.mode));
    button.tabIndex = button.dataset.mode === view.mode ? 0 : -1;
  }
  wipe.show(view.mode === "wipe");
  if (view.mode !== "wipe") wipeTold = null;
  setHidden(byId("tare"), view.mode === "raw" || view.mode === "wipe");
  setHidden(byId("scale"), view.mode === "wipe");
  keep();
}

function setMode(mode) {
  if (rewind.isPaused) rewind.toggle();
  view.mode = mode;
  look();
  if (mode === "wipe") for (const { driver, type } of stage.sheets) send({ op: "names", driver: driver.id, type });
}

function setType(type) {
  view.type = type;
  view.scale = null;
  sheetsChanged();
  probes.hover(null);
  dim();
  look();
}

function fillTypes() {
  const types = skin.types();
  const select = byId("types").querySelector("select");
  select.replaceChildren(...types.map((type) => h("option", { value: type }, type)));
  select.value = view.type ?? skin.shown(null)[0]?.type ?? "";
  setHidden(byId("types"), types.length < 2);
}

function setTheme(theme, isChosen) {
  view.theme = theme;
  view.isThemeChosen ||= isChosen;
  document.documentElement.dataset.theme = theme;
  setText(byId("theme"), theme === "dark" ? "Light" : "Dark");
  stage.setTheme(theme);
  legend.setTheme(theme);
  if (isChosen) store(theme);
  tell();
}

function pin(found) {
  probes.toggle(found);
  tell();
  stage.ask();
  keep();
}

function hover(found) {
  if (!probes.hover(found)) return;
  stage.ask();
  tell();
}

/** Point at the taxel after the one that is pointed at, among those selected; for those without a mouse. */
function step(by) {
  const isIn = selection() ?? (() => true);
  const all = stage.sheets.flatMap((sheet) => Array.from({ length: sheet.n }, (_, i) => ({ sheet, i })).filter(({ i }) => isIn(sheet, i)));
  if (!all.length) return;
  const at = all.findIndex(({ sheet, i }) => sheet === probes.hovered?.sheet && i === probes.hovered?.i);
  const found = all[at < 0 ? 0 : (at + by + all.length) % all.length];
  hover(found);
  const { name } = probes.hovered;
  setText(byId("spoken"), `${name}: ${measure(found.sheet.valueOf(found.i), found.sheet.unit)}`);
  const [x, y] = stage.project(...found.sheet.place(found.i));
  cards.place(x, y, stage.width, stage.height);
}

function takePicture() {
  stage.draw(); // the browser keeps no picture by WebGL after it was shown
  const both = h("canvas", { width: stage.view.canvas.width, height: stage.view.canvas.height });
  const context = both.getContext("2d");
  for (const canvas of [stage.view.canvas, overlay.canvas]) context.drawImage(canvas, 0, 0, both.width, both.height);
  both.toBlob((blob) => save(blob, `skin-${stamp()}.png`));
}

function release() {
  probes.clear();
  probes.hover(null);
  choose(null);
  tell();
}

let noticeTimer = 0;

function notify(text, for_ms) {
  setText(byId("notice"), text);
  setHidden(byId("notice"), !text);
  clearTimeout(noticeTimer);
  noticeTimer = setTimeout(() => setHidden(byId("notice"), true), for_ms);
}

let keepTimer = 0;

/** Keep the view in the address, once it stays as it is. */
function keep() {
  clearTimeout(keepTimer);
  keepTimer = setTimeout(() => {
    if (!stage.sheets.length) return;
    const hash = address.toHash({
      ...view,
      camera: { position: stage.camera.position.toArray(), target: stage.controls.target.toArray() },
      selected: tree.selected,
      pins: probes.keys,
      theme: view.isThemeChosen ? view.theme : null,
    });
    history.replaceState(null, "", location.pathname + location.search + hash);
  }, 250);
}

/** A page of another version than the server is loaded anew, but not for ever. */
function reload() {
  if (sessionStorage.getItem("reloaded") === PROTOCOL) return notify("This page and skin-view are of different versions.", 1e9);
  sessionStorage.setItem("reloaded", PROTOCOL);
  location.reload();
}

/** Go on when the next frame is drawn; of a page that nobody sees, none is. */
function afterFrame(go) {
  let isDone = false;
  const once = () => {
    if (!isDone) go();
    isDone = true;
  };
  requestAnimationFrame(once);
  setTimeout(once, HIDDEN_MS);
}

/** The theme that was chosen in this browser before; some let no page keep anything. */
function stored() {
  try {
    return localStorage.getItem("theme") ?? undefined;
  } catch {
    return undefined;
  }
}

function store(theme) {
  try {
    localStorage.setItem("theme", theme);
  } catch {
    // it is chosen for this page alone
  }
}

// -- mouse, keys, buttons -----------------------------------------------------------------------------------------

const host = byId("stage");
let pressed = null;
host.addEventListener("pointermove", (event) => {
  const pointer = [event.offsetX, event.offsetY];
  if (event.pointerType === "touch" || event.buttons) return;
  hover(pick(stage, stage.sheets, ...pointer));
  cards.place(...pointer, stage.width, stage.height);
});
host.addEventListener("pointerleave", () => hover(null));
host.addEventListener("pointerdown", (event) => (pressed = [event.clientX, event.clientY]));
host.addEventListener("pointerup", (event) => {
  if (!pressed || event.button !== 0) return;
  if (Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]) > CLICK_PX) return;
  const box = host.getBoundingClientRect();
  const found = pick(stage, stage.sheets, event.clientX - box.left, event.clientY - box.top);
  if (found) pin(found);
});

byId("modes").append(
  ...Object.entries(MODES).map(([mode, name]) =>
    h("button", { type: "button", role: "radio", "data-role": "mode", "data-mode": mode, onclick: () => setMode(mode) }, name),
  ),
);
byId("modes").addEventListener("keydown", (event) => {
  const by = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
  if (!by) return;
  const names = Object.keys(MODES);
  setMode(names[(names.indexOf(view.mode) + by + names.length) % names.length]);
  byId("modes").querySelector("[aria-checked=true]").focus();
  event.preventDefault();
});
byId("types").addEventListener("change", (event) => setType(event.target.value));
const clicks = {
  tare: () => send({ op: "tare" }),
  record: () => send({ op: "record", action: recording ? "stop" : "start" }),
  picture: takePicture,
  theme: () => setTheme(view.theme === "dark" ? "light" : "dark", true),
  help: () => {
    fillHelp(byId("keys"), view.theme);
    byId("keys").showModal();
  },
};
for (const [id, action] of Object.entries(clicks)) byId(id).addEventListener("click", action);
for (const tab of byId("tabs").children) {
  tab.addEventListener("click", () => {
    for (const other of byId("tabs").children) setPressed(other, other === tab);
    document.body.dataset.panel = tab.dataset.panel;
  });
}
system.addEventListener("change", () => view.isThemeChosen || setTheme(system.matches ? "light" : "dark", false));

const nextType = () => {
  const types = skin.types();
  const now = types.indexOf(view.type ?? stage.sheets[0]?.type);
  if (types.length > 1) setType(types[(now + 1) % types.length]);
  fillTypes();
};
const modeKeys = Object.keys(MODES).map((mode, i) => [String(i + 1), () => setMode(mode)]);
listen({
  ...Object.fromEntries(modeKeys),
  t: nextType,
  b: clicks.tare,
  w: () => (view.mode === "wipe" ? wipe.toggle() : setMode("wipe")),
  l: () => view.mode === "wipe" && wipe.save(),
  " ": () => rewind.toggle(),
  "[": () => rewind.scroll(rewind.at_s - 0.2),
  "]": () => rewind.isPaused && rewind.scroll(rewind.at_s + 0.2),
  r: clicks.record,
  s: takePicture,
  f: () => frameAll(),
  ArrowLeft: () => stage.orbit(-TURN, 0),
  ArrowRight: () => stage.orbit(TURN, 0),
  ArrowUp: () => stage.orbit(0, -TURN),
  ArrowDown: () => stage.orbit(0, TURN),
  "+": () => stage.orbit(0, 0, 0.85),
  "-": () => stage.orbit(0, 0, 1 / 0.85),
  j: () => step(1),
  k: () => step(-1),
  p: () => probes.hovered && pin(probes.hovered),
  n: () => {
    view.normals = !view.normals;
    stage.ask();
    keep();
  },
  a: () => {
    view.scale = null;
    look();
  },
  d: clicks.theme,
  Escape: release,
  "?": clicks.help,
});

// -- what tests and scripts read ------------------------------------------------------------------------------------

const pairOf = ({ sheet, i }) => [sheet.driver.id, sheet.index[i]];
window.skin = {
  get turn() { return turnNumber; },
  get connected() { return isAlive; },
  get drivers() { return [...skin.drivers.values()].map(({ id, name, state, generation }) => ({ id, name, state, generation })); },
  get camera() { return { position: stage.camera.position.toArray(), target: stage.controls.target.toArray() }; },
  get selected() { return tree.selected; },
  get hovered() { return probes.hovered && pairOf(probes.hovered); },
  get pins() { return probes.pins.map(pairOf); },
  get mode() { return view.mode; },
  get type() { return view.type ?? stage.sheets[0]?.type ?? null; },
  get scale() { return skin.scale; },
  get theme() { return view.theme; },
  get flat() { return !stage.isSolid; },
  get fps() { return stage.fps; },
  get drawn() { return stage.drawn; },
  get ratio() { return stage.ratio; },
  get paused() { return rewind.isPaused; },
  get at_s() { return rewind.at_s; },
  get problems() { return problems.map(({ text }) => text); },
  get wipe() { return wipeTold; },
  get untouched() { return untouched(stage.sheets).map(pairOf); },
  get recording() { return recording; },
  get contacts() { return contacts; },
  get meshes() { return stage.meshes.length; },
  get kept_bytes() { return past.bytes; },
  /** The colour of a level, [r, g, b]. */
  colourOf: (level) => [...ramp(view.theme).slice(4 * level, 4 * level + 3)],
  ground: () => GROUND[view.theme],
  /** Where a taxel is in the window, CSS pixels; null if it is not drawn. */
  pixelOf(driver, position) {
    const found = skin.find(driver, position);
    if (!found || !stage.sheets.includes(found.sheet)) return null;
    const box = host.getBoundingClientRect();
    const [x, y] = stage.project(...found.sheet.place(found.i));
    return [box.left + x, box.top + y];
  },
  /** What is shown of a taxel; null if there is none. */
  stateOf(driver, position) {
    const found = skin.find(driver, position);
    if (!found) return null;
    const { sheet, i } = found;
    const { levels, status, marks } = sheet.shown;
    const mark = MARKS[marks[i] & ~DIMMED].name;
    return { level: levels[i], status: status[i], mark, dimmed: Boolean(marks[i] & DIMMED), value: sheet.valueOf(i), name: sheet.names?.[i] ?? null };
  },
};

setTheme(view.theme, false);
look();
setPressed(byId("pause"), false);
document.body.dataset.panel = "left";
link.connect();
