// Playing at 10 Hz, as fast as the frames come if that is slower.

import { cloudOf, goTo } from "./cloud.js";
import { changed, store } from "./store.js";

const PERIOD_MS = 100;

export async function togglePlay() {
  if (store.playing) {
    stop();
    return;
  }
  store.playing = true;
  changed("playing");
  const last = store.drive.frames.length - 1;
  if (store.frame >= last) await goTo(0);
  while (store.playing && store.frame < last) {
    const due = performance.now() + PERIOD_MS, next = store.frame + 1;
    await cloudOf(next).catch(() => null);
    await new Promise((resolve) => setTimeout(resolve, Math.max(0, due - performance.now())));
    if (!store.playing) return;
    await goTo(next);
    if (store.frame !== next) break;
  }
  stop();
}

function stop() {
  store.playing = false;
  changed("playing");
}

export function step(by) {
  stop();
  return goTo(store.wanted + by);
}
