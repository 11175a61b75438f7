// Playback at 10 Hz, or slower if frames do not load fast enough.

import { loadCloud, goTo } from "./cloud.js";
import { pauseLive } from "./live.js";
import { notify, store } from "./store.js";

const PERIOD_MS = 100;

export async function togglePlay() {
  if (store.drive.live) {
    pauseLive(store.playing);
    return;
  }
  if (store.playing) {
    stop();
    return;
  }
  store.playing = true;
  notify("playing");
  const last = store.drive.frames.length - 1;
  if (store.frame >= last) await goTo(0);
  while (store.playing && store.frame < last) {
    const deadline = performance.now() + PERIOD_MS, next = store.frame + 1;
    await loadCloud(next).catch(() => null);
    await new Promise((resolve) => setTimeout(resolve, Math.max(0, deadline - performance.now())));
    if (!store.playing) return;
    await goTo(next);
    if (store.frame !== next) break;
  }
  stop();
}

function stop() {
  if (store.drive.live) {
    if (store.playing) pauseLive(true);
    return;
  }
  store.playing = false;
  notify("playing");
}

/** Stop playback and go to a frame. */
export function stopAndGoTo(frame) {
  stop();
  return goTo(frame);
}

export const stepFrames = (count) => stopAndGoTo(store.requestedFrame + count);
