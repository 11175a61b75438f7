// Edits of tracks. Each edit is one action. A box that is being moved is a draft until the pointer or key
// is released.

import { sendAction, fetchNextUncertain } from "./api.js";
import { moveAlongAxes, rotate } from "./boxmath.js";
import { loadCloud, goTo } from "./cloud.js";
import { showNote, showError } from "./messages.js";
import { getBox, notify, findClass, on, select, getSelectedBox, getSelectedTrack, store } from "./store.js";

const STEP_M = 0.05, ROTATION_STEP_RAD = Math.PI / 180; // for each press of an arrow key

const isEditable = () => store.mode === "label";

function requireSelection() {
  const track = getSelectedTrack();
  if (!track) showNote("Select a track first: click its box or its row in the list.");
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

/** Save the draft. If saving fails, the box moves back. */
export async function commitDraft() {
  const { draft } = store;
  if (!draft || draft.isSaving) return;
  draft.isSaving = true;
  await sendAction({ do: "box", track: draft.track, frame: draft.frame, box: draft.box });
  if (store.draft === draft) dropDraft();
}

on("leaving-frame", commitDraft); // the draft belongs to the frame that is being left

/** Move the selected box by one step along its own axes, or rotate it. It is saved when the key is released. */
export function nudge({ forward = 0, left = 0, up = 0, rotation = 0 }) {
  const box = getSelectedBox()?.box;
  if (!box) return;
  const movedBox = moveAlongAxes(box, forward * STEP_M, left * STEP_M, up * STEP_M);
  setDraft(rotate(movedBox, rotation * ROTATION_STEP_RAD));
}

async function sendTrackAction(action) {
  const track = isEditable() && requireSelection();
  return track ? sendAction({ ...action, track: track.id }) : false;
}

/** Accept, reject or reopen the selected track, and go to the next uncertain track if auto-advance is on.
 * If no track is selected, the decision applies to the track under the pointer.
 * decision: "accept", "reject" or "reopen". */
export async function decideTrack(decision) {
  if (!isEditable()) return;
  const hoveredTrack = getSelectedTrack() ? null : store.tracks.get(store.hover);
  const track = hoveredTrack ?? requireSelection();
  if (!track || !await sendAction({ do: decision, track: track.id })) return;
  if (!hoveredTrack && store.autoAdvance && decision !== "reopen") await selectNextUncertain();
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
    const next = await fetchNextUncertain(track, store.classFilter); // prefetch the cloud of the track after this one
    if (next.track !== null) loadCloud(next.frame).catch(() => null); // an error is reported when it is shown
  } catch (error) {
    showError(error.message);
  }
}

/** Set the class of the selected track. If another tool is active or no track is selected, set the class
 * of new tracks. */
export function setClass(name) {
  if (store.tool === "select" && getSelectedTrack()) return setTrackClass(name);
  store.newClass = name;
  if (store.tool === "select") showNote(`New boxes and seeds get the class ${name}.`);
  notify("tool");
  return null;
}

export const setTrackClass = (name) => sendTrackAction({ do: "class", class: name });

/** Reject all undecided tracks in the list (of the class that the list is filtered by) as one action. */
export async function rejectRest() {
  if (!isEditable()) return;
  const { classFilter } = store, count = countUndecided(classFilter);
  if (count === 0) showNote("There are no undecided tracks.");
  else if (await sendAction({ do: "reject_rest", ...(classFilter ? { class: classFilter } : {}) })) {
    showNote(`${count} tracks rejected. Press Ctrl+Z to undo.`);
  }
}

/** Count the undecided tracks of a class, or of all classes if it is null. */
export const countUndecided = (className) => [...store.tracks.values()].filter((track) =>
  track.state === "proposed" && (!className || track.class === className)).length;

export const getNewClass = () => store.newClass
  ?? (findClass("Pedestrian") ? "Pedestrian" : store.drive.classes[0]?.name ?? "Pedestrian");

export const snap = (to) => sendTrackAction({ do: "snap", frame: store.frame, to });
export const removeBox = () => sendTrackAction({ do: "remove_box", frame: store.frame });
/** Remove the boxes "before" or "after" this frame. */
export const trim = (side) => sendTrackAction({ do: "trim", frame: store.frame, side });
export const split = () => sendTrackAction({ do: "split", frame: store.frame });

/** Copy the box of the selected track in this frame to the next frame, and go to that frame. */
export async function copyToNextFrame() {
  const track = requireSelection(), from = store.frame;
  if (!track || from + 1 >= store.drive.frames.length) return;
  if (await sendAction({ do: "copy", track: track.id, from, to: from + 1 })) await goTo(from + 1);
}

/** Interpolate the box in this frame between the previous and the next key box. */
export async function interpolate() {
  const track = requireSelection();
  if (!track) return;
  const keyFrames = [...track.byFrame].filter(([, { kind }]) => kind === "key").map(([frame]) => frame);
  if (!keyFrames.some((frame) => frame < store.frame) || !keyFrames.some((frame) => frame > store.frame)) {
    showNote("Interpolation requires a key box before and after this frame.");
    return;
  }
  await sendAction({ do: "interpolate", track: track.id, frame: store.frame });
}

export async function merge() {
  const track = requireSelection();
  if (!track) return;
  if (store.alsoSelected.size === 0) {
    showNote("To merge, select a second track with Ctrl+click first.");
    return;
  }
  for (const otherId of [...store.alsoSelected]) {
    if (!await sendAction({ do: "merge", tracks: [track.id, otherId] })) return;
  }
  select(track.id);
}

export async function addSeed(xyz) {
  const oldIds = new Set(store.tracks.keys());
  if (!await sendAction({ do: "seed", frame: store.frame, xyz, class: getNewClass() })) return;
  selectNewTrack(oldIds);
}

export async function addBox([x, y]) {
  const name = getNewClass(), size = findClass(name)?.size ?? [1, 1, 1.7];
  const z = store.cloud.floor + size[2] / 2, oldIds = new Set(store.tracks.keys());
  const box = [x, y, z, ...size, 0];
  if (await sendAction({ do: "add", frame: store.frame, box, class: name })) selectNewTrack(oldIds);
}

function selectNewTrack(oldIds) {
  const newTracks = [...store.tracks.values()].filter((track) => !oldIds.has(track.id)
    && getBox(track)).sort((a, b) => (b.source === "click") - (a.source === "click") || a.id - b.id);
  if (newTracks.length) select(newTracks[0].id);
}

export async function toggleChecked() {
  const { frame } = store, checked = !store.checked.has(frame);
  if (!isEditable() || store.requestedFrame !== frame) return; // another frame is loading
  const isSaved = await sendAction({ do: "check", frame, checked });
  if (isSaved && checked && store.requestedFrame === frame) await goTo(frame + 1);
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
  else showNote(`No key box ${step > 0 ? "after" : "before"} this frame.`);
}
