// Edits of tracks; each becomes one action. A box that is being dragged, or moved by keys, is a draft
// until the pointer or key is released.

import { sendAction, fetchNextUncertain } from "./api.js";
import { moveAlongAxes, rotate } from "./boxmath.js";
import { loadCloud, goTo } from "./cloud.js";
import { showNote, showError } from "./messages.js";
import { getBox, notify, findClass, on, select, getSelectedBox, getSelectedTrack, store } from "./store.js";

const STEP_M = 0.05, TURN_RAD = Math.PI / 180; // per press of an arrow key

const isEditable = () => store.mode === "label";

function requireSelection() {
  const track = getSelectedTrack();
  if (!track) showNote("Select a track first: click its box, or its row in the list.");
  return track;
}

export function setDraft(box) {
  const track = getSelectedTrack();
  if (!track || !isEditable()) return;
  store.draft = { track: track.id, frame: store.frame, box };
  notify("draft");
}

export function dropDraft() {
  if (!store.draft) return;
  store.draft = null;
  notify("draft");
}

/** Save the draft. If that fails, the box moves back. */
export async function commitDraft() {
  const { draft } = store;
  if (!draft || draft.sent) return;
  draft.sent = true;
  await sendAction({ do: "box", track: draft.track, frame: draft.frame, box: draft.box });
  if (store.draft === draft) dropDraft();
}

on("leaving-frame", commitDraft); // the draft belongs to the frame that is left

/** Move the selected box a step along its own axes, or turn it; commitDraft() runs on key up. */
export function nudge({ forward = 0, left = 0, up = 0, turn = 0 }) {
  const box = getSelectedBox()?.box;
  if (!box) return;
  const moved = moveAlongAxes(box, forward * STEP_M, left * STEP_M, up * STEP_M);
  setDraft(rotate(moved, turn * TURN_RAD));
}

async function actOnTrack(action) {
  const track = isEditable() && requireSelection();
  return track ? sendAction({ ...action, track: track.id }) : false;
}

/** Apply a verb ("accept", "reject", "reopen") to the selected track, and go to the next uncertain one
 * unless the user has disabled that. Without a selection, it applies to the track under the pointer. */
export async function decideTrack(verb) {
  if (!isEditable()) return;
  const hovered = getSelectedTrack() ? null : store.tracks.get(store.hover);
  const track = hovered ?? requireSelection();
  if (!track || !await sendAction({ do: verb, track: track.id })) return;
  if (!hovered && store.autoAdvance && verb !== "reopen") await selectNextUncertain();
}

export async function selectNextUncertain() {
  try {
    const { track, frame } = await fetchNextUncertain(store.selected, store.classFilter);
    if (track === null) {
      showNote("All tracks are decided.");
      return;
    }
    if (!store.tracks.get(track)?.byFrame.has(store.frame)) await goTo(frame);
    select(track);
    notify("focus");
    const following = await fetchNextUncertain(track, store.classFilter); // prefetch
    if (following.track !== null) loadCloud(following.frame).catch(() => null); // reported when it is shown
  } catch (error) {
    showError(error.message);
  }
}

/** Set the class of the selected track; with another tool or without a selection, the class of new
 * tracks. */
export function setClass(name) {
  if (store.tool === "select" && getSelectedTrack()) return setTrackClass(name);
  store.newClass = name;
  if (store.tool === "select") showNote(`New boxes and seeds get the class ${name}.`);
  notify("tool");
  return null;
}

export const setTrackClass = (name) => actOnTrack({ do: "class", class: name });

/** Reject all undecided tracks of the listed class, or of all classes, as one action. */
export async function rejectRest() {
  if (!isEditable()) return;
  const { classFilter } = store, count = countUndecided(classFilter);
  if (count === 0) showNote("There are no undecided tracks.");
  else if (await sendAction({ do: "reject_rest", ...(classFilter ? { class: classFilter } : {}) })) {
    showNote(`${count} tracks rejected. Ctrl+Z undoes it.`);
  }
}

/** Count the undecided tracks of a class; null for all classes. */
export const countUndecided = (className) => [...store.tracks.values()].filter((track) =>
  track.state === "proposed" && (!className || track.class === className)).length;

