// Overlay of the 3D view with the handles of the selected box and the names of boxes.

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

export const CLICK_RADIUS_PX = 4; // a longer movement of the pointer is a drag
const MIN_SIZE_PX = 34; // smaller boxes get no handles, which would hide them
const ring = svg("path", { class: "ring" });
const grip = svg("path", { class: "ringgrip", "data-handle": "yaw" }, svg("title", {}, "Drag to rotate"));
const stalk = svg("path", { class: "stalk" });
const knob = svg("circle", { class: "handle turn", r: 7, "data-handle": "yaw" },
  svg("title", {}, "Drag to rotate"));
const faces = FACES.map(([name, faceName]) => svg("circle", { class: "handle face", r: 6,
  "data-handle": name }, svg("title", {}, `Drag to move the ${faceName}`)));
layer.append(ring, grip, stalk, ...faces, knob);

const computeRingRadius = (box) => Math.hypot(box[3], box[4]) / 2 + 0.35;
const toPath = (points) => points.some((p) => !p) ? ""
  : `M${points.map((p) => p.map((v) => v.toFixed(1)).join(" ")).join("L")}`;

function placeHandle(handle, position) {
  handle.style.display = position ? "" : "none";
  if (position) {
    handle.setAttribute("cx", position[0].toFixed(1));
    handle.setAttribute("cy", position[1].toFixed(1));
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
  const showsTracks = store.mode === "label" || store.layers.tracks;
  for (const { track, box } of showsTracks ? listShownBoxes() : []) {
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

/** Select names that do not overlap. The selected box has priority, then errors, then near boxes. */
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

/** Start a drag: call move(event) for each step, and commit the draft at the end. The drag is cancelled by
 * Escape, or if the selection or the frame changes. A movement within CLICK_RADIUS_PX has no effect. */
export function startDrag(target, event, move) {
  target.setPointerCapture(event.pointerId);
  controls.enabled = false;
  const { selected, frame } = store, { clientX, clientY } = event;
  let isCancelled = false, hasMoved = false;
  const step = (e) => {
    hasMoved ||= Math.hypot(e.clientX - clientX, e.clientY - clientY) > CLICK_RADIUS_PX;
    if (!isCancelled && (store.selected !== selected || store.frame !== frame)) {
      isCancelled = true;
      dropDraft();
    }
    if (!isCancelled && hasMoved) move(e);
  };
  const stop = (e) => {
    target.removeEventListener("pointermove", step);
    target.removeEventListener("pointerup", stop);
    target.removeEventListener("pointercancel", stop);
    removeEventListener("keydown", escape, true);
    controls.enabled = true;
    if (isCancelled || e.type === "pointercancel") dropDraft();
    else commitDraft();
  };
  const escape = (e) => {
    if (e.key !== "Escape") return;
    e.stopPropagation();
    isCancelled = true;
    dropDraft();
  };
  target.addEventListener("pointermove", step);
  target.addEventListener("pointerup", stop);
  target.addEventListener("pointercancel", stop);
  addEventListener("keydown", escape, true);
}

// Drag a face of the box along its normal, or rotate the box by dragging the ring around it.
layer.addEventListener("pointerdown", (event) => {
  const name = event.target.dataset?.handle, start = getSelectedBox()?.box;
  if (!name || !start || event.button !== 0) return;
  event.preventDefault();
  const startRay = castRay(event.clientX, event.clientY);
  if (name === "yaw") {
    const computeAngle = ({ origin, direction }) => {
      const point = intersectLevel(origin, direction, start[2] - start[5] / 2);
      return point && Math.atan2(point[1] - start[1], point[0] - start[0]);
    };
    const startAngle = computeAngle(startRay);
    startDrag(event.target, event, (e) => {
      const angle = computeAngle(castRay(e.clientX, e.clientY));
      if (startAngle !== null && angle !== null) setDraft(rotate(start, angle - startAngle));
    });
    return;
  }
  const axis = AXES[name[1]], sign = name[0] === "+" ? 1 : -1;
  const normal = computeAxis(start, axis).map((v) => v * sign);
  const local = [0, 0, 0];
  local[axis] = sign * start[3 + axis] / 2;
  const centre = toWorld(start, ...local);
  const startOffset = findNearestOnLine(centre, normal, startRay.origin, startRay.direction);
  startDrag(event.target, event, (e) => {
    const { origin, direction } = castRay(e.clientX, e.clientY);
    const offset = findNearestOnLine(centre, normal, origin, direction);
    if (startOffset !== null && offset !== null) setDraft(moveFace(start, axis, sign, offset - startOffset));
  });
});

/** Drag the selected box horizontally, at the height of its centre. */
export function dragBody(target, event) {
  const start = getSelectedBox()?.box, startRay = castRay(event.clientX, event.clientY);
  const startPoint = intersectLevel(startRay.origin, startRay.direction, start[2]);
  if (!getSelectedTrack() || !startPoint) return false;
  startDrag(target, event, (e) => {
    const { origin, direction } = castRay(e.clientX, e.clientY);
    const point = intersectLevel(origin, direction, start[2]);
    if (point) setDraft(translate(start, point[0] - startPoint[0], point[1] - startPoint[1], 0));
  });
  return true;
}
