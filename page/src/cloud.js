// Clouds: loading, caching, prefetching; and moving to another frame.

import { makeCache, getBytes } from "./api.js";
import { showError } from "./messages.js";
import { fetchResults } from "./results.js";
import { notify, emit, store } from "./store.js";

const MAX_CACHED = 12; // clouds of 114,000 points take 2 MB each
const PREFETCH_OFFSETS = [1, -1, 2, 3]; // frames, relative to the one shown, in the direction of travel
const MAX_WAIT_MS = 120; // for results, so that they appear with their cloud
const EMPTY = { count: 0, xyz: new Float32Array(), intensity: new Uint8Array(),
                ground: new Uint8Array(), cluster: new Uint32Array(), floor: -1.7 };

const clouds = makeCache(async (frame) => parseCloud(await getBytes(`/api/cloud/${frame}`)), MAX_CACHED);
export const loadCloud = clouds.get;

/** Make a cloud from the bytes of /api/cloud, without copying. */
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

/** Return the median height of the ground near the sensor, or a low percentile of all points if there
 * is no ground. */
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

/** Show a frame once its cloud is loaded; the last request wins. Emits "leaving-frame" first. */
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
    if (frame >= 0) cloud = await loadCloud(frame); // -1: nothing received yet
  } catch (error) {
    if (store.requestedFrame === frame) {
      showError(`Frame ${store.drive.frames[frame].name} has no cloud: ${error.message}`);
    }
  }
  if (store.mode === "view" && frame >= 0) {
    await Promise.race([fetchResults(frame).catch(() => null),
                        new Promise((resolve) => setTimeout(resolve, MAX_WAIT_MS))]);
  }
  if (store.requestedFrame !== frame) return;
  emit("leaving-frame"); // a key may have moved a box meanwhile
  store.frame = frame;
  store.cloud = cloud;
  store.draft = null;
  notify("frame", "cloud", "draft");
  prefetch(frame);
}

let direction = 1, previous = 0;

/** Load the clouds around a frame, one after another so that the nearest arrives first. */
async function prefetch(frame) {
  if (store.playing && store.drive.live) return; // the next frame does not exist yet
  if (frame !== previous) direction = Math.sign(frame - previous);
  previous = frame;
  const frames = store.drive.frames.length;
  for (const next of PREFETCH_OFFSETS.map((k) => frame + k * direction)) {
    if (next < store.drive.first || next >= frames || store.requestedFrame !== frame) continue;
    if (store.mode === "view") fetchResults(next).catch(() => null);
    try { await loadCloud(next); } catch { /* reported when it is shown */ }
  }
}
