// What the page wants of the browser's window: notices, a chosen theme that is kept, files, reloading.

import { byId, setHidden, setText } from "./dom.js";

const NOTICE_MS = 6000;
const UNSEEN_MS = 1000; // between turns of a page that nobody sees

let noticeTimer = 0;

/** Say something for a while. */
export function notify(text) {
  setText(byId("notice"), text);
  setHidden(byId("notice"), !text);
  clearTimeout(noticeTimer);
  noticeTimer = setTimeout(() => setHidden(byId("notice"), true), NOTICE_MS);
}

/** Load the page anew, since it is of another version than the server; but not for ever. */
export function reload(version) {
  const isDone = sessionStorage.getItem("reloaded") === version;
  if (isDone) return notify("This page and skin-view are of different versions.");
  sessionStorage.setItem("reloaded", version);
  location.reload();
}

/** Go on when the next frame is drawn; of a page that nobody sees, none is. */
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
