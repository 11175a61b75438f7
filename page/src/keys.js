// Table of all keyboard shortcuts, which is also shown as help.

import { element } from "./dom.js";
import { commitDraft, copyToNextFrame, decideTrack, dropDraft, goToKeyBox, interpolate, merge, nudge,
         propose, redo, rejectRest, removeBox, selectNextUncertain, setClass, snap, split,
         toggleChecked, trim, undo } from "./edits.js";
import { stepFrames, stopAndGoTo, togglePlay } from "./playback.js";
import { setTool, clickCentre } from "./pointer.js";
import { goToError } from "./resultpanel.js";
import { moveCamera, focusSelection, resetView, showTopView } from "./scene.js";
import { notify, select, getSelectedBox, store } from "./store.js";

const BOTH = "both", LABEL = "label", VIEW = "view";
const REPEATED_KEYS = new Set(["ArrowUp", "ArrowDown", "ArrowLeft", "ArrowRight"]);

export const COLOUR_SCHEMES = ["height", "intensity", "ground", "cluster", "class"];

export function setColourScheme(scheme) {
  store.colour = scheme;
  notify("colour");
}

function setNextColourScheme() {
  const index = COLOUR_SCHEMES.indexOf(store.colour) + 1;
  setColourScheme(COLOUR_SCHEMES[index % COLOUR_SCHEMES.length]);
}
const toggleNames = () => { store.showNames = !store.showNames; notify("tracks"); };

/** Return a function that moves the selected box, or the camera if no box is selected or another tool is
 * active. */
const onArrow = (step, moveView) => () => {
  if (getSelectedBox() && store.mode === "label" && store.tool === "select") nudge(step);
  else moveView();
};

// Columns: section, names of the keys in the browser (with "Ctrl+" and "Shift+"), keys shown in the help,
// description, function, mode
const TABLE = [
  ["Decide", "a", "A", "Accept the selected track, or the one under the pointer; go to the next", () => decideTrack("accept"), LABEL],
  ["Decide", "r", "R", "Reject the track; go to the next", () => decideTrack("reject"), LABEL],
  ["Decide", "Shift+r", "Shift R", "Reject all undecided tracks in the list", rejectRest, LABEL],
  ["Decide", "n", "N", "Next uncertain track", selectNextUncertain, LABEL],
  ["Decide", "u", "U", "Reopen a decided track", () => decideTrack("reopen"), LABEL],
  ["Decide", "k", "K", "Mark this frame as checked; go to the next", toggleChecked, LABEL],
  ["Decide", "p", "P", "Propose tracks with the detectors", propose, LABEL],
  ["Decide", "Ctrl+z", "Ctrl Z", "Undo", undo, LABEL],
  ["Decide", "Ctrl+y Ctrl+Shift+z", "Ctrl Y", "Redo", redo, LABEL],
  ["Tools", "s", "S", "Seed: click an object to propose similar objects", () => setTool("seed"), LABEL],
  ["Tools", "b", "B", "Box: click where to place a new box", () => setTool("add"), LABEL],
  ["Tools", "Enter", "Enter", "Click at the centre of the view (without a mouse)", clickCentre, BOTH],
  ["Tools", "Escape", "Esc", "Leave the tool; clear the selection", cancelTool, BOTH],
  ["Tools", "1 2 3 4 5 6 7 8 9", "1 – 9", "Set the class of the selected track or of new tracks", null, LABEL],
  ["Box", "ArrowUp", "↑", "Move forward by 5 cm", onArrow({ forward: 1 }, () => moveCamera(0, 0.04)), BOTH],
  ["Box", "ArrowDown", "↓", "Move back by 5 cm", onArrow({ forward: -1 }, () => moveCamera(0, -0.04)), BOTH],
  ["Box", "ArrowLeft", "←", "Move left by 5 cm", onArrow({ left: 1 }, () => moveCamera(-0.04, 0)), BOTH],
  ["Box", "ArrowRight", "→", "Move right by 5 cm", onArrow({ left: -1 }, () => moveCamera(0.04, 0)), BOTH],
  ["Box", "Shift+ArrowLeft", "Shift ←", "Rotate left by 1°", onArrow({ rotation: 1 }, () => moveCamera(0, 0, -0.05)), BOTH],
  ["Box", "Shift+ArrowRight", "Shift →", "Rotate right by 1°", onArrow({ rotation: -1 }, () => moveCamera(0, 0, 0.05)), BOTH],
  ["Box", "Shift+ArrowUp", "Shift ↑", "Move up by 5 cm", onArrow({ up: 1 }, () => moveCamera(0, 0, 0, 0.93)), BOTH],
  ["Box", "Shift+ArrowDown", "Shift ↓", "Move down by 5 cm", onArrow({ up: -1 }, () => moveCamera(0, 0, 0, 1.07)), BOTH],
  ["Box", "c", "C", "Snap to the cluster", () => snap("cluster"), LABEL],
  ["Box", "g", "G", "Snap to the ground", () => snap("ground"), LABEL],
  ["Box", "t", "T", "Snap to the size of the track", () => snap("size"), LABEL],
  ["Track", "v", "V", "Copy the box to the next frame", copyToNextFrame, LABEL],
  ["Track", "i", "I", "Interpolate the box in this frame", interpolate, LABEL],
  ["Track", "Delete", "Del", "Remove the box in this frame", removeBox, LABEL],
  ["Track", "m", "M", "Merge the selected tracks", merge, LABEL],
  ["Track", "x", "X", "Split the track at this frame", split, LABEL],
  ["Track", "q", "Q", "Track starts here: remove earlier boxes", () => trim("before"), LABEL],
  ["Track", "e", "E", "Track ends here: remove later boxes", () => trim("after"), LABEL],
  ["Track", "[", "[", "Previous key box", () => goToKeyBox(-1), LABEL],
  ["Track", "]", "]", "Next key box", () => goToKeyBox(1), LABEL],
  ["Frames", ", PageUp", ",", "Previous frame", () => stepFrames(-1), BOTH],
  ["Frames", ". PageDown", ".", "Next frame", () => stepFrames(1), BOTH],
  ["Frames", "Home", "Home", "First frame", () => stopAndGoTo(store.drive.first), BOTH],
  ["Frames", "End", "End", "Last frame", () => stopAndGoTo(store.drive.frames.length - 1), BOTH],
  ["Frames", "Space", "Space", "Play or stop", togglePlay, BOTH],
  ["Errors", "n ]", "N", "Next miss or false positive", () => goToError(1), VIEW],
  ["Errors", "[", "[", "Previous miss or false positive", () => goToError(-1), VIEW],
  ["View", "f", "F", "Zoom in on the selected box", focusSelection, BOTH],
  ["View", "o", "O", "Top view", showTopView, BOTH],
  ["View", "0", "0", "Initial view", resetView, BOTH],
  ["View", "h", "H", "Next colour scheme", setNextColourScheme, BOTH],
  ["View", "l", "L", "Show or hide the names of boxes", toggleNames, BOTH],
  ["View", "?", "?", "Show the keyboard shortcuts", showHelp, BOTH],
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

/** Return true if the focused element handles the key. */
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
  // Remove the focus from a button after a mouse click, so that Space starts playback instead of pressing it again.
  addEventListener("click", ({ detail, target }) => { if (detail) target.closest?.("button")?.blur(); });
  // Remove the focus from a select element after a choice by mouse, so that arrow keys move the box.
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
