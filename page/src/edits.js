// Edits of tracks; each becomes one action. A box that is dragged, or moved by a held key, is a draft
// until it is released.

import { act, nextUncertain } from "./api.js";
import { moveAlong, turnBy } from "./boxmath.js";
import { cloudOf, goTo } from "./cloud.js";
import { say, sayError } from "./messages.js";
import { boxOf, changed, classOf, on, select, selectedBox, selectedTrack, store } from "./store.js";

const STEP = 0.05, TURN = Math.PI / 180; // of one arrow key: metres, radians

const editable = () => store.mode === "label";

function chosen() {
  const track = selectedTrack();
  if (!track) say("Select a track first: click its box, or its row in the list.");
  return track;
}

export function setDraft(box) {
  const track = selectedTrack();
  if (!track || !editable()) return;
  store.draft = { track: track.id, frame: store.frame, box };
  changed("draft");
}

export function dropDraft() {
  if (!store.draft) return;
  store.draft = null;
  changed("draft");
}

/** Save the draft. If that fails, the box moves back. */
export async function commit() {
  const { draft } = store;
  if (!draft || draft.sent) return;
  draft.sent = true;
  await act({ do: "box", track: draft.track, frame: draft.frame, box: draft.box });
  if (store.draft === draft) dropDraft();
}

on("leaving-frame", commit); // the draft belongs to the frame that is left

/** Move the selected box a step along its own axes, or turn it; commit() on key up. */
export function nudge({ forward = 0, left = 0, up = 0, turn = 0 }) {
  const box = selectedBox()?.box;
  if (box) setDraft(turnBy(moveAlong(box, forward * STEP, left * STEP, up * STEP), turn * TURN));
}

async function onTrack(action) {
  const track = editable() && chosen();
  return track ? act({ ...action, track: track.id }) : false;
}

/** "accept", "reject" or "reopen" the selected track and go to the next uncertain one, unless the
 * user has disabled that; without a selection, decide on the track under the pointer. */
export async function decide(verb) {
  if (!editable()) return;
  const pointed = selectedTrack() ? null : store.tracks.get(store.hover);
  const track = pointed ?? chosen();
  if (!track || !await act({ do: verb, track: track.id })) return;
  if (!pointed && store.advance && verb !== "reopen") await next();
}

export async function next() {
  try {
    const { track, frame } = await nextUncertain(store.selected, store.only);
    if (track === null) {
      say("All tracks are decided.");
      return;
    }
    if (!store.tracks.get(track)?.byFrame.has(store.frame)) await goTo(frame);
    select(track);
    changed("focus");
    const then = await nextUncertain(track, store.only); // prefetch
    if (then.track !== null) cloudOf(then.frame).catch(() => null); // reported when it is shown
  } catch (error) {
    sayError(error.message);
  }
}

/** Set the class of the selected track; with another tool or without a selection, the class of new
 * tracks. */
export function setClass(name) {
  if (store.tool === "select" && selectedTrack()) return setTrackClass(name);
  store.newClass = name;
  if (store.tool === "select") say(`New boxes and seeds get the class ${name}.`);
  changed("tool");
  return null;
}

export const setTrackClass = (name) => onTrack({ do: "class", class: name });

/** Reject all undecided tracks of the listed class, or of all classes, as one action. */
export async function rejectRest() {
  if (!editable()) return;
  const { only } = store, count = leftIn(only);
  if (count === 0) say("There are no undecided tracks.");
  else if (await act({ do: "reject_rest", ...(only ? { class: only } : {}) })) {
    say(`${count} tracks rejected. Ctrl+Z undoes it.`);
  }
}

/** Number of undecided tracks of a class, null for all. */
export const leftIn = (only) => [...store.tracks.values()].filter((track) =>
  track.state === "proposed" && (!only || track.class === only)).length;

export const classToAdd = () => store.newClass
  ?? (classOf("Pedestrian") ? "Pedestrian" : store.drive.classes[0]?.name ?? "Pedestrian");

export const snap = (to) => onTrack({ do: "snap", frame: store.frame, to });
export const removeBox = () => onTrack({ do: "remove_box", frame: store.frame });
/** Remove the boxes "before" or "after" this frame. */
export const trim = (side) => onTrack({ do: "trim", frame: store.frame, side });
export const split = () => onTrack({ do: "split", frame: store.frame });

/** Copy this frame's box of the selected track to the next frame, and go there. */
export async function copyOn() {
  const track = chosen(), from = store.frame;
  if (!track || from + 1 >= store.drive.frames.length) return;
  if (await act({ do: "copy", track: track.id, from, to: from + 1 })) await goTo(from + 1);
}

/** Interpolate this frame's box between the key boxes before and after it. */
export async function interpolate() {
  const track = chosen();
  if (!track) return;
  const frames = [...track.byFrame].filter(([frame, { kind }]) => kind === "key"
    && frame !== store.frame).map(([frame]) => frame);
  const before = Math.max(...frames.filter((frame) => frame < store.frame));
  const after = Math.min(...frames.filter((frame) => frame > store.frame));
  if (!Number.isFinite(before) || !Number.isFinite(after)) {
    say("Interpolation needs a box set by hand before this frame and one after it.");
    return;
  }
  await act({ do: "interpolate", track: track.id, frame: store.frame });
}

export async function merge() {
  const track = chosen();
  if (!track) return;
  if (store.also.size === 0) {
    say("Select a second track with Ctrl+click, then merge.");
    return;
  }
  for (const other of [...store.also]) {
    if (!await act({ do: "merge", tracks: [track.id, other] })) return;
  }
  select(track.id);
}

export async function seedAt(xyz) {
  const before = new Set(store.tracks.keys());
  if (!await act({ do: "seed", frame: store.frame, xyz, class: classToAdd() })) return;
  selectNew(before);
}

export async function addAt([x, y]) {
  const name = classToAdd(), size = classOf(name)?.size ?? [1, 1, 1.7];
  const z = store.cloud.floor + size[2] / 2, before = new Set(store.tracks.keys());
  const box = [x, y, z, ...size, 0];
  if (await act({ do: "add", frame: store.frame, box, class: name })) selectNew(before);
}

function selectNew(before) {
  const added = [...store.tracks.values()].filter((track) => !before.has(track.id)
    && boxOf(track)).sort((a, b) => (b.source === "click") - (a.source === "click") || a.id - b.id);
  if (added.length) select(added[0].id);
}

export async function checkFrame() {
  const { frame } = store, now = !store.checked.has(frame);
  if (!editable() || store.wanted !== frame) return; // another frame is loading: do not toggle twice
  const done = await act({ do: "check", frame, checked: now });
  if (done && now && store.wanted === frame) await goTo(frame + 1);
}

export const undo = () => editable() && (store.canUndo ? act({ do: "undo" }) : say("Nothing to undo."));
export const redo = () => editable() && (store.canRedo ? act({ do: "redo" }) : say("Nothing to redo."));
export const propose = () => act({ do: "propose" });

/** Go to the next (1) or previous (-1) frame in which the selected track has a key box. */
export function toKey(step) {
  const track = selectedTrack();
  if (!track) return;
  const frames = [...track.byFrame].filter(([, { kind }]) => kind === "key").map(([frame]) => frame);
  const onwards = frames.filter((frame) => (frame - store.frame) * step > 0);
  if (onwards.length) goTo(step > 0 ? Math.min(...onwards) : Math.max(...onwards));
  else say(`No box set by hand ${step > 0 ? "after" : "before"} this frame.`);
}
