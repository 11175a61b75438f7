// The page: its parts are opened in order, then the drive is asked for.

import { getJson, listen, loadState } from "./api.js";
import "./boxes3d.js";
import { show } from "./cloud.js";
import { leftIn } from "./edits.js";
import { openInspector } from "./inspector.js";
import { listKeys, openKeys } from "./keys.js";
import { openLive, takeDrive } from "./live.js";
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
    takeDrive(await getJson("/api/drive"));
    store.mode = store.drive.mode;
    store.minScore = store.drive.min_score;
    if (store.mode === "view") store.filter = "all";
    listKeys();
    changed("drive", "tool", "colour", "playing");
    await loadState();
    if (store.mode === "label" && store.tracks.size && leftIn(null) === 0) store.filter = "all";
  } catch (error) {
    sayError(`The drive cannot be opened: ${error.message}`);
    return;
  }
  listen();
  const asked = new URLSearchParams(location.search);
  const last = store.drive.frames.length - 1;
  store.wanted = store.drive.live ? last : Math.min(last, Math.max(0, Number(asked.get("frame")) || 0));
  await show(store.wanted);
  openLive();
  if (asked.has("track")) select(Number(asked.get("track")));
  await loadResults();
  changed("tracks"); // one more picture, now that all is here
  requestAnimationFrame(() => requestAnimationFrame(() => {
    document.documentElement.dataset.ready = "true";
  }));
}

// For measurements and for pictures from a script; nothing on the page uses it.
globalThis.page = { store, draw, drawn, pointAt, project, fly, limits, lookAt };
open();
