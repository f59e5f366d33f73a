// Puts the parts together: each turn of the server goes to the model, then to everything that shows something of it.

import * as address from "./address.js";
import { Bar } from "./bar.js";
import { Cards } from "./cards.js";
import { byId, h, setHidden, setText } from "./dom.js";
import { Modes, onPointer, useTabs } from "./controls.js";
import { measure } from "./format.js";
import { Past } from "./history.js";
import { directionOf } from "./framing.js";
import { hooks } from "./hooks.js";
import { fillHelp, onKeys } from "./keys.js";
import { Legend, unitsOf } from "./legend.js";
import { Link, PROTOCOL } from "./link.js";
import { fetchMeshes } from "./meshes.js";
import { Moving } from "./moving.js";
import { Grip, labelAt, Names } from "./names.js";
import { Overlay, ringOf } from "./overlay.js";
import { pick } from "./picking.js";
import { Plotting } from "./plotting.js";
import { savePicture, showRecording } from "./keeping.js";
import { Moments, onDrop, recordingsOf } from "./recordings.js";
import { Probes } from "./probes.js";
import { explained, Problems } from "./problems.js";
import { sheetsOf, taxelsOf, typesOf, whyEmpty } from "./selection.js";
import { Skin } from "./skin.js";
import { Stage } from "./stage.js";
import { Touches } from "./touches.js";
import { ReplayControls, Rewind } from "./transport.js";
import { Tree } from "./tree.js";
import { decode } from "./turn.js";
import { afterFrame, notify, reload, storedTheme, storeTheme } from "./window.js";
import { progressOf, Wipe } from "./wipe.js";

const MODES = { raw: "Values", change: "Change", peak: "Peaks", wipe: "Wipe test" };
const [TURN, NEARER, SCROLL_S] = [0.12, 0.85, 0.2]; // of a key: rad, of the distance, s
const FPS = 30; // turns a second, at most
const PACE_MS = 1000 / FPS - 4; // from a turn to the request for the next, so that the server need not wait itself
const FIGURES_EVERY_MS = 250; // figures that change more often cannot be read

const wanted = address.fromHash(location.hash);
const query = new URLSearchParams(location.search);
const recordings = recordingsOf(location.search);
const system = matchMedia("(prefers-color-scheme: light)");

let wasPaused = false;
const skin = new Skin();
const past = new Past();
const states = new Map();
const view = {
  mode: wanted.mode in MODES ? wanted.mode : "raw",
  type: wanted.type ?? null,
  scale: wanted.scale,
  normals: wanted.normals,
  names: wanted.names,
  theme: wanted.theme ?? storedTheme() ?? (system.matches ? "light" : "dark"),
  isThemeChosen: Boolean(wanted.theme ?? storedTheme()),
};
const now = {
  isAlive: false, // turns come
  turn: 0,
  problems: [],
  recording: null,
  outlines: [],
  figures_ms: 0, // when figures were brought up to date
};

