// Overlay of the 3D view: handles of the selected box, names of boxes.

import { axisOf, meetLevel, moveBy, moveFace, nearestOnLine, toWorld, turnBy } from "./boxmath.js";
import { colourOfClass, shownBoxes } from "./colours.js";
import { element, svg } from "./dom.js";
import { commit, dropDraft, setDraft } from "./edits.js";
import { project, rayAt } from "./picking.js";
import { resultNames } from "./results.js";
import { afterDrawing, camera, controls } from "./scene.js";
import { on, selectedBox, selectedTrack, store } from "./store.js";

const layer = document.getElementById("handles");
const names = document.getElementById("names");
const FACES = [["+x", "front"], ["-x", "back"], ["+y", "left side"], ["-y", "right side"],
               ["+z", "top"], ["-z", "bottom"]];
const AXES = { x: 0, y: 1, z: 2 };

export const CLICK_RADIUS = 4; // pixels; a longer movement is a drag
const SMALL = 34; // pixels; the handles would hide a smaller box
const ring = svg("path", { class: "ring" });
const grip = svg("path", { class: "ringgrip", "data-handle": "yaw" }, svg("title", {}, "Drag to turn"));
const stalk = svg("path", { class: "stalk" });
const knob = svg("circle", { class: "handle turn", r: 7, "data-handle": "yaw" },
  svg("title", {}, "Drag to turn"));
const faces = FACES.map(([name, what]) => svg("circle", { class: "handle face", r: 6,
  "data-handle": name }, svg("title", {}, `Drag to move only the ${what}`)));
layer.append(ring, grip, stalk, ...faces, knob);

const away = (box) => Math.hypot(box[3], box[4]) / 2 + 0.35;
const path = (places) => places.some((p) => !p) ? "" : `M${places.map((p) => p.map((v) => v.toFixed(1)).join(" ")).join("L")}`;

function place(handle, at) {
  handle.style.display = at ? "" : "none";
  if (at) {
    handle.setAttribute("cx", at[0].toFixed(1));
    handle.setAttribute("cy", at[1].toFixed(1));
  }
}

const handled = () => store.mode === "label" && store.tool === "select" ? selectedBox()?.box : null;

// Immediately, as a click may come before the next frame is drawn.
on("selection tool", () => { if (!handled()) layer.style.display = "none"; });

function placeHandles() {
  const box = handled();
  layer.style.display = box ? "" : "none";
  if (!box) return;
  for (const [k, [name]] of FACES.entries()) {
    const local = [0, 0, 0], axis = AXES[name[1]];
    local[axis] = (name[0] === "+" ? 0.5 : -0.5) * box[3 + axis];
    place(faces[k], project(...toWorld(box, ...local)));
  }
  const radius = away(box), low = -box[5] / 2, round = [];
  for (let k = 0; k <= 40; k++) {
    const angle = k / 40 * 2 * Math.PI;
    round.push(project(...toWorld(box, radius * Math.cos(angle), radius * Math.sin(angle), low)));
  }
  ring.setAttribute("d", path(round));
  grip.setAttribute("d", path(round));
  const end = project(...toWorld(box, radius, 0, low));
  stalk.setAttribute("d", path([project(...toWorld(box, box[3] / 2, 0, low)), end]));
  place(knob, end);
  const seen = round.filter(Boolean), span = (k) => Math.max(...seen.map((p) => p[k]))
    - Math.min(...seen.map((p) => p[k]));
  layer.classList.toggle("small", seen.length === 0 || Math.max(span(0), span(1)) < 2 * SMALL);
}

