// The list of tracks: undecided, accepted and rejected ones, the most uncertain first.

import { colourOfClass, theme } from "./colours.js";
import { goTo } from "./cloud.js";
import { element, icon } from "./dom.js";
import { decide } from "./edits.js";
import { boxOf, changed, on, select, store } from "./store.js";

const FILTERS = { left: "Left", accepted: "Accepted", rejected: "Rejected", all: "All" };
const STATE = { left: "proposed", accepted: "accepted", rejected: "rejected" };
const ROW = 34; // pixels, as in app.css
const list = document.getElementById("tracks");
const tabs = document.getElementById("filters");
let pressed = false, late = false;
const classes = document.getElementById("only"), rest = document.getElementById("reject-rest");

function listed() {
  const wanted = STATE[store.filter];
  return [...store.tracks.values()]
    .filter((track) => track.id === store.selected || ((wanted === undefined || track.state === wanted)
      && (!store.only || track.class === store.only)))
    .sort((a, b) => store.drive?.live ? b.last - a.last || b.id - a.id // the newest first
      : (b.uncertainty ?? 0) - (a.uncertainty ?? 0) || a.id - b.id);
}

function counts() {
  const found = { left: 0, accepted: 0, rejected: 0, all: store.tracks.size };
  for (const { state, class: name } of store.tracks.values()) {
    if (store.only && name !== store.only) { found.all -= 1; continue; }
    found[state === "proposed" ? "left" : state] += 1;
  }
  return found;
}

function row(track) {
  const here = boxOf(track) !== null, percent = Math.round(100 * track.score);
  const chosen = track.id === store.selected;
  return element("div", {
    class: `track ${track.state}${chosen ? " chosen" : ""}${store.also.has(track.id) ? " also" : ""}`
      + (here ? "" : " elsewhere"),
    role: "option", "aria-selected": String(chosen), "data-track": track.id, id: `track-${track.id}`,
    onclick: (event) => choose(track, event),
  },
  element("i", { class: "dot", style: `background:${colourOfClass(track.class)}` }),
  element("span", { class: "who" }, element("b", {}, `${track.id}`), ` ${track.class}`),
  element("span", { class: "what" }, `${track.byFrame.size} frame${track.byFrame.size === 1 ? "" : "s"}`,
          track.source === "imported" ? " · imported" : ` · ${percent} % ${track.source}`),
  ...(store.mode === "label" ? [
    verdict(track, "accept", "check", "accepted"), verdict(track, "reject", "reject", "rejected"),
  ] : []));
}

function verdict(track, verb, sign, state) {
  return element("button", {
    class: `bare ${verb}`, tabindex: -1, title: `${verb[0].toUpperCase()}${verb.slice(1)}`,
    "aria-label": `${verb} track ${track.id}`, "aria-pressed": String(track.state === state),
    onclick: (event) => {
      event.stopPropagation();
      select(track.id);
      decide(track.state === state ? "reopen" : verb);
    },
  }, icon(sign));
}

async function choose(track, event) {
  select(track.id, { more: event.ctrlKey || event.metaKey });
  if (!boxOf(track) && !event.ctrlKey && !event.metaKey) await goTo(nearestFrame(track));
  changed("focus");
}

function nearestFrame(track) {
  return [...track.byFrame.keys()].reduce((best, frame) =>
    Math.abs(frame - store.frame) < Math.abs(best - store.frame) ? frame : best, track.first);
}

function rebuild() {
  store.shownTracks = listed();
  changed("listed");
  const found = counts();
  for (const tab of tabs.children) {
    tab.setAttribute("aria-selected", String(tab.dataset.filter === store.filter));
    tab.querySelector("span").textContent = found[tab.dataset.filter];
  }
  rest.disabled = found.left === 0;
  rest.querySelector("span").textContent = found.left || "";
  showClasses();
  place();
  const at = store.shownTracks.findIndex((track) => track.id === store.selected);
  list.setAttribute("aria-activedescendant", at < 0 ? "" : `track-${store.selected}`);
}

