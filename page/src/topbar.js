// Top bar with the drive, the progress and buttons, and the dialogs for import and export.

import { sendAction, exportLabels } from "./api.js";
import { element, icon } from "./dom.js";
import { getClassColour } from "./colours.js";
import { getNewClass, propose, redo, rejectRest, setClass, undo } from "./edits.js";
import { COLOUR_SCHEMES, setColourScheme, showHelp } from "./keys.js";
import { showNote, showLog } from "./messages.js";
import { stepFrames, togglePlay } from "./playback.js";
import { setTool } from "./pointer.js";
import { focusSelection, resetView, showTopView } from "./scene.js";
import { notify, on, store } from "./store.js";

const byId = (id) => document.getElementById(id);
const COMMANDS = {
  undo, redo, propose, play: togglePlay, previous: () => stepFrames(-1), next: () => stepFrames(1),
  focus: focusSelection,
  "log-open": showLog, "help-open": showHelp, theme: setNextTheme, export: () => byId("export-dialog").showModal(),
  import: () => byId("import-dialog").showModal(), reset: resetView, above: showTopView,
  "tool-select": () => setTool("select"), "tool-seed": () => setTool("seed"),
  "tool-add": () => setTool("add"), "reject-rest": rejectRest,
};

const THEMES = ["auto", "light", "dark"];

function setNextTheme() {
  const current = document.documentElement.dataset.theme;
  setTheme(THEMES[(THEMES.indexOf(current) + 1) % THEMES.length]);
}

export function setTheme(name) {
  document.documentElement.dataset.theme = name;
  byId("theme").title = `Theme: ${name === "auto" ? "system" : name}`;
  try { localStorage.setItem("theme", name); } catch { /* without storage, the theme applies to this page only */ }
  notify("theme");
}

export function openTopbar() {
  for (const button of document.querySelectorAll("[data-icon]")) button.prepend(icon(button.dataset.icon));
  for (const [id, run] of Object.entries(COMMANDS)) {
    const button = byId(id);
    if (button) button.onclick = run;
  }
  let name = new URLSearchParams(location.search).get("theme");
  try { name ??= localStorage.getItem("theme") ?? "auto"; } catch { /* the browser does not allow storage */ }
  setTheme(THEMES.includes(name) ? name : "auto");
  for (const scheme of COLOUR_SCHEMES) byId("colour").append(element("option", { value: scheme }, scheme));
  byId("colour").onchange = () => setColourScheme(byId("colour").value);
  byId("advance").onchange = () => { store.autoAdvance = byId("advance").checked; };
  for (const dialog of document.querySelectorAll("dialog")) {
    dialog.addEventListener("click", (event) => { if (event.target === dialog) dialog.close(); });
    for (const close of dialog.querySelectorAll("[data-close]")) close.onclick = () => dialog.close();
  }
  byId("export-form").onsubmit = sendExport;
  byId("import-form").onsubmit = sendImport;
  on("drive", showDrive);
  on("progress drive", showProgress);
  on("tracks drive", () => { // hide the timeline if there can be no tracks
    document.documentElement.dataset.tracks = store.drive && store.mode === "view"
      && !store.drive.live && store.tracks.size === 0 ? "none" : "some";
  });
  on("selection drive", () => {
    document.documentElement.dataset.selected = String(store.selected !== null || store.selectedResult !== null);
  });
  on("connection", () => {
    byId("lost").hidden = store.online;
    byId("lost").textContent = store.refused
      ? "The server was restarted with a new token. Open the address that it printed."
      : "Connection lost, reconnecting… Saved labels are safe.";
  });
  on("colour", () => { byId("colour").value = store.colour; });
  on("tool drive", showTool);
  on("playing", () => {
    byId("play").replaceChildren(icon(store.playing ? "pause" : "play"));
    const live = store.drive?.live, titles = live ? ["Show the newest frames", "Pause"] : ["Play", "Stop"];
    byId("play").setAttribute("aria-label", titles[Number(store.playing)]);
    byId("play").title = `${titles[Number(store.playing)]} (Space)`;
  });
}

function showDrive() {
  const { name, path, layout, frames, can_export: formats } = store.drive;
  document.title = `${name} · ${store.mode === "view" ? "view" : "label"}`;
  document.documentElement.dataset.mode = store.mode;
  byId("drive").textContent = name;
  byId("drive").title = path;
  byId("layout").textContent = store.drive.live ? "running graph" : `${layout} · ${frames.length} frame${frames.length === 1 ? "" : "s"}`;
  const choices = () => (formats ?? []).map((format) =>
    element("option", { value: format }, format.replaceAll("_", " ")));
  byId("export-format").replaceChildren(...choices());
  byId("import-format").replaceChildren(element("option", { value: "" }, "detect automatically"),
                                      ...choices());
}

function showProgress() {
  const { progress } = store;
  byId("undo").disabled = !store.canUndo;
  byId("redo").disabled = !store.canRedo;
  if (!progress) return;
  const { tracks, accepted, rejected, left, frames, checked, busy } = progress;
  byId("bar-accepted").style.flexGrow = accepted;
  byId("bar-rejected").style.flexGrow = rejected;
  byId("bar-left").style.flexGrow = tracks ? left : 1;
  byId("progress-text").textContent = `${left} open · ${accepted} accepted · ${rejected} rejected · `
    + `${checked} of ${frames} frames checked`;
  if (byId("busy").hidden !== !busy) notify("busy");
  byId("busy").hidden = !busy;
  if (busy) {
    byId("busy").textContent = `${busy.what}: frame ${busy.done} of ${busy.of}`;
    byId("busy").style.setProperty("--done", busy.of ? busy.done / busy.of : 0);
  }
  byId("propose").disabled = Boolean(busy);
}

function showTool() {
  for (const name of ["select", "seed", "add"]) {
    byId(`tool-${name}`).setAttribute("aria-pressed", String(store.tool === name));
  }
  byId("tool-hint").hidden = store.tool === "select" || !store.drive;
  if (byId("tool-hint").hidden) return;
  byId("tool-hint").firstElementChild.textContent = store.tool === "add"
    ? "Click where to place the new box. Press Esc to leave the tool."
    : "Click an object to propose similar objects in the whole drive. Press Esc to leave the tool.";
  byId("tool-classes").replaceChildren(...store.drive.classes.slice(0, 9).map(({ name }, k) =>
    element("button", { class: "chip", "aria-pressed": String(name === getNewClass()),
      onclick: () => setClass(name) },
      element("i", { class: "dot", style: `background:${getClassColour(name)}` }), name,
      element("kbd", {}, `${k + 1}`))));
}

async function sendExport(event) {
  event.preventDefault();
  const errorLine = byId("export-error"), button = event.submitter;
  errorLine.textContent = "";
  if (button) button.disabled = true;
  try {
    const result = await exportLabels({ format: byId("export-format").value,
      out: byId("export-out").value, force: byId("export-force").checked });
    byId("export-dialog").close();
    const leftOut = result.left_out.length ? `. Left out: ${result.left_out.join(", ")}` : "";
    showNote(`Exported ${result.boxes} boxes in ${result.frames} frames to ${result.path}${leftOut}`);
  } catch (error) {
    errorLine.textContent = error.message;
  } finally {
    if (button) button.disabled = false;
  }
}

async function sendImport(event) {
  event.preventDefault();
  const errorLine = byId("import-error"); // shown in the dialog, which would hide a toast
  errorLine.textContent = "";
  if (await sendAction({ do: "import", path: byId("import-path").value, format: byId("import-format").value },
    (text) => { errorLine.textContent = text; })) byId("import-dialog").close();
}
