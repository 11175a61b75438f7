// All keys in one table, which also makes the help.

import { element } from "./dom.js";
import { commitDraft, copyToNextFrame, decideTrack, dropDraft, goToKeyBox, interpolate, merge, nudge,
         propose, redo, rejectRest, removeBox, selectNextUncertain, setClass, snap, split,
         toggleChecked, trim, undo } from "./edits.js";
import { stepFrames, stopAndGoTo, togglePlay } from "./playback.js";
import { setTool, clickCentre } from "./pointer.js";
import { goToError } from "./resultpanel.js";
import { moveCamera, focusSelection, resetView, topView } from "./scene.js";
import { notify, select, getSelectedBox, store } from "./store.js";

const BOTH = "both", LABEL = "label", VIEW = "view";
const REPEATED_KEYS = new Set(["ArrowUp", "ArrowDown", "ArrowLeft", "ArrowRight"]);

export const COLOUR_SCHEMES = ["height", "intensity", "ground", "cluster", "class"];

export function setColourScheme(how) {
  store.colour = how;
  notify("colour");
}

function nextColour() {
  const index = COLOUR_SCHEMES.indexOf(store.colour) + 1;
  setColourScheme(COLOUR_SCHEMES[index % COLOUR_SCHEMES.length]);
}
const toggleNames = () => { store.showNames = !store.showNames; notify("tracks"); };

/** Move the selected box; without one, or with another tool, the camera. */
const onArrow = (box, camera) => () => {
  if (getSelectedBox() && store.mode === "label" && store.tool === "select") nudge(box);
  else camera();
};

// section, keys as the browser names them (with "Ctrl+" and "Shift+"), keys as shown, description,
// action, mode
const TABLE = [
  ["Decide", "a", "A", "Accept the track that is selected or under the pointer; go to the next", () => decideTrack("accept"), LABEL],
  ["Decide", "r", "R", "Reject it; go to the next uncertain one", () => decideTrack("reject"), LABEL],
  ["Decide", "Shift+r", "Shift R", "Reject all undecided tracks in the list", rejectRest, LABEL],
  ["Decide", "n", "N", "Next uncertain track", selectNextUncertain, LABEL],
  ["Decide", "u", "U", "Reopen a decided track", () => decideTrack("reopen"), LABEL],
  ["Decide", "k", "K", "Mark this frame as checked; go to the next", toggleChecked, LABEL],
  ["Decide", "p", "P", "Propose tracks with the detectors", propose, LABEL],
  ["Decide", "Ctrl+z", "Ctrl Z", "Undo", undo, LABEL],
  ["Decide", "Ctrl+y Ctrl+Shift+z", "Ctrl Y", "Redo", redo, LABEL],
  ["Tools", "s", "S", "Seed: click an object; similar ones are proposed", () => setTool("seed"), LABEL],
  ["Tools", "b", "B", "Box: click where to place a new one", () => setTool("add"), LABEL],
  ["Tools", "Enter", "Enter", "Click in the middle of the view: select, seed or add", clickCentre, BOTH],
  ["Tools", "Escape", "Esc", "Back to selecting; clear the selection", cancelTool, BOTH],
  ["Tools", "1 2 3 4 5 6 7 8 9", "1 – 9", "Class of the selected track or of new ones", null, LABEL],
  ["Box", "ArrowUp", "↑", "Forward by 5 cm", onArrow({ forward: 1 }, () => moveCamera(0, 0.04)), BOTH],
  ["Box", "ArrowDown", "↓", "Back by 5 cm", onArrow({ forward: -1 }, () => moveCamera(0, -0.04)), BOTH],
  ["Box", "ArrowLeft", "←", "Left by 5 cm", onArrow({ left: 1 }, () => moveCamera(-0.04, 0)), BOTH],
  ["Box", "ArrowRight", "→", "Right by 5 cm", onArrow({ left: -1 }, () => moveCamera(0.04, 0)), BOTH],
  ["Box", "Shift+ArrowLeft", "Shift ←", "Turn left by 1°", onArrow({ turn: 1 }, () => moveCamera(0, 0, -0.05)), BOTH],
  ["Box", "Shift+ArrowRight", "Shift →", "Turn right by 1°", onArrow({ turn: -1 }, () => moveCamera(0, 0, 0.05)), BOTH],
  ["Box", "Shift+ArrowUp", "Shift ↑", "Up by 5 cm", onArrow({ up: 1 }, () => moveCamera(0, 0, 0, 0.93)), BOTH],
  ["Box", "Shift+ArrowDown", "Shift ↓", "Down by 5 cm", onArrow({ up: -1 }, () => moveCamera(0, 0, 0, 1.07)), BOTH],
  ["Box", "c", "C", "Snap to the cluster", () => snap("cluster"), LABEL],
  ["Box", "g", "G", "Snap to the ground", () => snap("ground"), LABEL],
  ["Box", "t", "T", "Snap to the size of the track", () => snap("size"), LABEL],
  ["Track", "v", "V", "Copy the box to the next frame", copyToNextFrame, LABEL],
  ["Track", "i", "I", "Interpolate this frame", interpolate, LABEL],
  ["Track", "Delete", "Del", "Remove the box of this frame", removeBox, LABEL],
  ["Track", "m", "M", "Merge the selected tracks", merge, LABEL],
  ["Track", "x", "X", "Split here", split, LABEL],
  ["Track", "q", "Q", "Starts here: remove boxes before", () => trim("before"), LABEL],
  ["Track", "e", "E", "Ends here: remove boxes after", () => trim("after"), LABEL],
  ["Track", "[", "[", "Previous box set by hand", () => goToKeyBox(-1), LABEL],
  ["Track", "]", "]", "Next box set by hand", () => goToKeyBox(1), LABEL],
  ["Frames", ", PageUp", ",", "Previous frame", () => stepFrames(-1), BOTH],
  ["Frames", ". PageDown", ".", "Next frame", () => stepFrames(1), BOTH],
  ["Frames", "Home", "Home", "First frame", () => stopAndGoTo(store.drive.first), BOTH],
  ["Frames", "End", "End", "Last frame", () => stopAndGoTo(store.drive.frames.length - 1), BOTH],
  ["Frames", "Space", "Space", "Play, stop", togglePlay, BOTH],
  ["Errors", "n ]", "N", "Next missed label or false detection", () => goToError(1), VIEW],
  ["Errors", "[", "[", "Previous missed label or false detection", () => goToError(-1), VIEW],
  ["View", "f", "F", "Zoom in on the selected box", focusSelection, BOTH],
  ["View", "o", "O", "View from above", topView, BOTH],
  ["View", "0", "0", "Initial view", resetView, BOTH],
  ["View", "h", "H", "Next colour scheme", nextColour, BOTH],
  ["View", "l", "L", "Show or hide names of boxes", toggleNames, BOTH],
  ["View", "?", "?", "These keys", showHelp, BOTH],
];

