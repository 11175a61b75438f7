// Every key, in one table: what it does, and the help that lists them.

import { element } from "./dom.js";
import { checkFrame, commit, copyOn, decide, dropDraft, interpolate, merge, next, nudge, propose,
         redo, rejectRest, removeBox, setClass, snap, split, toKey, trim,
         undo } from "./edits.js";
import { step, to, togglePlay } from "./playback.js";
import { setTool, useCentre } from "./pointer.js";
import { nextWrong } from "./results.js";
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

/** The box where one is selected; else, and while a place is looked for, the camera. */
const arrow = (box, camera) => () => {
  if (selectedBox() && store.mode === "label" && store.tool === "select") nudge(box);
  else camera();
};

// section, keys as the browser names them (with "Ctrl+" and "Shift+"), keys as shown, what, run
const TABLE = [
  ["Decide", "a", "A", "Accept what is selected, or pointed at; on to the next", () => decide("accept"), LABEL],
  ["Decide", "r", "R", "Reject it; on to the next uncertain one", () => decide("reject"), LABEL],
  ["Decide", "Shift+r", "Shift R", "Reject all that are left in the list", rejectRest, LABEL],
  ["Decide", "n", "N", "Next uncertain track", next, LABEL],
  ["Decide", "u", "U", "Open a decided track again", () => decide("reopen"), LABEL],
  ["Decide", "k", "K", "This frame is checked; on to the next", checkFrame, LABEL],
  ["Decide", "p", "P", "Let the detectors propose tracks", propose, LABEL],
  ["Decide", "Ctrl+z", "Ctrl Z", "Undo", undo, LABEL],
  ["Decide", "Ctrl+y Ctrl+Shift+z", "Ctrl Y", "Redo", redo, LABEL],
  ["Tools", "s", "S", "Seed: click an object of the class", () => setTool("seed"), LABEL],
  ["Tools", "b", "B", "Box: click where a new one stands", () => setTool("add"), LABEL],
  ["Tools", "Enter", "Enter", "What is in the middle of the view: select, seed, or add", useCentre, BOTH],
  ["Tools", "Escape", "Esc", "Back to selecting; nothing selected", escape, BOTH],
  ["Tools", "1 2 3 4 5 6 7 8 9", "1 – 9", "Class, of what is selected or of new ones", null, LABEL],
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
  ["Track", "q", "Q", "Begins here: no boxes before", () => trim("before"), LABEL],
  ["Track", "e", "E", "Ends here: no boxes after", () => trim("after"), LABEL],
  ["Track", "[", "[", "Box set by hand before this frame", () => toKey(-1), LABEL],
  ["Track", "]", "]", "Box set by hand after this frame", () => toKey(1), LABEL],
  ["Frames", ", PageUp", ",", "Previous frame", () => step(-1), BOTH],
  ["Frames", ". PageDown", ".", "Next frame", () => step(1), BOTH],
  ["Frames", "Home", "Home", "First frame", () => to(store.drive.first), BOTH],
  ["Frames", "End", "End", "Last frame", () => to(store.drive.frames.length - 1), BOTH],
  ["Frames", "Space", "Space", "Play, stop", togglePlay, BOTH],
  ["Errors", "n ]", "N", "Next one that was missed or is false", () => nextWrong(1), VIEW],
  ["Errors", "[", "[", "The last one before", () => nextWrong(-1), VIEW],
  ["View", "f", "F", "Look at the selected box", focus, BOTH],
  ["View", "o", "O", "From above", topView, BOTH],
  ["View", "0", "0", "The view at the beginning", resetView, BOTH],
  ["View", "h", "H", "Next colouring", nextColour, BOTH],
  ["View", "l", "L", "Names of boxes on, off", toggleNames, BOTH],
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

/** Keys that the focused element needs itself. */
function taken(event) {
  const { target } = event;
  if (document.querySelector("dialog[open]")) return true;
  if (target.matches?.("input[type=range]")) return HELD.has(event.key) || /^(Home|End|Page)/.test(event.key);
  if (target.matches?.("input:not([type=checkbox]), select, textarea")) return event.key !== "Escape";
  return target.matches?.("button, summary, input") && (event.key === " " || event.key === "Enter");
}

function press(event) {
  if (taken(event) || event.altKey || !store.drive) return;
  const name = nameOf(event), asked = `${store.mode} ${name}`;
  if (!runs.has(asked)) return;
  event.preventDefault();
  if (event.target.matches?.("input, select")) event.target.blur();
  if (event.repeat && !HELD.has(event.key) && !/^[.,]$|^Page/.test(event.key)) return;
  const run = runs.get(asked), entry = store.drive.classes[Number(name) - 1];
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
  // After a click by mouse the keys are the page's again: Space plays, and presses no button twice.
  addEventListener("click", ({ detail, target }) => { if (detail) target.closest?.("button")?.blur(); });
  // So after a choice by mouse, or an arrow that is to move the box would change its class.
  addEventListener("pointerdown", ({ target }) => { pointed = target; }, { capture: true });
  addEventListener("change", ({ target }) => { if (target === pointed && target.matches("select")) target.blur(); });
}

/** Fill the help, for label or view mode. */
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
