// Overlay of the 3D view: handles of the selected box, names of boxes.

import { computeAxis, intersectLevel, translate, moveFace, findNearestOnLine, toWorld, rotate } from "./boxmath.js";
import { getClassColour, listShownBoxes } from "./colours.js";
import { element, svg } from "./dom.js";
import { commitDraft, dropDraft, setDraft } from "./edits.js";
import { project, castRay } from "./picking.js";
import { listResultNames } from "./results.js";
import { afterDrawing, camera, controls } from "./scene.js";
import { on, getSelectedBox, getSelectedTrack, store } from "./store.js";

const layer = document.getElementById("handles");
const nameLayer = document.getElementById("names");
const FACES = [["+x", "front"], ["-x", "back"], ["+y", "left side"], ["-y", "right side"],
               ["+z", "top"], ["-z", "bottom"]];
const AXES = { x: 0, y: 1, z: 2 };

export const CLICK_RADIUS = 4; // pixels; a longer movement is a drag
const MIN_SIZE_PX = 34; // the handles would hide a smaller box
const ring = svg("path", { class: "ring" });
const grip = svg("path", { class: "ringgrip", "data-handle": "yaw" }, svg("title", {}, "Drag to turn"));
const stalk = svg("path", { class: "stalk" });
const knob = svg("circle", { class: "handle turn", r: 7, "data-handle": "yaw" },
  svg("title", {}, "Drag to turn"));
const faces = FACES.map(([name, faceName]) => svg("circle", { class: "handle face", r: 6,
  "data-handle": name }, svg("title", {}, `Drag to move only the ${faceName}`)));
layer.append(ring, grip, stalk, ...faces, knob);

const computeRingRadius = (box) => Math.hypot(box[3], box[4]) / 2 + 0.35;
const toPath = (points) => points.some((p) => !p) ? ""
  : `M${points.map((p) => p.map((v) => v.toFixed(1)).join(" ")).join("L")}`;

function placeHandle(handle, at) {
  handle.style.display = at ? "" : "none";
  if (at) {
    handle.setAttribute("cx", at[0].toFixed(1));
    handle.setAttribute("cy", at[1].toFixed(1));
  }
}

const getEditableBox = () => store.mode === "label" && store.tool === "select" ? getSelectedBox()?.box : null;

// Hide the handles immediately: a click may arrive before the next frame is drawn.
on("selection tool", () => { if (!getEditableBox()) layer.style.display = "none"; });

function placeHandles() {
  const box = getEditableBox();
  layer.style.display = box ? "" : "none";
  if (!box) return;
  for (const [k, [name]] of FACES.entries()) {
    const local = [0, 0, 0], axis = AXES[name[1]];
    local[axis] = (name[0] === "+" ? 0.5 : -0.5) * box[3 + axis];
    placeHandle(faces[k], project(...toWorld(box, ...local)));
  }
  const radius = computeRingRadius(box), low = -box[5] / 2, circle = [];
  for (let k = 0; k <= 40; k++) {
    const angle = k / 40 * 2 * Math.PI;
    circle.push(project(...toWorld(box, radius * Math.cos(angle), radius * Math.sin(angle), low)));
  }
  ring.setAttribute("d", toPath(circle));
  grip.setAttribute("d", toPath(circle));
  const end = project(...toWorld(box, radius, 0, low));
  stalk.setAttribute("d", toPath([project(...toWorld(box, box[3] / 2, 0, low)), end]));
  placeHandle(knob, end);
  const visible = circle.filter(Boolean), span = (k) => Math.max(...visible.map((p) => p[k]))
    - Math.min(...visible.map((p) => p[k]));
  layer.classList.toggle("small", visible.length === 0 || Math.max(span(0), span(1)) < 2 * MIN_SIZE_PX);
}

function placeNames() {
  const candidates = [];
  const withTracks = store.mode === "label" || store.layers.tracks;
  for (const { track, box } of withTracks ? listShownBoxes() : []) {
    const isSelected = track.id === store.selected;
    if (!store.showNames && !isSelected && track.id !== store.hover) continue;
    candidates.push({ box, isSelected, colour: getClassColour(track.class), state: track.state,
                      text: `${track.id} ${track.class}` });
  }
  if (store.showNames) candidates.push(...listResultNames());
  const shown = selectNames(candidates);
  while (nameLayer.children.length < shown.length) nameLayer.append(element("div", { class: "name" }));
  for (const [k, tag] of [...nameLayer.children].entries()) {
    const entry = shown[k];
    tag.style.display = entry ? "" : "none";
    if (!entry) continue;
    if (tag.textContent !== entry.text) tag.textContent = entry.text;
    tag.className = `name ${entry.state ?? ""}${entry.isSelected ? " selected" : ""}`;
    tag.style.setProperty("--shade", entry.colour);
    tag.style.transform = `translate(${entry.at[0].toFixed(0)}px, ${entry.at[1].toFixed(0)}px)`;
  }
}

