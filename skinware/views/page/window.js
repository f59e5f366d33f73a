// The browser's window: notices, the chosen theme, files, reloading.

import { byId, setHidden, setText } from "./dom.js";

const NOTICE_MS = 6000;
const UNSEEN_MS = 1000; // between turns of a hidden page

let noticeTimer = 0;

/** Say something for a while. */
export function notify(text) {
  setText(byId("notice"), text);
  setHidden(byId("notice"), !text);
  clearTimeout(noticeTimer);
  noticeTimer = setTimeout(() => setHidden(byId("notice"), true), NOTICE_MS);
}

/** Load the page again, because it has another version than the server; but only once. */
export function reload(version) {
  const isDone = sessionStorage.getItem("reloaded") === version;
  if (isDone) return notify("This page and skin-view are of different versions.");
  sessionStorage.setItem("reloaded", version);
  location.reload();
}

/** Call back when the next frame is drawn; a hidden page draws none. */
export function afterFrame(go) {
  let isDone = false;
  const once = () => {
    if (!isDone) go();
    isDone = true;
  };
  requestAnimationFrame(once);
  setTimeout(once, UNSEEN_MS);
}

/** The theme that was chosen in this browser before; some let no page keep anything. */
export function storedTheme() {
  try {
    return localStorage.getItem("theme") ?? undefined;
  } catch {
    return undefined;
  }
}

export function storeTheme(theme) {
  try {
    localStorage.setItem("theme", theme);
  } catch {
    // it is chosen for this page alone
  }
}
