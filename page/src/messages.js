// Short messages (toasts) at the edge of the view, and the log of all messages.

import { element, icon } from "./dom.js";

const DURATION_MS = { note: 3500, error: 12000 };
const log = [];

export function showNote(text) { showToast(text, "note"); }
export function showError(text) { showToast(text, "error"); }

function showToast(text, kind) {
  log.push({ time: new Date(), text, kind });
  if (log.length > 500) log.shift();
  const region = document.getElementById(kind === "error" ? "errors" : "notes");
  const duplicate = [...region.children].find((toast) => toast.dataset.text === text);
  duplicate?.remove();
  const toast = element("div", { class: `toast ${kind}`, "data-text": text },
    element("span", {}, text),
    element("button", { class: "bare", "aria-label": "Dismiss", onclick: () => toast.remove() },
      icon("close")));
  region.append(toast);
  while (region.children.length > 4) region.firstChild.remove();
  setTimeout(() => toast.remove(), DURATION_MS[kind]);
}

export function showLog() {
  const dialog = document.getElementById("log");
  const list = dialog.querySelector("ol");
  list.replaceChildren(...log.toReversed().map(({ time, text, kind }) =>
    element("li", { class: kind }, element("time", {}, time.toLocaleTimeString()), text)));
  if (log.length === 0) list.append(element("li", {}, "No messages yet."));
  dialog.showModal();
}