const actionByKey = new Map();
for (const [, keys, , , run, keyMode] of TABLE) {
  for (const key of keys.split(" ")) {
    for (const mode of keyMode === BOTH ? [LABEL, VIEW] : [keyMode]) actionByKey.set(`${mode} ${key}`, run);
  }
}

function cancelTool() {
  if (store.draft) dropDraft();
  else if (store.tool !== "select") setTool("select");
  else select(null);
}

function nameKey(event) {
  const key = event.key === " " ? "Space" : event.key.length === 1 ? event.key.toLowerCase() : event.key;
  const shift = event.shiftKey && (key.length > 1 || event.ctrlKey || /[a-z]/.test(key)) ? "Shift+" : "";
  return `${event.ctrlKey || event.metaKey ? "Ctrl+" : ""}${shift}${key}`;
}

/** Return true for keys that the focused element handles. */
function isUsedByElement(event) {
  const { target } = event;
  if (document.querySelector("dialog[open]")) return true;
  if (target.matches?.("input[type=range]")) {
    return REPEATED_KEYS.has(event.key) || /^(Home|End|Page)/.test(event.key);
  }
  if (target.matches?.("input:not([type=checkbox]), select, textarea")) return event.key !== "Escape";
  return target.matches?.("button, summary, input") && (event.key === " " || event.key === "Enter");
}

function handleKey(event) {
  if (isUsedByElement(event) || event.altKey || !store.drive) return;
  const name = nameKey(event), modeAndKey = `${store.mode} ${name}`;
  if (!actionByKey.has(modeAndKey)) return;
  event.preventDefault();
  if (event.target.matches?.("input, select")) event.target.blur();
  if (event.repeat && !REPEATED_KEYS.has(event.key) && !/^[.,]$|^Page/.test(event.key)) return;
  const run = actionByKey.get(modeAndKey), entry = store.drive.classes[Number(name) - 1];
  if (run) run();
  else if (entry) setClass(entry.name);
}

export function showHelp() {
  document.getElementById("help").showModal();
}

export function openKeys() {
  let pressedTarget = null;
  addEventListener("keydown", handleKey);
  addEventListener("keyup", (event) => { if (REPEATED_KEYS.has(event.key)) commitDraft(); });
  addEventListener("blur", () => commitDraft());
  // A button loses focus after a mouse click, so that Space plays instead of pressing it again.
  addEventListener("click", ({ detail, target }) => { if (detail) target.closest?.("button")?.blur(); });
  // A list loses focus after a choice by mouse, so that arrow keys move the box.
  addEventListener("pointerdown", ({ target }) => { pressedTarget = target; }, { capture: true });
  addEventListener("change", ({ target }) => {
    if (target === pressedTarget && target.matches("select")) target.blur();
  });
}

/** Fill the help dialog with the keys of the current mode. */
export function fillHelp() {
  const sections = new Map();
  for (const [section, , keys, description, , keyMode] of TABLE) {
    if (keyMode !== BOTH && keyMode !== store.mode) continue;
    if (!sections.has(section)) sections.set(section, []);
    sections.get(section).push(element("div", {}, element("dt", {},
      ...keys.split(" ").map((key) => element("kbd", {}, key))), element("dd", {}, description)));
  }
  document.getElementById("keys").replaceChildren(...[...sections].map(([title, rows]) =>
    element("section", {}, element("h3", {}, title), element("dl", {}, ...rows))));
}
