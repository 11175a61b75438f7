// View of a running graph. It shows the newest frame, at most ten times per second. While it is paused,
// the user can step through the stored frames.

import { sendCommand } from "./api.js";
import { goTo } from "./cloud.js";
import { element } from "./dom.js";
import { notify, on, store } from "./store.js";

const PERIOD_MS = 100;
const warnings = document.getElementById("live-lines");

const getNewestFrame = () => store.drive.frames.length - 1;
let wake = () => null;

export function pauseLive(paused) {
  store.playing = !paused;
  sendCommand(paused ? "pause" : "resume");
  notify("playing");
  wake();
}

async function followNewest() {
  for (;;) {
    if (!store.playing || getNewestFrame() < 0 || (getNewestFrame() === store.frame && store.cloud)) {
      await new Promise((resolve) => { wake = resolve; });
      continue;
    }
    const deadline = performance.now() + PERIOD_MS;
    await goTo(getNewestFrame());
    await new Promise((resolve) => setTimeout(resolve, Math.max(0, deadline - performance.now())));
  }
}

function showWarnings() {
  const lines = store.status?.lines ?? [];
  warnings.hidden = lines.length === 0;
  warnings.replaceChildren(...lines.map((line) => element("span", {}, line)));
}

/** List the statistics of the clouds and of each topic with boxes, as [title, value, tooltip, problem]. */
export function listReceptionRows() {
  const { clouds = {}, topics = [] } = store.status ?? {};
  const rows = [["clouds per second", clouds.rate_hz ?? "–", clouds.topic ?? ""],
    ["lost · dropped", `${clouds.lost ?? 0} · ${clouds.dropped ?? 0}`,
     "Clouds lost in transport, and clouds dropped because newer ones were waiting"]];
  if (clouds.skipped) rows.push(["skipped", `${clouds.skipped}`, "Clouds that arrived while a page was paused"]);
  for (const { topic, kind, received, late, unmatched, ms } of topics) {
    const name = kind === "labels" ? "labels" : topic.replace(/^\/|\/output\/\w+$/g, "");
    const problems = [late ? `${late} late` : null, unmatched ? `${unmatched} without a cloud` : null];
    rows.push([kind === "tracks" ? `${name}: tracks` : name,
      !received ? "none yet" : ms === null || kind === "labels" ? `${received}` : `${received} · ${ms} ms`,
      `${topic}: number of arrays and median delay after the cloud. Late arrays arrive after the cloud is shown`,
      problems.filter(Boolean).join(" · ")]);
  }
  return rows;
}

export function openLive() {
  document.documentElement.dataset.live = String(store.drive.live);
  if (!store.drive.live) return;
  store.playing = true;
  notify("playing", "status");
  on("status", showWarnings);
  on("live-frame drive", () => wake());
  showWarnings();
  followNewest();
}