/** Show a button for each class of tracks, if there are several, that limits the list to it. */
function showClasses() {
  const names = [...new Set([...store.tracks.values()].map((track) => track.class))].sort();
  if (store.only && !names.includes(store.only)) store.only = null;
  classes.hidden = names.length < 2;
  const key = `${names} ${store.only} ${theme()}`;
  if (classes.hidden || classes.dataset.key === key) return;
  classes.dataset.key = key;
  classes.replaceChildren(...names.map((name) => element("button", {
    class: "chip", "aria-pressed": String(name === store.only), title: `Only ${name}, or all`,
    onclick: () => { store.only = store.only === name ? null : name; rebuild(); },
  }, element("i", { class: "dot", style: `background:${colourOfClass(name)}` }), name)));
}

/** Make only the visible rows; none while a row is pressed, so that the click hits the same row. */
function place() {
  if (pressed) { late = true; return; }
  const tracks = store.shownTracks, first = Math.max(0, Math.floor(list.scrollTop / ROW) - 2);
  const seen = tracks.slice(first, first + Math.ceil(list.clientHeight / ROW) + 4);
  const rest = tracks.length - first - seen.length;
  const gap = (count) => element("div", { style: `height:${count * ROW}px`, "aria-hidden": "true" });
  list.replaceChildren(gap(first), ...seen.map(row), gap(rest));
  if (tracks.length === 0) list.append(element("p", { class: "hint" }, emptyHint()));
}

function emptyHint() {
  if (store.mode === "view") return "No tracks in this recording.";
  if (store.tracks.size === 0 && store.progress?.busy) {
    return "The detectors are searching the whole drive; proposals appear here when they are done. "
      + "Meanwhile, press S and click an object, or B and click, to start a track by hand.";
  }
  if (store.tracks.size === 0) {
    return "No tracks yet. Press P to propose tracks with the detectors, S and click an object, or "
      + "B and click to add a box.";
  }
  return store.filter === "left" ? "All tracks are decided." : `No ${store.filter} tracks.`;
}

function scrollToChosen() {
  const at = store.shownTracks.findIndex((track) => track.id === store.selected);
  if (at < 0) return;
  const top = at * ROW;
  if (top < list.scrollTop) list.scrollTop = top;
  else if (top + ROW > list.scrollTop + list.clientHeight) list.scrollTop = top + ROW - list.clientHeight;
}

function walk(by) {
  const tracks = store.shownTracks, at = tracks.findIndex((track) => track.id === store.selected);
  const track = tracks[Math.max(0, Math.min(tracks.length - 1, at + by))];
  if (track) choose(track, {});
}

export function openTrackList() {
  for (const [name, title] of Object.entries(FILTERS)) {
    tabs.append(element("button", {
      role: "tab", "data-filter": name, "aria-controls": "tracks",
      onclick: () => { store.filter = name; rebuild(); },
    }, title, element("span", { class: "count" })));
  }
  list.addEventListener("scroll", place);
  list.addEventListener("pointerdown", (event) => {
    pressed = event.target.closest("[data-track]") !== null;
  });
  for (const end of ["pointerup", "pointercancel"]) {
    addEventListener(end, () => setTimeout(() => { // after the click
      pressed = false;
      if (late) { late = false; place(); }
    }));
  }
  list.addEventListener("mousedown", (event) => { // keep focus, so that arrow keys move the box
    if (event.target !== list) event.preventDefault();
  });
  list.addEventListener("keydown", (event) => {
    const by = { ArrowDown: 1, ArrowUp: -1 }[event.key];
    if (!by) return;
    event.preventDefault();
    event.stopPropagation();
    walk(by);
  });
  new ResizeObserver(place).observe(list);
  on("tracks selection drive frame busy theme", rebuild);
  on("selection", scrollToChosen);
}
