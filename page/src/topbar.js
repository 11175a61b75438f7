// The top bar: drive, progress, undo, tools, theme, help; and the dialogs for import and export.

import { act, exportLabels } from "./api.js";
import { element, icon } from "./dom.js";
import { colourOfClass } from "./colours.js";
import { classToAdd, propose, redo, rejectRest, setClass, undo } from "./edits.js";
import { COLOURS, setColour, showHelp } from "./keys.js";
import { say, showLog } from "./messages.js";
import { step, togglePlay } from "./playback.js";
import { setTool } from "./pointer.js";
import { focus, resetView, topView } from "./scene.js";
import { changed, on, store } from "./store.js";

const by = (id) => document.getElementById(id);
const RUN = {
  undo, redo, propose, play: togglePlay, previous: () => step(-1), next: () => step(1), focus,
  "log-open": showLog, "help-open": showHelp, theme: nextTheme, export: () => by("export-dialog").showModal(),
  import: () => by("import-dialog").showModal(), reset: resetView, above: topView,
  "tool-select": () => setTool("select"), "tool-seed": () => setTool("seed"),
  "tool-add": () => setTool("add"), "reject-rest": rejectRest,
};

const THEMES = ["auto", "light", "dark"];

function nextTheme() {
  const now = document.documentElement.dataset.theme;
  setTheme(THEMES[(THEMES.indexOf(now) + 1) % THEMES.length]);
}

export function setTheme(name) {
  document.documentElement.dataset.theme = name;
  by("theme").title = `Theme: ${name === "auto" ? "as the system" : name}`;
  try { localStorage.setItem("theme", name); } catch { /* not stored, so it only applies to this page */ }
  changed("theme");
}

export function openTopbar() {
  for (const button of document.querySelectorAll("[data-icon]")) button.prepend(icon(button.dataset.icon));
  for (const [id, run] of Object.entries(RUN)) {
    const button = by(id);
    if (button) button.onclick = run;
  }
  let kept = new URLSearchParams(location.search).get("theme");
  try { kept ??= localStorage.getItem("theme") ?? "auto"; } catch { /* storage is not allowed */ }
  setTheme(THEMES.includes(kept) ? kept : "auto");
  for (const how of COLOURS) by("colour").append(element("option", { value: how }, how));
  by("colour").onchange = () => setColour(by("colour").value);
  by("advance").onchange = () => { store.advance = by("advance").checked; };
  for (const dialog of document.querySelectorAll("dialog")) {
    dialog.addEventListener("click", (event) => { if (event.target === dialog) dialog.close(); });
    for (const close of dialog.querySelectorAll("[data-close]")) close.onclick = () => dialog.close();
  }
  by("export-form").onsubmit = sendExport;
  by("import-form").onsubmit = sendImport;
  on("drive", showDrive);
  on("progress drive", showProgress);
  on("tracks drive", () => { // hide the timeline if there can be no tracks
    document.documentElement.dataset.tracks = store.drive && store.mode === "view"
      && !store.drive.live && store.tracks.size === 0 ? "none" : "some";
  });
  on("selection drive", () => {
    document.documentElement.dataset.chosen = String(store.selected !== null || store.found !== null);
  });
  on("connection", () => {
    by("lost").hidden = store.online;
    by("lost").textContent = store.refused
      ? "The server was restarted. Open the address that it printed, which has a new token."
      : "Connection lost. Saved labels are safe; reconnecting…";
  });
  on("colour", () => { by("colour").value = store.colour; });
  on("tool drive", showTool);
  on("playing", () => {
    by("play").replaceChildren(icon(store.playing ? "pause" : "play"));
    const live = store.drive?.live, what = live ? ["Show the newest frames", "Pause"] : ["Play", "Stop"];
    by("play").setAttribute("aria-label", what[Number(store.playing)]);
    by("play").title = `${what[Number(store.playing)]} (Space)`;
  });
}

function showDrive() {
  const { name, path, layout, frames, can_export: formats } = store.drive;
  document.title = `${name} · ${store.mode === "view" ? "view" : "label"}`;
  document.documentElement.dataset.mode = store.mode;
  by("drive").textContent = name;
  by("drive").title = path;
  by("layout").textContent = store.drive.live ? "the running graph" : `${layout} · ${frames.length} frame${frames.length === 1 ? "" : "s"}`;
  const choices = () => (formats ?? []).map((format) =>
    element("option", { value: format }, format.replaceAll("_", " ")));
  by("export-format").replaceChildren(...choices());
  by("import-format").replaceChildren(element("option", { value: "" }, "detect automatically"),
                                      ...choices());
}

function showProgress() {
  const { progress } = store;
  by("undo").disabled = !store.canUndo;
  by("redo").disabled = !store.canRedo;
  if (!progress) return;
  const { tracks, accepted, rejected, left, frames, checked, busy } = progress;
  by("bar-accepted").style.flexGrow = accepted;
  by("bar-rejected").style.flexGrow = rejected;
  by("bar-left").style.flexGrow = tracks ? left : 1;
  by("progress-text").textContent = `${left} left · ${accepted} accepted · ${rejected} rejected · `
    + `${checked} of ${frames} frames checked`;
  if (by("busy").hidden !== !busy) changed("busy");
  by("busy").hidden = !busy;
  if (busy) {
    by("busy").textContent = `${busy.what} ${busy.done} of ${busy.of}`;
    by("busy").style.setProperty("--done", busy.of ? busy.done / busy.of : 0);
  }
  by("propose").disabled = Boolean(busy);
}

function showTool() {
  for (const name of ["select", "seed", "add"]) {
    by(`tool-${name}`).setAttribute("aria-pressed", String(store.tool === name));
  }
  by("tool-hint").hidden = store.tool === "select" || !store.drive;
  if (by("tool-hint").hidden) return;
  by("tool-hint").firstElementChild.textContent = store.tool === "add"
    ? "Click where to place the new box. Esc ends."
    : "Click a point of an object: similar objects are proposed in the whole drive. Esc ends.";
  by("tool-classes").replaceChildren(...store.drive.classes.slice(0, 9).map(({ name }, k) =>
    element("button", { class: "chip", "aria-pressed": String(name === classToAdd()),
      onclick: () => setClass(name) },
      element("i", { class: "dot", style: `background:${colourOfClass(name)}` }), name,
      element("kbd", {}, `${k + 1}`))));
}

async function sendExport(event) {
  event.preventDefault();
  const line = by("export-error"), button = event.submitter;
  line.textContent = "";
  if (button) button.disabled = true;
  try {
    const found = await exportLabels({ format: by("export-format").value,
      out: by("export-out").value, force: by("export-force").checked });
    by("export-dialog").close();
    const without = found.left_out.length ? `, without ${found.left_out.join(", ")}` : "";
    say(`Exported ${found.boxes} boxes of ${found.frames} frames to ${found.path}${without}`);
  } catch (error) {
    line.textContent = error.message;
  } finally {
    if (button) button.disabled = false;
  }
}

async function sendImport(event) {
  event.preventDefault();
  const line = by("import-error"); // the dialog would hide a message
  line.textContent = "";
  if (await act({ do: "import", path: by("import-path").value, format: by("import-format").value },
    (text) => { line.textContent = text; })) by("import-dialog").close();
}
