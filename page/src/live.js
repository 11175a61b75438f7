// A running graph: its newest frame is shown, at most ten times a second; while paused, the stored
// frames can be stepped through.

import { sendToServer } from "./api.js";
import { goTo } from "./cloud.js";
import { element } from "./dom.js";
import { changed, on, store } from "./store.js";

const PERIOD_MS = 100;
const lines = document.getElementById("live-lines");

const newest = () => store.drive.frames.length - 1;
let wake = () => null;

export function pauseLive(paused) {
  store.playing = !paused;
  sendToServer(paused ? "hold" : "go on");
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

/** Statistics of the clouds and of each topic with boxes: [title, value, tooltip, problem]. */
export function liveRows() {
  const { clouds = {}, topics = [] } = store.status ?? {};
  const rows = [["clouds per second", clouds.rate_hz ?? "–", clouds.topic ?? ""],
    ["lost · dropped", `${clouds.lost ?? 0} · ${clouds.dropped ?? 0}`,
     "Lost in transport; dropped because newer clouds were waiting"]];
  if (clouds.passed) rows.push(["skipped", `${clouds.passed}`, "Clouds that arrived while a page was paused"]);
  for (const { topic, kind, came, late, alone, ms } of topics) {
    const name = kind === "labels" ? "labels" : topic.replace(/^\/|\/output\/\w+$/g, "");
    const problems = [late ? `${late} late` : null, alone ? `${alone} without a cloud` : null];
    rows.push([kind === "tracks" ? `${name}: tracks` : name,
      !came ? "none yet" : ms === null || kind === "labels" ? `${came}` : `${came} · ${ms} ms`,
      `${topic}: number of arrays, and their delay behind the cloud. Late: after it was shown`,
      problems.filter(Boolean).join(" · ")]);
  }
  return rows;
}

export function openLive() {
  document.documentElement.dataset.live = String(store.drive.live);
  if (!store.drive.live) return;
  store.playing = true;
  changed("playing", "status");
  on("status", showLines);
  on("live-frame drive", () => wake());
  showLines();
  follow();
}
