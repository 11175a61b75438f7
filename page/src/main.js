// Entry point: opens the parts of the page in order, then loads the drive.

import { listen, loadDrive, loadState } from "./api.js";
import "./boxes3d.js";
import { show } from "./cloud.js";
import { leftIn } from "./edits.js";
import { openInspector } from "./inspector.js";
import { listKeys, openKeys } from "./keys.js";
import { openLive } from "./live.js";
import { sayError } from "./messages.js";
import { loadResults } from "./results.js";
import { openResults } from "./resultpanel.js";
import { draw, drawn, focus, fly, limits, lookAt, openScene } from "./scene.js";
import { openSideViews } from "./sideviews.js";
import { changed, on, select, store } from "./store.js";
import { openTimeline } from "./timeline.js";
import { openTopbar } from "./topbar.js";
import { openTrackList } from "./tracklist.js";
import { pointAt, project } from "./picking.js";

async function open() {
  openTopbar();
  openScene();
  openSideViews();
  openTimeline();
  openTrackList();
  openInspector();
  openResults();
  openKeys();
  on("focus", focus);
  try {
    await loadDrive();
    store.mode = store.drive.mode;
    store.minScore = store.drive.min_score;
    if (store.mode === "view") store.filter = "all";
    listKeys();
    changed("drive", "tool", "colour", "playing");
    await loadState();
    if (store.mode === "label" && store.tracks.size && leftIn(null) === 0) store.filter = "all";
  } catch (error) {
    sayError(`Cannot open the drive: ${error.message}`);
    return;
  }
  listen();
  const query = new URLSearchParams(location.search);
  const last = store.drive.frames.length - 1;
  store.wanted = store.drive.live ? last : Math.min(last, Math.max(0, Number(query.get("frame")) || 0));
  await show(store.wanted);
  openLive();
  if (query.has("track")) select(Number(query.get("track")));
  await loadResults();
  changed("tracks"); // redraw, now that everything is loaded
  requestAnimationFrame(() => requestAnimationFrame(() => {
    document.documentElement.dataset.ready = "true";
  }));
}

// For measurements, screenshots and tests; the page itself does not use it.
globalThis.page = { store, draw, drawn, pointAt, project, fly, limits, lookAt };
open();
