// All keys in one table, which also makes the help.

import { element } from "./dom.js";
import { checkFrame, commit, copyOn, decide, dropDraft, interpolate, merge, next, nudge, propose,
         redo, rejectRest, removeBox, setClass, snap, split, toKey, trim,
         undo } from "./edits.js";
import { step, to, togglePlay } from "./playback.js";
import { setTool, useCentre } from "./pointer.js";
import { nextWrong } from "./resultpanel.js";
import { fly, focus, resetView, topView } from "./scene.js";
import { changed, select, selectedBox, store } from "./store.js";

const BOTH = "both", LABEL = "label", VIEW = "view";
const HELD = new Set(["ArrowUp", "ArrowDown", "ArrowLeft", "ArrowRight"]);

export const COLOURS = ["height", "intensity", "ground", "cluster", "class"];

export function setColour(how) {
  store.colour = how;
  changed("colour");
}

const nextColour = () => setColour(COLOURS[(COLOURS.indexOf(store.colour) + 1) % COLOURS.length]);
const toggleNames = () => { store.names = !store.names; changed("tracks"); };

/** Move the selected box; without one, or with another tool, the camera. */
const arrow = (box, camera) => () => {
  if (selectedBox() && store.mode === "label" && store.tool === "select") nudge(box);
  else camera();
};

// section, keys as the browser names them (with "Ctrl+" and "Shift+"), keys as shown, what, run
const TABLE = [
  ["Decide", "a", "A", "Accept the track that is selected or under the pointer; go to the next", () => decide("accept"), LABEL],
  ["Decide", "r", "R", "Reject it; go to the next uncertain one", () => decide("reject"), LABEL],
  ["Decide", "Shift+r", "Shift R", "Reject all undecided tracks in the list", rejectRest, LABEL],
  ["Decide", "n", "N", "Next uncertain track", next, LABEL],
  ["Decide", "u", "U", "Reopen a decided track", () => decide("reopen"), LABEL],
  ["Decide", "k", "K", "Mark this frame as checked; go to the next", checkFrame, LABEL],
  ["Decide", "p", "P", "Propose tracks with the detectors", propose, LABEL],
  ["Decide", "Ctrl+z", "Ctrl Z", "Undo", undo, LABEL],
  ["Decide", "Ctrl+y Ctrl+Shift+z", "Ctrl Y", "Redo", redo, LABEL],
  ["Tools", "s", "S", "Seed: click an object; similar ones are proposed", () => setTool("seed"), LABEL],
  ["Tools", "b", "B", "Box: click where to place a new one", () => setTool("add"), LABEL],
  ["Tools", "Enter", "Enter", "Click in the middle of the view: select, seed or add", useCentre, BOTH],
  ["Tools", "Escape", "Esc", "Back to selecting; clear the selection", escape, BOTH],
  ["Tools", "1 2 3 4 5 6 7 8 9", "1 – 9", "Class of the selected track or of new ones", null, LABEL],
  ["Box", "ArrowUp", "↑", "Forward by 5 cm", arrow({ forward: 1 }, () => fly(0, 0.04)), BOTH],
  ["Box", "ArrowDown", "↓", "Back by 5 cm", arrow({ forward: -1 }, () => fly(0, -0.04)), BOTH],
  ["Box", "ArrowLeft", "←", "Left by 5 cm", arrow({ left: 1 }, () => fly(-0.04, 0)), BOTH],
  ["Box", "ArrowRight", "→", "Right by 5 cm", arrow({ left: -1 }, () => fly(0.04, 0)), BOTH],
  ["Box", "Shift+ArrowLeft", "Shift ←", "Turn left by 1°", arrow({ turn: 1 }, () => fly(0, 0, -0.05)), BOTH],
  ["Box", "Shift+ArrowRight", "Shift →", "Turn right by 1°", arrow({ turn: -1 }, () => fly(0, 0, 0.05)), BOTH],
  ["Box", "Shift+ArrowUp", "Shift ↑", "Up by 5 cm", arrow({ up: 1 }, () => fly(0, 0, 0, 0.93)), BOTH],
  ["Box", "Shift+ArrowDown", "Shift ↓", "Down by 5 cm", arrow({ up: -1 }, () => fly(0, 0, 0, 1.07)), BOTH],
  ["Box", "c", "C", "Snap to the cluster", () => snap("cluster"), LABEL],
  ["Box", "g", "G", "Snap to the ground", () => snap("ground"), LABEL],
  ["Box", "t", "T", "Snap to the size of the track", () => snap("size"), LABEL],
  ["Track", "v", "V", "Copy the box to the next frame", copyOn, LABEL],
  ["Track", "i", "I", "Interpolate this frame", interpolate, LABEL],
  ["Track", "Delete", "Del", "Remove the box of this frame", removeBox, LABEL],
  ["Track", "m", "M", "Merge the selected tracks", merge, LABEL],
  ["Track", "x", "X", "Split here", split, LABEL],
  ["Track", "q", "Q", "Starts here: remove boxes before", () => trim("before"), LABEL],
  ["Track", "e", "E", "Ends here: remove boxes after", () => trim("after"), LABEL],
  ["Track", "[", "[", "Previous box set by hand", () => toKey(-1), LABEL],
  ["Track", "]", "]", "Next box set by hand", () => toKey(1), LABEL],
  ["Frames", ", PageUp", ",", "Previous frame", () => step(-1), BOTH],
  ["Frames", ". PageDown", ".", "Next frame", () => step(1), BOTH],
  ["Frames", "Home", "Home", "First frame", () => to(store.drive.first), BOTH],
  ["Frames", "End", "End", "Last frame", () => to(store.drive.frames.length - 1), BOTH],
  ["Frames", "Space", "Space", "Play, stop", togglePlay, BOTH],
  ["Errors", "n ]", "N", "Next missed label or false detection", () => nextWrong(1), VIEW],
  ["Errors", "[", "[", "Previous missed label or false detection", () => nextWrong(-1), VIEW],
  ["View", "f", "F", "Zoom in on the selected box", focus, BOTH],
  ["View", "o", "O", "View from above", topView, BOTH],
  ["View", "0", "0", "Initial view", resetView, BOTH],
  ["View", "h", "H", "Next colour scheme", nextColour, BOTH],
  ["View", "l", "L", "Show or hide names of boxes", toggleNames, BOTH],
  ["View", "?", "?", "These keys", showHelp, BOTH],
];

