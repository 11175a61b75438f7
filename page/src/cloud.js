// Loading, caching and prefetching of clouds, and navigation between frames.

import { makeCache, getBytes } from "./api.js";
import { showError } from "./messages.js";
import { fetchResults } from "./results.js";
import { notify, emit, store } from "./store.js";

const MAX_CACHED_CLOUDS = 12; // a cloud of 114,000 points takes 2 MB
const PREFETCH_OFFSETS = [1, -1, 2, 3]; // frames relative to the shown one; positive in the direction of navigation
const MAX_WAIT_MS = 120; // maximum time a cloud waits for its results, so that both appear together
const EMPTY = { count: 0, xyz: new Float32Array(), intensity: new Uint8Array(),
                ground: new Uint8Array(), cluster: new Uint32Array(), floor: -1.7 };

const clouds = makeCache(async (frame) => parseCloud(await getBytes(`/api/cloud/${frame}`)), MAX_CACHED_CLOUDS);
export const loadCloud = clouds.get;

/** Make a cloud from the bytes of /api/cloud, without copying them. */
function parseCloud(buffer) {
  const magic = String.fromCharCode(...new Uint8Array(buffer, 0, 4));
  if (magic !== "LPC1") throw new Error("the server sent an invalid cloud");
  const count = new DataView(buffer).getUint32(4, true);
  const cluster = 4 * Math.ceil((8 + 14 * count) / 4);
  if (buffer.byteLength < cluster + 4 * count) throw new Error("the cloud is incomplete");
  const cloud = {
    count,
    xyz: new Float32Array(buffer, 8, 3 * count),
    intensity: new Uint8Array(buffer, 8 + 12 * count, count),
    ground: new Uint8Array(buffer, 8 + 13 * count, count),
    cluster: new Uint32Array(buffer, cluster, count),
  };
  return { ...cloud, floor: estimateFloor(cloud) };
}

/** Return the median height of the ground points near the sensor. If there are too few, return a low
 * percentile of the heights of all points. */
function estimateFloor({ xyz, ground, count }) {
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

/** Show a frame when its cloud is loaded, unless another frame is requested first. Emits "leaving-frame". */
export async function goTo(frame) {
  const last = store.drive.frames.length - 1;
  frame = Math.max(store.drive.first, Math.min(last, Math.round(frame)));
  if (frame === store.requestedFrame && store.cloud) return;
  emit("leaving-frame");
  store.requestedFrame = frame;
  notify("requested-frame");
  await showFrame(frame);
}

export async function showFrame(frame) {
  let cloud = EMPTY;
  try {
    if (frame >= 0) cloud = await loadCloud(frame); // -1: no cloud received yet
  } catch (error) {
    if (store.requestedFrame === frame) {
      showError(`Cannot load the cloud of frame ${store.drive.frames[frame].name}: ${error.message}`);
    }
  }
  if (store.mode === "view" && frame >= 0) {
    await Promise.race([fetchResults(frame).catch(() => null),
                        new Promise((resolve) => setTimeout(resolve, MAX_WAIT_MS))]);
  }
  if (store.requestedFrame !== frame) return;
  emit("leaving-frame"); // a key may have moved a box while the cloud was loading
  store.frame = frame;
  store.cloud = cloud;
  store.draft = null;
  notify("frame", "cloud", "draft");
  prefetch(frame);
}

let direction = 1, previousFrame = 0;

/** Load the clouds around a frame one after another, so that the nearest ones arrive first. */
async function prefetch(frame) {
  if (store.playing && store.drive.live) return; // the next frame does not exist yet
  if (frame !== previousFrame) direction = Math.sign(frame - previousFrame);
  previousFrame = frame;
  const end = store.drive.frames.length;
  for (const next of PREFETCH_OFFSETS.map((k) => frame + k * direction)) {
    if (next < store.drive.first || next >= end || store.requestedFrame !== frame) continue;
    if (store.mode === "view") fetchResults(next).catch(() => null);
    try { await loadCloud(next); } catch { /* the error is reported when this frame is shown */ }
  }
}
