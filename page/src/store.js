// State of the page, and its events. Modules subscribe to changes by name; no other module stores a copy
// of a track.

const listeners = new Map();
const pendingNames = new Set();

export const store = {
  drive: null, mode: "label",
  seq: 0, tracks: new Map(), checked: new Set(), seeds: [], canUndo: false, canRedo: false,
  progress: null,
  requestedFrame: 0, // will be shown when its cloud is loaded
  frame: 0, // the shown frame, to which all edits apply
  cloud: null, // cloud of the shown frame
  selected: null, alsoSelected: new Set(), hover: null, // track ids
  selectedResult: null, // selected label or detection: {frame, layer, k, row, error}
  status: null, // status of a running graph
  tool: "select", // "select", "seed", "add"
  draft: null, // unsaved box {track, frame, box} during a drag or while a key is held
  colour: "height", showNames: true, online: true, playing: false, autoAdvance: true,
  stateFilter: "left", classFilter: null, shownTracks: [],
  results: { labels: [], detections: {}, matches: {} }, sources: new Map(), minScore: 0,
  layers: { labels: true, errors: true, tracks: true, trails: true },
};

/** Register a listener for changes and events with these names, separated by spaces. */
export function on(names, listener) {
  for (const name of names.split(" ")) {
    if (!listeners.has(name)) listeners.set(name, []);
    listeners.get(name).push(listener);
  }
}

/** Call the listeners of an event immediately. */
export function emit(name, value) {
  for (const listener of listeners.get(name) ?? []) listener(value);
}

/** Report changes. Each listener is called once per turn of the event loop, without arguments. */
export function notify(...names) {
  if (pendingNames.size === 0) queueMicrotask(callListeners);
  for (const name of names) pendingNames.add(name);
}

function callListeners() {
  const names = [...pendingNames];
  pendingNames.clear();
  for (const listener of new Set(names.flatMap((name) => listeners.get(name) ?? []))) listener();
}

function toTrack(update) {
  const byFrame = new Map();
  for (const row of update.boxes) byFrame.set(row[0], { box: row.slice(1, 8), kind: row[8] });
  const frames = [...byFrame.keys()].sort((a, b) => a - b);
  return { ...update, byFrame, first: frames[0] ?? 0, last: frames.at(-1) ?? 0 };
}

export function setState(state) {
  if (state.seq < store.seq) return; // a later event has already been applied
  store.tracks = new Map(state.tracks.map((track) => [track.id, toTrack(track)]));
  store.seeds = state.seeds ?? [];
  setProgress(state);
  deselectMissingTracks();
  store.draft = null;
  notify("tracks", "progress", "selection", "draft");
}

/** Set the drive or graph. The frames of a graph are stored by frame number. */
export function setDrive(drive) {
  if (drive.live) {
    const frames = [];
    for (const frame of drive.frames) frames[frame.frame] = { ...frame, pose: null };
    drive.frames = frames;
    store.status = drive.status;
  }
  drive.first ??= 0;
  store.drive = drive;
}

/** Add a new frame of a running graph, or late boxes of an existing frame; then emit "live-frame". */
export function addLiveFrame({ first, frame, tracks, ...rest }) {
  const { drive } = store;
  drive.frames[frame] = { ...rest, pose: null };
  for (let k = drive.first; k < first; k++) delete drive.frames[k];
  drive.first = first;
  addTracks(tracks, first);
  emit("live-frame", frame);
  notify("tracks", "requested-frame");
}

/** Add the tracks of one frame of a running graph, and drop all boxes before frame `first`. */
function addTracks(tracks, first) {
  for (const update of tracks) {
    const track = store.tracks.get(update.id);
    if (!track) {
      store.tracks.set(update.id, toTrack(update));
      continue;
    }
    for (const [frame, box] of toTrack(update).byFrame) track.byFrame.set(frame, box);
    Object.assign(track.trails, update.trails);
    track.class = update.class;
    track.score = Math.max(track.score, update.score);
    track.last = Math.max(...track.byFrame.keys());
  }
  for (const [id, track] of store.tracks) {
    if (track.first >= first) continue;
    for (const frame of track.byFrame.keys()) if (frame < first) track.byFrame.delete(frame);
    for (const frame of Object.keys(track.trails)) if (frame < first) delete track.trails[frame];
    track.first = Math.min(...track.byFrame.keys());
    if (track.byFrame.size === 0) store.tracks.delete(id);
  }
  deselectMissingTracks();
}

/** Apply the event of an action that any page has sent. */
export function applyEvent(event) {
  for (const track of event.tracks ?? []) store.tracks.set(track.id, toTrack(track));
  for (const id of event.removed ?? []) store.tracks.delete(id);
  if (event.seeds) store.seeds = event.seeds;
  setProgress(event);
  deselectMissingTracks();
  notify("tracks", "progress", "selection");
}

function setProgress(state) {
  store.seq = state.seq ?? store.seq;
  store.checked = state.checked ? new Set(state.checked) : store.checked;
  store.canUndo = state.can_undo ?? store.canUndo;
  store.canRedo = state.can_redo ?? store.canRedo;
  store.progress = state.progress ?? store.progress;
}

function deselectMissingTracks() {
  if (store.selected !== null && !store.tracks.has(store.selected)) store.selected = null;
  for (const id of store.alsoSelected) if (!store.tracks.has(id)) store.alsoSelected.delete(id);
}

/** Select a track, or null for none. extend: keep the selected track, and toggle this one in addition. */
export function select(id, { extend = false } = {}) {
  if (extend && store.selected !== null && id !== null && id !== store.selected) {
    if (!store.alsoSelected.delete(id)) store.alsoSelected.add(id);
  } else {
    store.selected = id;
    store.alsoSelected.clear();
  }
  store.selectedResult = null;
  notify("selection");
}

/** Select a label or detection in the shown frame. */
export function selectResult(result) {
  select(null);
  store.selectedResult = result;
}

export function getSelectedTrack() {
  return store.selected === null ? null : store.tracks.get(store.selected) ?? null;
}

/** Return the box of a track in a frame, or its draft, as {box, kind}; null if there is none. */
export function getBox(track, frame = store.frame) {
  const { draft } = store;
  if (draft && track && draft.track === track.id && draft.frame === frame) {
    return { box: draft.box, kind: "key" };
  }
  return track?.byFrame.get(frame) ?? null;
}

export function getSelectedBox() {
  const { selectedResult } = store;
  if (selectedResult?.frame === store.frame) return { box: selectedResult.row.slice(0, 7), kind: "result" };
  return getBox(getSelectedTrack());
}

export function findClass(name) {
  return store.drive?.classes.find((entry) => entry.name === name) ?? null;
}