const runs = new Map();
for (const [, keys, , , run, where] of TABLE) {
  for (const key of keys.split(" ")) {
    for (const mode of where === BOTH ? [LABEL, VIEW] : [where]) runs.set(`${mode} ${key}`, run);
  }
}

function escape() {
  if (store.draft) dropDraft();
  else if (store.tool !== "select") setTool("select");
  else select(null);
}

function nameOf(event) {
  const key = event.key === " " ? "Space" : event.key.length === 1 ? event.key.toLowerCase() : event.key;
  const shift = event.shiftKey && (key.length > 1 || event.ctrlKey || /[a-z]/.test(key)) ? "Shift+" : "";
  return `${event.ctrlKey || event.metaKey ? "Ctrl+" : ""}${shift}${key}`;
}

/** True for keys that the focused element uses itself. */
function isUsedByElement(event) {
  const { target } = event;
  if (document.querySelector("dialog[open]")) return true;
  if (target.matches?.("input[type=range]")) return HELD.has(event.key) || /^(Home|End|Page)/.test(event.key);
  if (target.matches?.("input:not([type=checkbox]), select, textarea")) return event.key !== "Escape";
  return target.matches?.("button, summary, input") && (event.key === " " || event.key === "Enter");
}

function press(event) {
  if (isUsedByElement(event) || event.altKey || !store.drive) return;
  const name = nameOf(event), modeAndKey = `${store.mode} ${name}`;
  if (!runs.has(modeAndKey)) return;
  event.preventDefault();
  if (event.target.matches?.("input, select")) event.target.blur();
  if (event.repeat && !HELD.has(event.key) && !/^[.,]$|^Page/.test(event.key)) return;
  const run = runs.get(modeAndKey), entry = store.drive.classes[Number(name) - 1];
  if (run) run();
  else if (entry) setClass(entry.name);
}

export function showHelp() {
  document.getElementById("help").showModal();
}

export function openKeys() {
  let pointed = null;
  addEventListener("keydown", press);
  addEventListener("keyup", (event) => { if (HELD.has(event.key)) commit(); });
  addEventListener("blur", () => commit());
  // A button loses focus after a mouse click, so that Space plays instead of pressing it again.
  addEventListener("click", ({ detail, target }) => { if (detail) target.closest?.("button")?.blur(); });
  // So does a list after a choice by mouse, so that arrow keys move the box instead of the choice.
  addEventListener("pointerdown", ({ target }) => { pointed = target; }, { capture: true });
  addEventListener("change", ({ target }) => { if (target === pointed && target.matches("select")) target.blur(); });
}

/** Fill the help with the keys of the mode. */
export function listKeys() {
  const sections = new Map();
  for (const [section, , keys, what, , where] of TABLE) {
    if (where !== BOTH && where !== store.mode) continue;
    if (!sections.has(section)) sections.set(section, []);
    sections.get(section).push(element("div", {}, element("dt", {},
      ...keys.split(" ").map((key) => element("kbd", {}, key))), element("dd", {}, what)));
  }
  document.getElementById("keys").replaceChildren(...[...sections].map(([title, rows]) =>
    element("section", {}, element("h3", {}, title), element("dl", {}, ...rows))));
}
