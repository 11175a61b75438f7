// The running graph: its newest frame is shown as it comes, at most ten a second; paused, the frames
// that are kept stay, and one steps through them.

import { getJson, tellServer } from "./api.js";
import { goTo } from "./cloud.js";
import { element } from "./dom.js";
import { forget } from "./results.js";
import { changed, on, store, takeTracks } from "./store.js";

const PERIOD_MS = 100;
const lines = document.getElementById("live-lines");

/** The frames as the server lists them, by their numbers. */
export function takeDrive(drive) {
  if (drive.live) {
    const frames = [];
    for (const frame of drive.frames) frames[frame.frame] = { ...frame, pose: null };
    drive.frames = frames;
    store.status = drive.status;
  }
  drive.first ??= 0;
  store.drive = drive;
}

const newest = () => store.drive.frames.length - 1;
let wake = () => null;

/** A frame that is to be shown, or one that was, with boxes that came late; or what is known of the
 * topics. */
export function hearLive({ live, status }) {
  if (status) {
    store.status = status;
    changed("status");
  }
  if (!live) return;
  const { drive } = store, { first, frame, tracks, ...rest } = live;
  drive.frames[frame] = { ...rest, pose: null };
  for (let k = drive.first; k < first; k++) delete drive.frames[k];
  drive.first = first;
  takeTracks(tracks, first);
  forget(frame);
  changed("tracks", "wanted");
  wake();
}

/** After the connection was lost, what there is now. */
export async function reopenLive() {
  takeDrive(await getJson("/api/drive"));
  changed("drive", "wanted", "status");
  wake();
}

export function pauseLive(yes) {
  store.playing = !yes;
  tellServer(yes ? "hold" : "go on");
  changed("playing");
  wake();
}

async function follow() {
  for (;;) {
    if (!store.playing || newest() < 0 || (newest() === store.frame && store.cloud)) {
      await new Promise((resolve) => { wake = resolve; });
      continue;
    }
    const due = performance.now() + PERIOD_MS;
    await goTo(newest());
    await new Promise((resolve) => setTimeout(resolve, Math.max(0, due - performance.now())));
  }
}

function showLines() {
  const found = store.status?.lines ?? [];
  lines.hidden = found.length === 0;
  lines.replaceChildren(...found.map((line) => element("span", {}, line)));
}

/** Of the clouds and of each topic of boxes: [title, value, what it means, what is wrong]. */
export function liveRows() {
  const { clouds = {}, topics = [] } = store.status ?? {};
  const rows = [["clouds a second", clouds.rate_hz ?? "–", clouds.topic ?? ""],
    ["lost · dropped", `${clouds.lost ?? 0} · ${clouds.dropped ?? 0}`,
     "Lost on the way; dropped, as newer ones had come"]];
  if (clouds.passed) rows.push(["passed over", `${clouds.passed}`, "Clouds that came while a page had paused"]);
  for (const { topic, kind, came, late, alone, ms } of topics) {
    const name = kind === "labels" ? "labels" : topic.replace(/^\/|\/output\/\w+$/g, "");
    const wrong = [late ? `${late} late` : null, alone ? `${alone} without a cloud` : null];
    rows.push([kind === "tracks" ? `${name}: tracks` : name,
      !came ? "none yet" : ms === null || kind === "labels" ? `${came}` : `${came} · ${ms} ms`,
      `${topic}: arrays, and how long behind their cloud. Late: after it was shown`,
      wrong.filter(Boolean).join(" · ")]);
  }
  return rows;
}

export function openLive() {
  document.documentElement.dataset.live = String(store.drive.live);
  if (!store.drive.live) return;
  store.playing = true;
  changed("playing", "status");
  on("status", showLines);
  showLines();
  follow();
}
