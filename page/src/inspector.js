// The selected track: class, numbers, actions, silhouettes.

import { getJson } from "./api.js";
import { colourOfClass } from "./colours.js";
import { element } from "./dom.js";
import { commit, copyOn, decide, interpolate, merge, removeBox, setDraft, setTrackClass, snap, split,
         trim } from "./edits.js";
import { on, selectedBox, selectedTrack, store } from "./store.js";

const FIELDS = [["x", "m"], ["y", "m"], ["z", "m"], ["length", "m"], ["width", "m"],
                ["height", "m"], ["yaw", "°"]];
const KINDS = { key: "set by hand", proposed: "proposed", interpolated: "interpolated" };
const panel = document.getElementById("inspector");
const nothing = document.getElementById("nothing-selected");
const number = (name) => document.getElementById(`field-${name}`);
let typed = null; // the field with unsaved input

const BUTTONS = [
  ["Snap", [["cluster", "C", "Snap to the L-shape of its cluster", () => snap("cluster")],
            ["ground", "G", "Snap to the ground", () => snap("ground")],
            ["size", "T", "Snap to the size of the track", () => snap("size")]]],
  ["Box", [["copy", "V", "Copy to the next frame, and go there", copyOn],
           ["interpolate", "I", "Interpolate between the boxes set by hand before and after", interpolate],
           ["remove", "Del", "Remove the box of this frame", removeBox]]],
  ["Track", [["merge", "M", "Merge with the tracks selected by Ctrl+click", merge],
             ["split", "X", "Split: this frame and later ones become a new track", split],
             ["begin", "Q", "The track starts here: remove boxes before this frame", () => trim("before")],
             ["end", "E", "The track ends here: remove boxes after this frame", () => trim("after")]]],
];

export function openInspector() {
  const fields = document.getElementById("numbers");
  for (const [k, [name, unit]] of FIELDS.entries()) {
    const input = element("input", { id: `field-${name}`, type: "number", inputmode: "decimal",
      step: unit === "m" ? 0.05 : 1, oninput: () => { typed = input; },
      onchange: () => saveNumber(k, input),
      onkeydown: ({ key }) => { if (key === "Escape") discardInput(); } });
    fields.append(element("label", {}, element("span", {}, name), input, element("i", {}, unit)));
  }
  // A click may select another track or frame, so save the input first.
  addEventListener("pointerdown", ({ target }) => {
    const typing = document.activeElement;
    if (fields.contains(typing) && target !== typing) typing.blur();
  }, { capture: true });
  const rows = document.getElementById("actions");
  for (const [title, buttons] of BUTTONS) {
    rows.append(element("div", { class: "buttons", role: "group", "aria-label": title },
      element("span", {}, title),
      ...buttons.map(([label, key, what, run]) => element("button", { title: `${what} (${key})`,
        onclick: run, "data-do": label }, label, element("kbd", {}, key)))));
  }
  const choice = document.getElementById("class");
  choice.onchange = async () => {
    await setTrackClass(choice.value);
    fill(); // show the saved class if saving failed
  };
  document.getElementById("accept").onclick = () => decide(pressed("accepted", "accept"));
  document.getElementById("reject").onclick = () => decide(pressed("rejected", "reject"));
  on("drive", fillClasses);
  on("selection tracks draft drive", fill);
  on("frame", discardInput); // it belongs to the box of the previous frame
  on("selection tracks frame", loadSilhouettes);
}

const pressed = (state, verb) => selectedTrack()?.state === state ? "reopen" : verb;

function fillClasses() {
  document.getElementById("class").replaceChildren(...store.drive.classes.map(({ name }, k) =>
    element("option", { value: name }, k < 9 ? `${k + 1}  ${name}` : name)));
}

/** Save one number of the box; the others keep the digits that the fields do not show. */
async function saveNumber(k, input) {
  typed = null;
  const box = selectedBox()?.box.slice(), value = input.valueAsNumber; // NaN if empty
  if (box && Number.isFinite(value) && (value > 0 || k < 3 || k === 6)) {
    box[k] = k === 6 ? value * Math.PI / 180 : value;
    setDraft(box); // so that the next number is added to this one
    await commit();
  }
  fill();
}

function discardInput() {
  typed = null;
  fill();
}