function placeNames() {
  const wanted = [];
  const withTracks = store.mode === "label" || store.layers.tracks;
  for (const { track, box } of withTracks ? shownBoxes() : []) {
    const chosen = track.id === store.selected;
    if (!store.names && !chosen && track.id !== store.hover) continue;
    wanted.push({ box, chosen, colour: colourOfClass(track.class), state: track.state,
                  text: `${track.id} ${track.class}` });
  }
  if (store.names) wanted.push(...resultNames());
  const shown = selectNames(wanted);
  while (names.children.length < shown.length) names.append(element("div", { class: "name" }));
  for (const [k, tag] of [...names.children].entries()) {
    const entry = shown[k];
    tag.style.display = entry ? "" : "none";
    if (!entry) continue;
    if (tag.textContent !== entry.text) tag.textContent = entry.text;
    tag.className = `name ${entry.state ?? ""}${entry.chosen ? " chosen" : ""}`;
    tag.style.setProperty("--shade", entry.colour);
    tag.style.transform = `translate(${entry.at[0].toFixed(0)}px, ${entry.at[1].toFixed(0)}px)`;
  }
}

/** Select names that do not overlap: the selected box first, then errors, then the nearest. */
function selectNames(wanted) {
  const rank = (entry) => (entry.chosen ? 0 : entry.loud ? 1000 : 2000) + entry.far;
  const shown = [];
  for (const entry of wanted) {
    entry.at = project(entry.box[0], entry.box[1], entry.box[2] + entry.box[5] / 2);
    entry.far = camera.position.distanceTo({ x: entry.box[0], y: entry.box[1], z: entry.box[2] });
    entry.wide = 6.4 * entry.text.length + 20;
  }
  for (const entry of wanted.filter(({ at }) => at).sort((a, b) => rank(a) - rank(b))) {
    const [x, y] = entry.at;
    if (shown.every(({ at, wide }) => Math.abs(at[1] - y) > 15 || x > at[0] + wide
      || at[0] > x + entry.wide)) shown.push(entry);
  }
  return shown;
}
afterDrawing.push(placeHandles, placeNames);

/** Start a drag: call move(event) for each step and commit at the end. Escape, another selection or
 * another frame cancels it, and a movement within CLICK_RADIUS does nothing. */
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
    else commit();
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
  const name = event.target.dataset?.handle, start = selectedBox()?.box;
  if (!name || !start || event.button !== 0) return;
  event.preventDefault();
  const from = rayAt(event.clientX, event.clientY);
  if (name === "yaw") {
    const angleOf = ({ origin, direction }) => {
      const at = meetLevel(origin, direction, start[2] - start[5] / 2);
      return at && Math.atan2(at[1] - start[1], at[0] - start[0]);
    };
    const first = angleOf(from);
    startDrag(event.target, event, (e) => {
      const now = angleOf(rayAt(e.clientX, e.clientY));
      if (first !== null && now !== null) setDraft(turnBy(start, now - first));
    });
    return;
  }
  const axis = AXES[name[1]], sign = name[0] === "+" ? 1 : -1;
  const along = axisOf(start, axis).map((v) => v * sign);
  const local = [0, 0, 0];
  local[axis] = sign * start[3 + axis] / 2;
  const centre = toWorld(start, ...local);
  const first = nearestOnLine(centre, along, from.origin, from.direction);
  startDrag(event.target, event, (e) => {
    const { origin, direction } = rayAt(e.clientX, e.clientY);
    const now = nearestOnLine(centre, along, origin, direction);
    if (first !== null && now !== null) setDraft(moveFace(start, axis, sign, now - first));
  });
});

/** Drag the selected box horizontally, at the height of its centre. */
export function dragBody(target, event) {
  const start = selectedBox()?.box, from = rayAt(event.clientX, event.clientY);
  const first = meetLevel(from.origin, from.direction, start[2]);
  if (!selectedTrack() || !first) return false;
  startDrag(target, event, (e) => {
    const { origin, direction } = rayAt(e.clientX, e.clientY);
    const now = meetLevel(origin, direction, start[2]);
    if (now) setDraft(moveBy(start, now[0] - first[0], now[1] - first[1], 0));
  });
  return true;
}