const stage = new Stage(byId("stage"), {
  flat: query.has("flat") || wanted.flat,
  sharp: wanted.sharp,
  theme: view.theme,
  drawOver: (its) =>
    overlay.draw(its, {
      theme: view.theme,
      normals: view.normals,
      names: labels(),
      contacts: contacts(),
      hovered: probes.hovered,
      pins: probes.pins.filter(({ sheet }) => its.sheets.includes(sheet)),
    }),
  moved: () => keep(),
  resized: () => now.isAlive && frameAll(true),
  changed: () => notify(stage.isSolid ? "" : "WebGL is lost: drawn without it"),
});
const names = new Names();
const overlay = new Overlay(byId("stage"));
const link = new Link(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/live${location.search}`, {
  open: connected,
  lost: disconnected,
  turn,
});
const send = (op) => link.send(op);
const probes = new Probes(send, () => plotting.ask());
const plotting = new Plotting(byId("plots"), { send, skin, probes, stage, notify, keep: () => keep(), rewind: { get isPaused() { return rewind.isPaused; }, get at_s() { return rewind.at_s; } } });
const cards = new Cards(byId("tip"), byId("pins"), plotting, (probe) => pin(probe));
const tree = new Tree(byId("tree"), choose, (row, find) => plotting.draggable(row, () => plotting.row(find())));
const bar = new Bar(byId("bar"));
const list = new Problems(byId("problems"), (key) => choose(tree.find(key) ?? null));
const touches = new Touches(
  Object.fromEntries(["loads", "contacts", "regions"].map((id) => [id, byId(id)])),
  (row, lineOf) => plotting.plottable(row, lineOf),
  { contact: (contact) => plotting.contact(contact.of, contact), part: (part) => plotting.part(part) },
  () => names.release(),
);
const grip = new Grip(byId("grip"));
plotting.plottable(byId("grip"), () => plotting.part(grip.part));
const legend = new Legend((scale) => {
  view.scale = scale;
  look();
});
skin.shifts = wanted.shifts;
const moving = new Moving(byId("view"), stage, {
  mayMove: () => !skin.isPosed,
  moved: () => {
    stage.isTurned = true;
    stage.setSheets(stage.sheets);
    names.arrange(stage.sheets);
    keep();
  },
});
const rewind = new Rewind({ pause: byId("pause"), slider: byId("past"), when: byId("when") }, past, () => {
  if (rewind.isPaused !== wasPaused) plotting.strips.freeze((wasPaused = rewind.isPaused));
  show();
  showFigures();
});
const act = (action, value, number = null) => send({ op: "replay", action, value, number });
const replay = new ReplayControls(byId("replay"), act);
const moments = new Moments(wanted.times, act);
const modes = new Modes(byId("modes"), MODES, setMode);
const wipe = new Wipe(byId("wipe"), {
  start: () => send({ op: "wipe", action: "start" }),
  stop: () => send({ op: "wipe", action: "stop" }),
});

// -- what comes from the server ---------------------------------------------------------------------------------

/** A connection counts from its first turn; until then the picture stays old. */
function connected() {
  now.isAlive = false;
  moments.connected();
  sendLook();
}

function alive() {
  now.isAlive = true;
  setHidden(byId("lost"), true);
  skin.cut(false);
}

function disconnected(reason, wait_ms) {
  now.isAlive = false;
  const why = reason ? ` (${reason})` : "";
  const again = `Trying again in ${(wait_ms / 1000).toFixed(1)} s.`;
  setText(byId("lost"), `No connection to skin-view${why}. The picture is old. ${again}`);
  setHidden(byId("lost"), false);
  skin.cut(true);
  show();
  showFigures();
}

function turn(message) {
  const due_ms = performance.now() + PACE_MS;
  const taken = decode(message);
  const { header } = taken;
  if (!now.isAlive) alive();
  if (header.skin?.protocol && header.skin.protocol !== PROTOCOL) return reload(header.skin.protocol);
  now.turn = header.turn;
  if (header.error) notify(header.error);
  if (skin.take(header, taken.blob)) restructured();
  if (header.replays || header.outlines) takeReplays(header);
  if (header.state) takeState(header.state);
  probes.take(header);
  plotting.take(taken);
  if (!rewind.isPaused) {
    remember(header.pictures);
    if (header.pictures || header.state || header.skin) show();
    if (header.pictures) names.hold();
  }
  if (performance.now() - now.figures_ms > FIGURES_EVERY_MS) showFigures();
  else plotting.strips.draw(false);
  afterFrame(() => {
    const wait_ms = due_ms - performance.now();
    if (wait_ms > 0) setTimeout(() => link.next(), wait_ms);
    else link.next();
  });
}

function restructured() {
  past.keepOnly(skin.sheets());
  for (const id of states.keys()) if (!skin.drivers.has(id)) states.delete(id);
  if (view.type && skin.types().length && !skin.types().includes(view.type)) {
    view.type = null; // of another skin
    sendLook();
  }
  sheetsChanged();
  probes.find(skin, wanted.pins ?? probes.keys);
  plotting.ask(true);
  if (skin.drivers.size) plotting.strips.restore(wanted.plots.splice(0));
  wanted.pins = null;
  tree.update(skin, states);
  if (wanted.selected) tree.select(wanted.selected);
  wanted.selected = null;
  fillTypes();
  dim();
  fetchMeshes(skin.links, (text) => notify(text)).then((meshes) => stage.setMeshes(meshes));
}

function takeState(state) {
  for (const driver of state.drivers ?? []) states.set(driver.id, driver);
  const seen = (state.problems ?? []).map(({ severity, driver, bus, patch, text, since_ns }) => {
    const { name = driver, key = null } = skin.drivers.get(driver) ?? {};
    const named = name === null || name === undefined ? text : `${name}: ${text}`;
    const place = { driver: name, bus, patch, key: key && [key, bus, patch].filter(Boolean).join("/") };
    return { severity, text: named, since_ns: since_ns && Number(since_ns), ...place };
  });
  now.problems = explained(seen, state.findings ?? []);
  if (now.recording && !state.recording) notify(`The recording is in ${now.recording.file}`);
  now.recording = state.recording ?? null;
  plotting.takeState(state);
  tree.update(skin, states);
  list.update(now.problems, plotting.server_ns);
  showRecording(byId("record"), now.recording);
}

function takeReplays({ replays = replay.replays, outlines = now.outlines }) {
  now.outlines = outlines;
  const [wasPaused, before_ns] = [replay.isPaused, plotting.now_ns];
  replay.update(replays, outlines);
  plotting.takeReplays(replays, outlines);
  const hasMoved = plotting.isRecorded && plotting.now_ns !== before_ns;
  if (replays.length && (replay.isPaused !== wasPaused || (replay.isPaused && hasMoved))) plotting.strips.freeze(replay.isPaused);
  setHidden(byId("rewind"), replays.length > 0);
  if (moments.take(replays)) keep();
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

/** The contacts of the moment that is looked at; those of a silent driver are over. */
function contacts() {
  const shown = stage.sheets.filter(({ driver }) => !driver.isOld || rewind.isPaused);
  return shown.flatMap(({ driver, shown: { contacts = [] } }) => contacts.map((one) => ({ ...one, of: driver })));
}

/** The names in the picture, as Names.place makes them. */
function labels() {
  return view.names ? names.place(stage, contacts().map((one) => ringOf(stage, one))) : [];
}

/** Bring everything beside the picture up to date. */
function showFigures() {
  now.figures_ms = performance.now();
  const isPast = rewind.isPaused;
  plotting.strips.draw();
  cards.update(probes, isPast ? ({ sheet, i }) => ({ value: sheet.valueOf(i), status: sheet.shown.status[i] }) : null);
  bar.update(skin, states, stage);
  const row = selected();
  touches.update(names.listed, contacts(), stage.sheets.flatMap(({ shown }) => shown.regions ?? []));
  if (view.mode === "wipe") wipe.update(progressOf(stage.sheets, taxelsOf(row) ?? (() => true)), row?.name ?? "");
  legend.update(stage.sheets, row ? stage.sheets.filter(({ driver }) => driver === row.driver) : stage.sheets, view.scale);
  setHidden(byId("legend"), !stage.sheets.length);
  const why = now.isAlive ? whyEmpty(skin, row, view, stage.sheets) : null;
  setHidden(byId("empty"), !why);
  if (!why) return;
  const [text, more] = byId("empty").children;
  setText(text, why.text);
  setText(more.firstElementChild, why.advice);
  setText(more.lastElementChild, why.command);
}

function sheetsChanged() {
  stage.setSheets(sheetsOf(skin, view));
  names.arrange(stage.sheets);
  if (view.scale && unitsOf(stage.sheets).size > 1) {
    view.scale = null; // it was of another unit
    sendLook();
  }
  if (stage.isTurned || !stage.sheets.length) return;
  if (wanted.camera) {
    stage.look(...[wanted.camera.position, wanted.camera.target].map(([x, y, z]) => ({ x, y, z })));
    stage.isTurned = true;
  } else frameAll(true);
}

/** Bring all taxels, or those selected, into view. */
function frameAll(isFirst = false) {
  const isIn = selection();
  const isShown = isIn ?? (() => true);
  stage.frame(isShown, isFirst || isIn ? directionOf(stage.sheets, isShown, stage.picture) : null, !isIn);
}

/** The row that is selected; null without one. */
const selected = () => (tree.selected && tree.find(tree.selected)) || null;

/** Whether a taxel is selected: (sheet, i) => bool; null if nothing is. */
const selection = () => taxelsOf(selected());

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
  if (row && view.type && !typesOf(skin, row).includes(view.type)) setType(null); // its own
  fillTypes();
  dim();
  if (row) frameAll();
  keep();
}

// -- what a person does -------------------------------------------------------------------------------------------

function sendLook() {
  send({ op: "look", mode: view.mode, type: view.type, scale: view.scale, fps: FPS });
}

/** Look otherwise: at another mode, type or scale. */
function look() {
  sendLook();
  modes.show(view.mode);
  wipe.show(view.mode === "wipe");
  setHidden(byId("tare"), view.mode === "raw" || view.mode === "wipe");
  setHidden(byId("scaling"), view.mode === "wipe");
  keep();
}

function setMode(mode) {
  if (rewind.isPaused) rewind.toggle();
  view.mode = mode;
  look();
  sheetsChanged();
  dim();
  if (mode === "wipe") for (const { driver, type } of stage.sheets) send({ op: "names", driver: driver.id, type });
}

function setType(type) {
  view.type = type || null;
  view.scale = null;
  sheetsChanged();
  probes.hover(null);
  dim();
  look();
}

function nextType() {
  const { options, selectedIndex } = byId("types").querySelector("select");
  if (options.length > 1 || selectedIndex < 0) setType(options[(selectedIndex + 1) % options.length].value);
  fillTypes();
}

/** The types of what is selected; of several drivers without a common first type, also each driver's own. */
function fillTypes() {
  const row = selected();
  const types = typesOf(skin, row);
  const select = byId("types").querySelector("select");
  const firsts = skin.shown(null).filter(({ driver }) => !row || driver === row.driver).map(({ type }) => type);
  const areDifferent = new Set(firsts).size > 1;
  const own = areDifferent ? [h("option", { value: "" }, "each its own")] : [];
  select.replaceChildren(...own, ...types.map((type) => h("option", { value: type }, type)));
  select.value = view.type ?? (areDifferent ? "" : firsts[0] ?? "");
  setHidden(byId("types"), types.length < 2 && types.includes(select.value));
}

function setTheme(theme, isChosen) {
  view.theme = theme;
  view.isThemeChosen ||= isChosen;
  document.documentElement.dataset.theme = theme;
  setText(byId("theme"), theme === "dark" ? "Light" : "Dark");
  stage.setTheme(theme);
  legend.setTheme(theme);
  plotting.strips.theme = theme;
  if (isChosen) storeTheme(theme);
  showFigures();
}

function pin(found) {
  probes.toggle(found);
  showFigures();
  stage.ask();
  keep();
}

function hover(found) {
  if (!probes.hover(found)) return;
  stage.ask();
  showFigures();
}

/** Point at the taxel after the one that is pointed at, among those selected; for those without a mouse. */
function step(by) {
  const isIn = selection() ?? (() => true);
  const all = stage.sheets
    .flatMap((sheet) => Array.from({ length: sheet.n }, (_, i) => ({ sheet, i })))
    .filter(({ sheet, i }) => isIn(sheet, i));
  if (!all.length) return;
  const at = all.findIndex(({ sheet, i }) => sheet === probes.hovered?.sheet && i === probes.hovered?.i);
  const found = all[at < 0 ? 0 : (at + by + all.length) % all.length];
  hover(found);
  const { name } = probes.hovered;
  setText(byId("spoken"), `${name}: ${measure(found.sheet.valueOf(found.i), found.sheet.unit)}`);
  const [x, y] = stage.project(...found.sheet.place(found.i));
  cards.place(x, y);
}

function release() {
  probes.clear();
  probes.hover(null);
  choose(null);
  showFigures();
}

/** Go around; with shift, move the selected driver. */
function go({ shiftKey }, right, up) {
  const row = selected();
  if (shiftKey && row) moving.step(row.driver, right, up);
  else stage.orbit(TURN * right, -TURN * up);
}

function flip(part) {
  view[part] = !view[part];
  stage.ask();
  keep();
}

/** Plot what is pointed at, or what is selected. */
function plot() {
  const row = selected();
  const line = probes.hovered ? plotting.taxel(probes.hovered) : row && plotting.row(row);
  if (line) plotting.strips.add(line);
  else notify("Point at a taxel, or select a driver or board, to plot it.");
}

function picture(kind) {
  const drivers = stage.sheets.map(({ driver }) => driver.key);
  savePicture(kind, stage, overlay, view.theme, `${MODES[view.mode]}. ${plotting.footer(drivers)}`);
}

let keepTimer = 0;

/** Keep the view in the address, once it stays as it is. */
function keep() {
  clearTimeout(keepTimer);
  keepTimer = setTimeout(() => {
    if (!stage.sheets.length) return;
    const hash = address.toHash({
      flat: wanted.flat,
      sharp: wanted.sharp,
      ...view,
      camera: { position: stage.camera.position.toArray(), target: stage.controls.target.toArray() },
      selected: tree.selected,
      pins: probes.keys,
      plots: plotting.strips.kept,
      times: recordings.length ? moments.times_s : null,
      shifts: Object.fromEntries([...skin.drivers.values()].filter(({ shift }) => shift.some(Boolean)).map(({ key, shift }) => [key, shift])),
      theme: view.isThemeChosen ? view.theme : null,
    });
    history.replaceState(null, "", location.pathname + location.search + hash);
  }, 250);
}

// -- mouse, keys, buttons -----------------------------------------------------------------------------------------

onPointer(byId("stage"), {
  over: (x, y) => {
    if (x !== null) grip.show(labelAt(labels(), x, y));
    hover(x === null ? null : pick(stage, stage.sheets, x, y));
    cards.place(x, y);
  },
  click: (x, y) => {
    const label = labelAt(labels(), x, y);
    if (label) return plotting.strips.add(plotting.part(label.part));
    const found = pick(stage, stage.sheets, x, y);
    if (found) pin(found);
  },
});
const clicks = {
  tare: () => {
    send({ op: "tare" });
    names.release();
  },
  record: () => send({ op: "record", action: now.recording ? "stop" : "start" }),
  picture: () => picture("png"),
  theme: () => setTheme(view.theme === "dark" ? "light" : "dark", true),
  help: () => {
    fillHelp(byId("keys"), view.theme);
    byId("keys").showModal();
  },
};
for (const [id, action] of Object.entries(clicks)) byId(id).addEventListener("click", action);
byId("types").addEventListener("change", (event) => setType(event.target.value));
system.addEventListener("change", () => view.isThemeChosen || setTheme(system.matches ? "light" : "dark", false));
useTabs(byId("tabs"));
onDrop(notify);
if (recordings.length) {
  document.title = `${recordings.join(", ")} – skin-view`;
  for (const id of ["record", "rewind"]) setHidden(byId(id), true);
}
onKeys({
  ...Object.fromEntries(Object.keys(MODES).map((mode, i) => [String(i + 1), () => setMode(mode)])),
  t: nextType,
  b: clicks.tare,
  w: () => (view.mode === "wipe" ? wipe.toggle() : setMode("wipe")),
  l: () => view.mode === "wipe" && wipe.save(),
  " ": () => (replay.replays.length ? replay : rewind).toggle(),
  ",": () => replay.step(-1),
  ".": () => replay.step(1),
  "[": () => (replay.replays.length ? replay.scroll(-SCROLL_S) : rewind.scroll(rewind.at_s - SCROLL_S)),
  "]": () => (replay.replays.length ? replay.scroll(SCROLL_S) : rewind.isPaused && rewind.scroll(rewind.at_s + SCROLL_S)),
  r: clicks.record,
  s: clicks.picture,
  S: () => picture("svg"),
  g: plot,
  m: () => plotting.mark(),
  f: () => frameAll(),
  ArrowLeft: (event) => go(event, -1, 0),
  ArrowRight: (event) => go(event, 1, 0),
  ArrowUp: (event) => go(event, 0, 1),
  ArrowDown: (event) => go(event, 0, -1),
  "+": () => stage.orbit(0, 0, NEARER),
  "-": () => stage.orbit(0, 0, 1 / NEARER),
  j: () => step(1),
  k: () => step(-1),
  p: () => probes.hovered && pin(probes.hovered),
  n: () => flip("normals"),
  h: () => flip("names"),
  a: () => {
    view.scale = null;
    look();
  },
  d: clicks.theme,
  Escape: release,
  "?": clicks.help,
});

window.skin = hooks({ skin, stage, tree, probes, labels, rewind, replay, past, view, now, wipe, contacts, plotting });
setTheme(view.theme, false);
look();
addEventListener("hashchange", () => location.reload()); // another address was typed
link.connect();