function fill() {
  const track = selectedTrack(), { found } = store;
  panel.hidden = !track && !found;
  if (panel.hidden) typed = null;
  nothing.hidden = track !== null || store.mode === "view";
  document.getElementById("facts").replaceChildren(...(store.mode === "view" && (track || found)
    ? factsOf(track, found) : []).flatMap(([name, value]) =>
    [element("dt", {}, name), element("dd", {}, value)]));
  if (found) fillFound(found);
  if (!track) return;
  document.getElementById("who").textContent = `Track ${track.id}`;
  const badge = document.getElementById("state");
  badge.textContent = store.mode === "view" ? track.class : track.state;
  badge.className = `badge ${track.state}`;
  document.getElementById("swatch").style.background = colourOfClass(track.class);
  const choice = document.getElementById("class");
  if (![...choice.options].some(({ value }) => value === track.class)) {
    choice.append(element("option", { value: track.class }, track.class));
  }
  choice.value = track.class;
  const here = selectedBox();
  document.getElementById("kind").textContent = here === null ? "no box in this frame"
    : store.mode === "view" ? "" : KINDS[here.kind];
  document.getElementById("accept").setAttribute("aria-pressed", track.state === "accepted");
  document.getElementById("reject").setAttribute("aria-pressed", track.state === "rejected");
  fillNumbers(here?.box);
}

function fillNumbers(box) {
  for (const [k, [name]] of FIELDS.entries()) {
    const input = number(name), value = box?.[k];
    input.disabled = !box || store.mode === "view";
    if (input === typed) continue;
    input.value = value === undefined ? "" : k === 6 ? (value * 180 / Math.PI).toFixed(1) : value.toFixed(2);
  }
}

/** Show a selected label or detection. */
function fillFound({ layer, row, wrong, colour }) {
  document.getElementById("who").textContent = row[7];
  const badge = document.getElementById("state");
  badge.textContent = wrong ?? (layer === "labels" ? "label" : "detection");
  badge.className = `badge ${wrong ? "rejected" : ""}`;
  document.getElementById("swatch").style.background = colour;
  document.getElementById("kind").textContent = "";
  fillNumbers(row);
}

/** Further facts about a track, label or detection: [name, value]. */
function factsOf(track, found) {
  if (track) {
    return [["source", track.source], ["score", track.score.toFixed(2)],
            ["frames", `${track.byFrame.size}, from ${track.first} to ${track.last}`]];
  }
  const { layer, row } = found, facts = [];
  facts.push(["distance", `${Math.hypot(row[0], row[1]).toFixed(1)} m`]);
  if (layer === "labels") {
    if (row[8] !== null && row[8] !== undefined) facts.push(["track", `${row[8]}`]);
    return facts;
  }
  facts.unshift(["source", layer], ["score", row[8].toFixed(3)]);
  for (const [name, said] of Object.entries(row[9] ?? {})) facts.push([name, said.toFixed(3)]);
  const id = trackAt(row);
  if (id !== null) facts.push(["track", `${id}`]);
  return facts;
}

/** The id of the track of the same class at a detection, or null. */
function trackAt(row) {
  let best = null, least = Math.max(1, row[3] / 2);
  for (const track of store.tracks.values()) {
    const box = track.byFrame.get(store.frame)?.box;
    const away = box && track.class === row[7] ? Math.hypot(box[0] - row[0], box[1] - row[1]) : Infinity;
    if (away < least) { least = away; best = track.id; }
  }
  return best;
}

let requested = "", waiting = 0;

function loadSilhouettes() {
  const track = selectedTrack(), area = document.getElementById("silhouettes");
  const key = track && store.seeds.length && selectedBox() && !store.playing ? `${store.frame} ${track.id} ${selectedBox().box}` : "";
  if (key === requested || store.mode === "view") return;
  requested = key;
  clearTimeout(waiting);
  if (!key) { area.hidden = true; return; }
  waiting = setTimeout(async () => {
    let found = null;
    try {
      found = await getJson(`/api/silhouettes?frame=${store.frame}&track=${track.id}`);
    } catch { /* no seed yet, or nothing to compare */ }
    if (requested !== key) return;
    area.hidden = found === null;
    if (found === null) return;
    drawSilhouette("seed", found.seed);
    drawSilhouette("candidate", found.candidate);
    document.getElementById("similarity").textContent = `${Math.round(100 * found.similarity)} %`;
  }, 120);
}

function drawSilhouette(name, { rows, cols, bits }) {
  const canvas = document.getElementById(`silhouette-${name}`), pen = canvas.getContext("2d");
  canvas.width = cols;
  canvas.height = rows;
  pen.fillStyle = getComputedStyle(canvas).color;
  for (let k = 0; k < bits.length; k++) if (bits[k] === "1") pen.fillRect(k % cols, Math.floor(k / cols), 1, 1);
}

