// The state of the page, and its events. Modules subscribe to the names of changes; no other module
// holds a copy of a track.

const listeners = new Map();
const pending = new Set();

export const store = {
  drive: null, mode: "label",
  seq: 0, tracks: new Map(), checked: new Set(), seeds: [], canUndo: false, canRedo: false,
  progress: null,
  wanted: 0, // the requested frame
  frame: 0, // the frame shown; every edit is in this one
  cloud: null, // of the frame shown
  selected: null, also: new Set(), hover: null, // of tracks, by id
  found: null, // the selected label or detection: {frame, layer, k, row, wrong}
  status: null, // of a running graph
  tool: "select", // "select", "seed", "add"
  draft: null, // {track, frame, box}, only during a drag or while a key is held
  colour: "height", names: true, online: true, playing: false, advance: true,
  filter: "left", only: null, shownTracks: [],
  results: { labels: [], detections: {}, matches: {} }, sources: new Map(), minScore: 0,
  layers: { labels: true, errors: true, tracks: true, trails: true },
};

/** Call a listener for changes and events of these names, separated by spaces. */
export function on(names, listener) {
  for (const name of names.split(" ")) {
    if (!listeners.has(name)) listeners.set(name, []);
    listeners.get(name).push(listener);
  }
}

/** Call the listeners of an event at once. */
export function emit(name, value) {
  for (const listener of listeners.get(name) ?? []) listener(value);
}

/** Report changes; each listener is called once per turn of the event loop, without arguments. */
export function changed(...names) {
  if (pending.size === 0) queueMicrotask(flush);
  for (const name of names) pending.add(name);
}

function flush() {
  const names = [...pending];
  pending.clear();
  const called = new Set();
  for (const name of names) {
    for (const listener of listeners.get(name) ?? []) {
      if (!called.has(listener)) {
        called.add(listener);
        listener();
      }
    }
  }
}

function toTrack(sent) {
  const byFrame = new Map();
  for (const row of sent.boxes) byFrame.set(row[0], { box: row.slice(1, 8), kind: row[8] });
  const frames = [...byFrame.keys()].sort((a, b) => a - b);
  return { ...sent, byFrame, first: frames[0] ?? 0, last: frames.at(-1) ?? 0 };
}

export function setState(state) {
  if (state.seq < store.seq) return; // an event has overtaken it
  store.tracks = new Map(state.tracks.map((track) => [track.id, toTrack(track)]));
  store.seeds = state.seeds ?? [];
  setCounts(state);
  forgetMissing();
  store.draft = null;
  changed("tracks", "progress", "selection", "draft");
}

/** Set the drive or graph; frames of a graph are stored by their numbers. */
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

/** Take a new frame of a running graph, or an old one with late boxes; then emit "live-frame". */
export function addLiveFrame({ first, frame, tracks, ...rest }) {
  const { drive } = store;
  drive.frames[frame] = { ...rest, pose: null };
  for (let k = drive.first; k < first; k++) delete drive.frames[k];
  drive.first = first;
  addTracks(tracks, first);
  emit("live-frame", frame);
  changed("tracks", "wanted");
}

/** Add the tracks of one frame of a running graph, and drop boxes before `first`. */
function addTracks(tracks, first) {
  for (const sent of tracks) {
    const track = store.tracks.get(sent.id);
    if (!track) {
      store.tracks.set(sent.id, toTrack(sent));
      continue;
    }
    for (const [frame, box] of toTrack(sent).byFrame) track.byFrame.set(frame, box);
    Object.assign(track.trails, sent.trails);
    track.class = sent.class;
    track.score = Math.max(track.score, sent.score);
    track.last = Math.max(...track.byFrame.keys());
  }
  for (const [id, track] of store.tracks) {
    if (track.first >= first) continue;
    for (const frame of track.byFrame.keys()) if (frame < first) track.byFrame.delete(frame);
    for (const frame of Object.keys(track.trails)) if (frame < first) delete track.trails[frame];
    track.first = Math.min(...track.byFrame.keys());
    if (track.byFrame.size === 0) store.tracks.delete(id);
  }
  forgetMissing();
}

/** Apply the event of an action of any page. */
export function applyEvent(event) {
  for (const track of event.tracks ?? []) store.tracks.set(track.id, toTrack(track));
  for (const id of event.removed ?? []) store.tracks.delete(id);
  if (event.seeds) store.seeds = event.seeds;
  setCounts(event);
  forgetMissing();
  changed("tracks", "progress", "selection");
}

function setCounts(from) {
  store.seq = from.seq ?? store.seq;
  store.checked = from.checked ? new Set(from.checked) : store.checked;
  store.canUndo = from.can_undo ?? store.canUndo;
  store.canRedo = from.can_redo ?? store.canRedo;
  store.progress = from.progress ?? store.progress;
}

function forgetMissing() {
  if (store.selected !== null && !store.tracks.has(store.selected)) store.selected = null;
  for (const id of store.also) if (!store.tracks.has(id)) store.also.delete(id);
}

export function select(id, { more = false } = {}) {
  if (more && store.selected !== null && id !== null && id !== store.selected) {
    if (!store.also.delete(id)) store.also.add(id);
  } else {
    store.selected = id;
    store.also.clear();
  }
  store.found = null;
  changed("selection");
}

/** Select a label or a detection of the frame shown. */
export function selectFound(found) {
  select(null);
  store.found = found;
}

export function selectedTrack() {
  return store.selected === null ? null : store.tracks.get(store.selected) ?? null;
}

/** The box of a track in the frame shown, or its draft: {box, kind} or null. */
export function boxOf(track, frame = store.frame) {
  const { draft } = store;
  if (draft && track && draft.track === track.id && draft.frame === frame) {
    return { box: draft.box, kind: "key" };
  }
  return track?.byFrame.get(frame) ?? null;
}

export function selectedBox() {
  const { found } = store;
  if (found?.frame === store.frame) return { box: found.row.slice(0, 7), kind: "found" };
  return boxOf(selectedTrack());
}

export function classOf(name) {
  return store.drive?.classes.find((entry) => entry.name === name) ?? null;
}
