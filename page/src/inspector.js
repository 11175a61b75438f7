// Inspector of the selected track: class, box values, buttons, silhouettes.

import { getJson } from "./api.js";
import { getClassColour } from "./colours.js";
import { element } from "./dom.js";
import { commitDraft, copyToNextFrame, decideTrack, interpolate, merge, removeBox, setDraft,
         setTrackClass, snap, split, trim } from "./edits.js";
import { on, getSelectedBox, getSelectedTrack, store } from "./store.js";

const FIELDS = [["x", "m"], ["y", "m"], ["z", "m"], ["length", "m"], ["width", "m"],
                ["height", "m"], ["yaw", "°"]];
const KIND_TITLES = { key: "key box", proposed: "proposed", interpolated: "interpolated" };
const panel = document.getElementById("inspector");
const emptyHint = document.getElementById("nothing-selected");
const getField = (name) => document.getElementById(`field-${name}`);
let editedField = null; // the field with unsaved input

const BUTTONS = [
  ["Snap", [["cluster", "C", "Snap to the L-shape of its cluster", () => snap("cluster")],
            ["ground", "G", "Snap to the ground", () => snap("ground")],
            ["size", "T", "Snap to the size of the track", () => snap("size")]]],
  ["Box", [["copy", "V", "Copy the box to the next frame, and go to that frame", copyToNextFrame],
           ["interpolate", "I", "Interpolate between the previous and the next key box", interpolate],
           ["remove", "Del", "Remove the box in this frame", removeBox]]],
  ["Track", [["merge", "M", "Merge with the tracks selected by Ctrl+click", merge],
             ["split", "X", "Split: this frame and later ones become a new track", split],
             ["begin", "Q", "The track starts here: remove boxes before this frame", () => trim("before")],
             ["end", "E", "The track ends here: remove boxes after this frame", () => trim("after")]]],
];

export function openInspector() {
  const fields = document.getElementById("numbers");
  for (const [k, [name, unit]] of FIELDS.entries()) {
    const input = element("input", { id: `field-${name}`, type: "number", inputmode: "decimal",
      step: unit === "m" ? 0.05 : 1, oninput: () => { editedField = input; },
      onchange: () => saveNumber(k, input),
      onkeydown: ({ key }) => { if (key === "Escape") discardInput(); } });
    fields.append(element("label", {}, element("span", {}, name), input, element("i", {}, unit)));
  }
  // A click may select another track or frame, so save the input first.
  addEventListener("pointerdown", ({ target }) => {
    const focused = document.activeElement;
    if (fields.contains(focused) && target !== focused) focused.blur();
  }, { capture: true });
  const rows = document.getElementById("actions");
  for (const [title, buttons] of BUTTONS) {
    rows.append(element("div", { class: "buttons", role: "group", "aria-label": title },
      element("span", {}, title),
      ...buttons.map(([label, key, description, run]) => element("button", { title: `${description} (${key})`,
        onclick: run, "data-do": label }, label, element("kbd", {}, key)))));
  }
  const choice = document.getElementById("class");
  choice.onchange = async () => {
    await setTrackClass(choice.value);
    update(); // show the saved class if saving failed
  };
  document.getElementById("accept").onclick = () => decideTrack(toggleDecision("accepted", "accept"));
  document.getElementById("reject").onclick = () => decideTrack(toggleDecision("rejected", "reject"));
  on("drive", fillClasses);
  on("selection tracks draft drive", update);
  on("frame", discardInput); // the input belongs to the box in the previous frame
  on("selection tracks frame", loadSilhouettes);
}

const toggleDecision = (state, decision) => getSelectedTrack()?.state === state ? "reopen" : decision;

function fillClasses() {
  document.getElementById("class").replaceChildren(...store.drive.classes.map(({ name }, k) =>
    element("option", { value: name }, k < 9 ? `${k + 1}  ${name}` : name)));
}

/** Save one number of the box. The other numbers keep their full precision, which the fields do not show. */
async function saveNumber(k, input) {
  editedField = null;
  const box = getSelectedBox()?.box.slice(), value = input.valueAsNumber; // NaN if empty
  if (box && Number.isFinite(value) && (value > 0 || k < 3 || k === 6)) {
    box[k] = k === 6 ? value * Math.PI / 180 : value;
    setDraft(box); // so that the next input is applied to this box
    await commitDraft();
  }
  update();
}

function discardInput() {
  editedField = null;
  update();
}