/** Select names that do not overlap: the selected box first, then errors, then the nearest. */
function selectNames(candidates) {
  const rank = (entry) => (entry.isSelected ? 0 : entry.emphasized ? 1000 : 2000) + entry.distance;
  const shown = [];
  for (const entry of candidates) {
    entry.at = project(entry.box[0], entry.box[1], entry.box[2] + entry.box[5] / 2);
    entry.distance = camera.position.distanceTo({ x: entry.box[0], y: entry.box[1], z: entry.box[2] });
    entry.width = 6.4 * entry.text.length + 20;
  }
  for (const entry of candidates.filter(({ at }) => at).sort((a, b) => rank(a) - rank(b))) {
    const [x, y] = entry.at;
    if (shown.every(({ at, width }) => Math.abs(at[1] - y) > 15 || x > at[0] + width
      || at[0] > x + entry.width)) shown.push(entry);
  }
  return shown;
}
afterDrawing.push(placeHandles, placeNames);

/** Start a drag: call move(event) for each step, and commit the draft at the end. Escape, another
 * selection or another frame cancels it; a movement within CLICK_RADIUS does nothing. */
export function startDrag(target, event, move) {
  target.setPointerCapture(event.pointerId);
  controls.enabled = false;
  const { selected, frame } = store, { clientX, clientY } = event;
  let cancelled = false, moved = false;
  const step = (e) => {
    moved ||= Math.hypot(e.clientX - clientX, e.clientY - clientY) > CLICK_RADIUS;
    if (!cancelled && (store.selected !== selected || store.frame !== frame)) {
      cancelled = true;
      dropDraft();
    }
    if (!cancelled && moved) move(e);
  };
  const stop = (e) => {
    target.removeEventListener("pointermove", step);
    target.removeEventListener("pointerup", stop);
    target.removeEventListener("pointercancel", stop);
    removeEventListener("keydown", escape, true);
    controls.enabled = true;
    if (cancelled || e.type === "pointercancel") dropDraft();
    else commitDraft();
  };
  const escape = (e) => {
    if (e.key !== "Escape") return;
    e.stopPropagation();
    cancelled = true;
    dropDraft();
  };
  target.addEventListener("pointermove", step);
  target.addEventListener("pointerup", stop);
  target.addEventListener("pointercancel", stop);
  addEventListener("keydown", escape, true);
}

// Drag a face along its own axis, or the ring around the box.
layer.addEventListener("pointerdown", (event) => {
  const name = event.target.dataset?.handle, start = getSelectedBox()?.box;
  if (!name || !start || event.button !== 0) return;
  event.preventDefault();
  const from = castRay(event.clientX, event.clientY);
  if (name === "yaw") {
    const computeAngle = ({ origin, direction }) => {
      const at = intersectLevel(origin, direction, start[2] - start[5] / 2);
      return at && Math.atan2(at[1] - start[1], at[0] - start[0]);
    };
    const first = computeAngle(from);
    startDrag(event.target, event, (e) => {
      const current = computeAngle(castRay(e.clientX, e.clientY));
      if (first !== null && current !== null) setDraft(rotate(start, current - first));
    });
    return;
  }
  const axis = AXES[name[1]], sign = name[0] === "+" ? 1 : -1;
  const along = computeAxis(start, axis).map((v) => v * sign);
  const local = [0, 0, 0];
  local[axis] = sign * start[3 + axis] / 2;
  const centre = toWorld(start, ...local);
  const first = findNearestOnLine(centre, along, from.origin, from.direction);
  startDrag(event.target, event, (e) => {
    const { origin, direction } = castRay(e.clientX, e.clientY);
    const current = findNearestOnLine(centre, along, origin, direction);
    if (first !== null && current !== null) setDraft(moveFace(start, axis, sign, current - first));
  });
});

/** Drag the selected box horizontally, at the height of its centre. */
export function dragBody(target, event) {
  const start = getSelectedBox()?.box, from = castRay(event.clientX, event.clientY);
  const first = intersectLevel(from.origin, from.direction, start[2]);
  if (!getSelectedTrack() || !first) return false;
  startDrag(target, event, (e) => {
    const { origin, direction } = castRay(e.clientX, e.clientY);
    const current = intersectLevel(origin, direction, start[2]);
    if (current) setDraft(translate(start, current[0] - first[0], current[1] - first[1], 0));
  });
  return true;
}