export const getNewClass = () => store.newClass
  ?? (findClass("Pedestrian") ? "Pedestrian" : store.drive.classes[0]?.name ?? "Pedestrian");

export const snap = (to) => actOnTrack({ do: "snap", frame: store.frame, to });
export const removeBox = () => actOnTrack({ do: "remove_box", frame: store.frame });
/** Remove the boxes "before" or "after" this frame. */
export const trim = (side) => actOnTrack({ do: "trim", frame: store.frame, side });
export const split = () => actOnTrack({ do: "split", frame: store.frame });

/** Copy this frame's box of the selected track to the next frame, and go there. */
export async function copyToNextFrame() {
  const track = requireSelection(), from = store.frame;
  if (!track || from + 1 >= store.drive.frames.length) return;
  if (await sendAction({ do: "copy", track: track.id, from, to: from + 1 })) await goTo(from + 1);
}

/** Interpolate this frame's box between the key boxes before and after it. */
export async function interpolate() {
  const track = requireSelection();
  if (!track) return;
  const frames = [...track.byFrame].filter(([frame, { kind }]) => kind === "key"
    && frame !== store.frame).map(([frame]) => frame);
  const before = Math.max(...frames.filter((frame) => frame < store.frame));
  const after = Math.min(...frames.filter((frame) => frame > store.frame));
  if (!Number.isFinite(before) || !Number.isFinite(after)) {
    showNote("Interpolation needs a box set by hand before this frame and one after it.");
    return;
  }
  await sendAction({ do: "interpolate", track: track.id, frame: store.frame });
}

export async function merge() {
  const track = requireSelection();
  if (!track) return;
  if (store.alsoSelected.size === 0) {
    showNote("Select a second track with Ctrl+click, then merge.");
    return;
  }
  for (const other of [...store.alsoSelected]) {
    if (!await sendAction({ do: "merge", tracks: [track.id, other] })) return;
  }
  select(track.id);
}

export async function seedAt(xyz) {
  const before = new Set(store.tracks.keys());
  if (!await sendAction({ do: "seed", frame: store.frame, xyz, class: getNewClass() })) return;
  selectAddedTrack(before);
}

export async function addAt([x, y]) {
  const name = getNewClass(), size = findClass(name)?.size ?? [1, 1, 1.7];
  const z = store.cloud.floor + size[2] / 2, before = new Set(store.tracks.keys());
  const box = [x, y, z, ...size, 0];
  if (await sendAction({ do: "add", frame: store.frame, box, class: name })) selectAddedTrack(before);
}

function selectAddedTrack(before) {
  const added = [...store.tracks.values()].filter((track) => !before.has(track.id)
    && getBox(track)).sort((a, b) => (b.source === "click") - (a.source === "click") || a.id - b.id);
  if (added.length) select(added[0].id);
}

export async function toggleChecked() {
  const { frame } = store, checked = !store.checked.has(frame);
  if (!isEditable() || store.requestedFrame !== frame) return; // another frame is loading
  const saved = await sendAction({ do: "check", frame, checked });
  if (saved && checked && store.requestedFrame === frame) await goTo(frame + 1);
}

export const undo = () => isEditable()
  && (store.canUndo ? sendAction({ do: "undo" }) : showNote("Nothing to undo."));
export const redo = () => isEditable()
  && (store.canRedo ? sendAction({ do: "redo" }) : showNote("Nothing to redo."));
export const propose = () => sendAction({ do: "propose" });

/** Go to the next (1) or previous (-1) frame in which the selected track has a key box. */
export function goToKeyBox(step) {
  const track = getSelectedTrack();
  if (!track) return;
  const frames = [...track.byFrame].filter(([, { kind }]) => kind === "key").map(([frame]) => frame);
  const candidates = frames.filter((frame) => (frame - store.frame) * step > 0);
  if (candidates.length) goTo(step > 0 ? Math.min(...candidates) : Math.max(...candidates));
  else showNote(`No box set by hand ${step > 0 ? "after" : "before"} this frame.`);
}