function update() {
  const track = getSelectedTrack(), { selectedResult } = store;
  panel.hidden = !track && !selectedResult;
  if (panel.hidden) editedField = null;
  emptyHint.hidden = track !== null || store.mode === "view";
  document.getElementById("facts").replaceChildren(...(store.mode === "view" && (track || selectedResult)
    ? listFacts(track, selectedResult) : []).flatMap(([name, value]) =>
    [element("dt", {}, name), element("dd", {}, value)]));
  if (selectedResult) showResult(selectedResult);
  if (!track) return;
  document.getElementById("who").textContent = `Track ${track.id}`;
  const badge = document.getElementById("state");
  badge.textContent = store.mode === "view" ? track.class : track.state;
  badge.className = `badge ${track.state}`;
  document.getElementById("swatch").style.background = getClassColour(track.class);
  const choice = document.getElementById("class");
  if (![...choice.options].some(({ value }) => value === track.class)) {
    choice.append(element("option", { value: track.class }, track.class));
  }
  choice.value = track.class;
  const selectedBox = getSelectedBox();
  document.getElementById("kind").textContent = selectedBox === null ? "no box in this frame"
    : store.mode === "view" ? "" : KIND_TITLES[selectedBox.kind];
  document.getElementById("accept").setAttribute("aria-pressed", track.state === "accepted");
  document.getElementById("reject").setAttribute("aria-pressed", track.state === "rejected");
  updateNumbers(selectedBox?.box);
}

function updateNumbers(box) {
  for (const [k, [name]] of FIELDS.entries()) {
    const input = getField(name), value = box?.[k];
    input.disabled = !box || store.mode === "view";
    if (input === editedField) continue;
    input.value = value === undefined ? "" : k === 6 ? (value * 180 / Math.PI).toFixed(1) : value.toFixed(2);
  }
}

/** Show the selected label or detection. */
function showResult({ layer, row, error, colour }) {
  document.getElementById("who").textContent = row[7];
  const badge = document.getElementById("state");
  badge.textContent = error ?? (layer === "labels" ? "label" : "detection");
  badge.className = `badge ${error ? "rejected" : ""}`;
  document.getElementById("swatch").style.background = colour;
  document.getElementById("kind").textContent = "";
  updateNumbers(row);
}

/** List further facts about a track, label or detection, as [name, value]. */
function listFacts(track, selectedResult) {
  if (track) {
    return [["source", track.source], ["score", track.score.toFixed(2)],
            ["frames", `${track.byFrame.size}, from ${track.first} to ${track.last}`]];
  }
  const { layer, row } = selectedResult, facts = [];
  facts.push(["distance", `${Math.hypot(row[0], row[1]).toFixed(1)} m`]);
  if (layer === "labels") {
    if (row[8] !== null && row[8] !== undefined) facts.push(["track", `${row[8]}`]);
    return facts;
  }
  facts.unshift(["source", layer], ["score", row[8].toFixed(3)]);
  for (const [name, value] of Object.entries(row[9] ?? {})) facts.push([name, value.toFixed(3)]);
  const id = findTrackAt(row);
  if (id !== null) facts.push(["track", `${id}`]);
  return facts;
}

/** Find the nearest track with the class and position of a detection. Returns its id, or null. */
function findTrackAt(row) {
  let nearest = null, minDistance = Math.max(1, row[3] / 2);
  for (const track of store.tracks.values()) {
    const box = track.byFrame.get(store.frame)?.box;
    const distance = box && track.class === row[7] ? Math.hypot(box[0] - row[0], box[1] - row[1]) : Infinity;
    if (distance < minDistance) { minDistance = distance; nearest = track.id; }
  }
  return nearest;
}

let requestedKey = "", timer = 0;

function loadSilhouettes() {
  const track = getSelectedTrack(), area = document.getElementById("silhouettes");
  const isShown = track && store.seeds.length && getSelectedBox() && !store.playing;
  const key = isShown ? `${store.frame} ${track.id} ${getSelectedBox().box}` : "";
  if (key === requestedKey || store.mode === "view") return;
  requestedKey = key;
  clearTimeout(timer);
  if (!key) { area.hidden = true; return; }
  timer = setTimeout(async () => {
    let silhouettes = null;
    try {
      silhouettes = await getJson(`/api/silhouettes?frame=${store.frame}&track=${track.id}`);
    } catch { /* there is no seed, or the box has too few points */ }
    if (requestedKey !== key) return;
    area.hidden = silhouettes === null;
    if (silhouettes === null) return;
    drawSilhouette("seed", silhouettes.seed);
    drawSilhouette("candidate", silhouettes.candidate);
    document.getElementById("similarity").textContent = `${Math.round(100 * silhouettes.similarity)} %`;
  }, 120);
}

function drawSilhouette(name, { rows, cols, bits }) {
  const canvas = document.getElementById(`silhouette-${name}`), pen = canvas.getContext("2d");
  canvas.width = cols;
  canvas.height = rows;
  pen.fillStyle = getComputedStyle(canvas).color;
  for (let k = 0; k < bits.length; k++) {
    if (bits[k] === "1") pen.fillRect(k % cols, Math.floor(k / cols), 1, 1);
  }
}

