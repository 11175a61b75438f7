// The selected track: its class, its numbers, what can be done to it, the silhouettes.

import { getJson } from "./api.js";
import { colourOfClass } from "./colours.js";
import { element } from "./dom.js";
import { copyOn, decide, interpolate, merge, removeBox, setClass, setNumbers, snap, split }
  from "./edits.js";
import { on, selectedBox, selectedTrack, store } from "./store.js";

const FIELDS = [["x", "m"], ["y", "m"], ["z", "m"], ["length", "m"], ["width", "m"],
                ["height", "m"], ["yaw", "°"]];
const panel = document.getElementById("inspector");
const nothing = document.getElementById("nothing-selected");
const number = (name) => document.getElementById(`field-${name}`);

const BUTTONS = [
  ["Snap", [["cluster", "C", "To the L-shape of its cluster", () => snap("cluster")],
            ["ground", "G", "Down to the ground", () => snap("ground")],
            ["size", "T", "To the size of the track", () => snap("size")]]],
  ["Box", [["copy", "V", "Copy to the next frame, and go there", copyOn],
           ["interpolate", "I", "Between the boxes set by hand before and after", interpolate],
           ["remove", "Del", "Remove the box of this frame", removeBox]]],
  ["Track", [["merge", "M", "Merge with the tracks selected by Ctrl and a click", merge],
             ["split", "X", "This frame and those after it become a new track", split]]],
];

export function openInspector() {
  const fields = document.getElementById("numbers");
  for (const [name, unit] of FIELDS) {
    const input = element("input", { id: `field-${name}`, type: "number", inputmode: "decimal",
      step: unit === "m" ? 0.05 : 1, onchange: takeNumbers });
    fields.append(element("label", {}, element("span", {}, name), input, element("i", {}, unit)));
  }
  const rows = document.getElementById("actions");
  for (const [title, buttons] of BUTTONS) {
    rows.append(element("div", { class: "buttons", role: "group", "aria-label": title },
      element("span", {}, title),
      ...buttons.map(([label, key, what, run]) => element("button", { title: `${what} (${key})`,
        onclick: run, "data-do": label }, label, element("kbd", {}, key)))));
  }
  const choice = document.getElementById("class");
  choice.onchange = () => setClass(choice.value);
  document.getElementById("accept").onclick = () => decide(pressed("accepted", "accept"));
  document.getElementById("reject").onclick = () => decide(pressed("rejected", "reject"));
  on("drive", fillClasses);
  on("selection tracks draft frame drive", fill);
  on("selection tracks frame", askSilhouettes);
}

const pressed = (state, verb) => selectedTrack()?.state === state ? "reopen" : verb;

function fillClasses() {
  document.getElementById("class").replaceChildren(...store.drive.classes.map(({ name }, k) =>
    element("option", { value: name }, k < 9 ? `${k + 1}  ${name}` : name)));
}

function takeNumbers() {
  const box = selectedBox()?.box;
  if (!box) return;
  const values = FIELDS.map(([name]) => Number(number(name).value));
  values[6] *= Math.PI / 180;
  const good = values.every(Number.isFinite) && values.slice(3, 6).every((size) => size > 0);
  if (good) setNumbers(values);
  else fill({ all: true });
}

function fill({ all = false } = {}) {
  const track = selectedTrack();
  panel.hidden = !track;
  nothing.hidden = track !== null || store.mode === "view";
  if (!track) return;
  document.getElementById("who").textContent = `Track ${track.id}`;
  const badge = document.getElementById("state");
  badge.textContent = track.state;
  badge.className = `badge ${track.state}`;
  document.getElementById("swatch").style.background = colourOfClass(track.class);
  const choice = document.getElementById("class");
  if (![...choice.options].some(({ value }) => value === track.class)) {
    choice.append(element("option", { value: track.class }, track.class));
  }
  choice.value = track.class;
  const here = selectedBox();
  document.getElementById("kind").textContent = here === null ? "no box in this frame"
    : { key: "set by hand", proposed: "proposed", interpolated: "interpolated" }[here.kind];
  document.getElementById("accept").setAttribute("aria-pressed", track.state === "accepted");
  document.getElementById("reject").setAttribute("aria-pressed", track.state === "rejected");
  for (const [k, [name]] of FIELDS.entries()) {
    const input = number(name), value = here?.box[k];
    input.disabled = !here || store.mode === "view";
    if (document.activeElement === input && !store.draft && !all) continue; // being typed
    input.value = value === undefined ? "" : k === 6 ? (value * 180 / Math.PI).toFixed(1) : value.toFixed(2);
  }
}

let asked = "", waiting = 0;

function askSilhouettes() {
  const track = selectedTrack(), area = document.getElementById("silhouettes");
  const key = track && store.seeds.length && selectedBox() && !store.playing ? `${store.frame} ${track.id} ${selectedBox().box}` : "";
  if (key === asked || store.mode === "view") return;
  asked = key;
  clearTimeout(waiting);
  if (!key) { area.hidden = true; return; }
  waiting = setTimeout(async () => {
    let found = null;
    try {
      found = await getJson(`/api/silhouettes?frame=${store.frame}&track=${track.id}`);
    } catch { /* no seed yet, or nothing to compare: there is nothing to show */ }
    if (asked !== key) return;
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

