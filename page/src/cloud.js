// Clouds: read, kept, fetched ahead.

import { getBytes } from "./api.js";
import { commit } from "./edits.js";
import { sayError } from "./messages.js";
import { resultsOf } from "./results.js";
import { changed, store } from "./store.js";

const KEPT = 12; // clouds of 114,000 points take 2 MB each
const AHEAD = 3;
const PATIENCE_MS = 120; // for results, so that they come with their cloud
const EMPTY = { count: 0, xyz: new Float32Array(), intensity: new Uint8Array(),
                ground: new Uint8Array(), cluster: new Uint32Array(), floor: -1.7 };

const kept = new Map(); // frame -> promise of a cloud, the one used last at the end

/** A cloud as the server sends it: views of its bytes. */
export function parse(buffer) {
  const magic = String.fromCharCode(...new Uint8Array(buffer, 0, 4));
  if (magic !== "LPC1") throw new Error("the server sent something that is no cloud");
  const count = new DataView(buffer).getUint32(4, true);
  const cluster = 4 * Math.ceil((8 + 14 * count) / 4);
  if (buffer.byteLength < cluster + 4 * count) throw new Error("a cloud arrived cut");
  const cloud = {
    count,
    xyz: new Float32Array(buffer, 8, 3 * count),
    intensity: new Uint8Array(buffer, 8 + 12 * count, count),
    ground: new Uint8Array(buffer, 8 + 13 * count, count),
    cluster: new Uint32Array(buffer, cluster, count),
  };
  return { ...cloud, floor: floorOf(cloud) };
}

/** Median height of the ground near the sensor; of all low points where none is marked. */
function floorOf({ xyz, ground, count }) {
  const heights = [];
  for (let i = 0; i < count && heights.length < 2000; i++) {
    if (ground[i] && Math.hypot(xyz[3 * i], xyz[3 * i + 1]) < 25) heights.push(xyz[3 * i + 2]);
  }
  if (heights.length < 10) {
    for (let i = 0; i < Math.min(count, 2000); i++) heights.push(xyz[3 * i + 2]);
    heights.sort((a, b) => a - b);
    return heights[Math.floor(0.05 * heights.length)] ?? -1.7;
  }
  heights.sort((a, b) => a - b);
  return heights[heights.length >> 1];
}

export function cloudOf(frame) {
  let cloud = kept.get(frame);
  kept.delete(frame);
  if (!cloud) {
    cloud = getBytes(`/api/cloud/${frame}`).then(parse);
    cloud.catch(() => kept.delete(frame));
  }
  kept.set(frame, cloud);
  if (kept.size > KEPT) kept.delete(kept.keys().next().value);
  return cloud;
}

/** Show a frame as soon as its cloud is here; what was asked for last wins. */
export async function goTo(frame) {
  const last = store.drive.frames.length - 1;
  frame = Math.max(store.drive.first, Math.min(last, Math.round(frame)));
  if (frame === store.wanted && store.cloud) return;
  commit(); // what a held key has moved is of the frame that is left
  store.wanted = frame;
  changed("wanted");
  await show(frame);
}

export async function show(frame) {
  let cloud = EMPTY;
  try {
    if (frame >= 0) cloud = await cloudOf(frame); // -1: nothing has come yet
  } catch (error) {
    if (store.wanted === frame) {
      sayError(`Frame ${store.drive.frames[frame].name} has no cloud: ${error.message}`);
    }
  }
  if (store.mode === "view" && frame >= 0) {
    await Promise.race([resultsOf(frame).catch(() => null),
                        new Promise((resolve) => setTimeout(resolve, PATIENCE_MS))]);
  }
  if (store.wanted !== frame) return;
  commit(); // what a key has moved meanwhile
  store.frame = frame;
  store.cloud = cloud;
  store.draft = null;
  changed("frame", "cloud", "draft");
  ahead(frame);
}

let direction = 1, before = 0;

function ahead(frame) {
  if (store.playing && store.drive.live) return; // the next one has not come yet
  if (frame !== before) direction = Math.sign(frame - before);
  before = frame;
  const frames = store.drive.frames.length;
  const wished = [1, -1, 2, 3].slice(0, AHEAD + 1).map((k) => frame + k * direction);
  (async () => { // one after another, so that the nearest is not held up by those behind it
    for (const next of wished) {
      if (next < store.drive.first || next >= frames || store.wanted !== frame) continue;
      if (store.mode === "view") resultsOf(next).catch(() => null);
      try { await cloudOf(next); } catch { /* said when it is shown */ }
    }
  })();
}
