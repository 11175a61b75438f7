// Entry point: opens the parts of the page, then loads the drive.

import { listen, loadDrive, loadState } from "./api.js";
import "./boxes3d.js";
import { showFrame } from "./cloud.js";
import { countUndecided } from "./edits.js";
import { openInspector } from "./inspector.js";
import { fillHelp, openKeys } from "./keys.js";
import { openLive } from "./live.js";
import { showError } from "./messages.js";
import { loadResults } from "./results.js";
import { openResultPanel } from "./resultpanel.js";
import { focusSelection, lookAt, openScene } from "./scene.js";
import { openSideViews } from "./sideviews.js";
import { notify, on, select, store } from "./store.js";
import { openTimeline } from "./timeline.js";
import { openTopbar } from "./topbar.js";
import { openTrackList } from "./tracklist.js";
import { project } from "./picking.js";

async function open() {
  openTopbar();
  openScene();
  openSideViews();
  openTimeline();
  openTrackList();
  openInspector();
  openResultPanel();
  openKeys();
  on("focus", focusSelection);
  try {
    await loadDrive();
    store.mode = store.drive.mode;
    store.minScore = store.drive.min_score;
    if (store.mode === "view") store.stateFilter = "all";
    fillHelp();
    notify("drive", "tool", "colour", "playing");
    await loadState();
    if (store.mode === "label" && store.tracks.size && countUndecided(null) === 0) store.stateFilter = "all";
  } catch (error) {
    showError(`Cannot open the drive: ${error.message}`);
    return;
  }
  listen();
  const query = new URLSearchParams(location.search);
  const last = store.drive.frames.length - 1;
  store.requestedFrame = store.drive.live ? last : Math.min(last, Math.max(0, Number(query.get("frame")) || 0));
  await showFrame(store.requestedFrame);
  openLive();
  if (query.has("track")) select(Number(query.get("track")));
  await loadResults();
  notify("tracks"); // redraw after everything is loaded
  requestAnimationFrame(() => requestAnimationFrame(() => {
    document.documentElement.dataset.ready = "true";
  }));
}

// Access for tests and screenshots. The page itself does not use it.
globalThis.page = { store, project, lookAt };
open();
