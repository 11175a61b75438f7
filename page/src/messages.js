// Short messages at the edge of the view, and the log of all messages.

import { element, icon } from "./dom.js";

const SHOWN_MS = { note: 3500, error: 12000 };
const log = [];

export function say(text) { show(text, "note"); }
export function sayError(text) { show(text, "error"); }

function show(text, kind) {
  log.push({ time: new Date(), text, kind });
  if (log.length > 500) log.shift();
  const region = document.getElementById(kind === "error" ? "errors" : "notes");
  const same = [...region.children].find((toast) => toast.dataset.text === text);
  same?.remove();
  const toast = element("div", { class: `toast ${kind}`, "data-text": text },
    element("span", {}, text),
    element("button", { class: "bare", "aria-label": "Dismiss", onclick: () => toast.remove() },
      icon("close")));
  region.append(toast);
  while (region.children.length > 4) region.firstChild.remove();
  setTimeout(() => toast.remove(), SHOWN_MS[kind]);
}

export function showLog() {
  const dialog = document.getElementById("log");
  const list = dialog.querySelector("ol");
  list.replaceChildren(...log.toReversed().map(({ time, text, kind }) =>
    element("li", { class: kind }, element("time", {}, time.toLocaleTimeString()), text)));
  if (log.length === 0) list.append(element("li", {}, "No messages yet."));
  dialog.showModal();
}
