// List of tracks, filtered by state and class, most uncertain first.

import { getClassColour, getTheme } from "./colours.js";
import { goTo } from "./cloud.js";
import { element, icon } from "./dom.js";
import { decideTrack } from "./edits.js";
import { getBox, notify, on, select, store } from "./store.js";

const FILTER_TITLES = { left: "Open", accepted: "Accepted", rejected: "Rejected", all: "All" };
const STATE_BY_FILTER = { left: "proposed", accepted: "accepted", rejected: "rejected" };
const ROW_PX = 34; // same height as in panels.css
const list = document.getElementById("tracks");
const filterTabs = document.getElementById("filters");
let isRowPressed = false, isRenderPending = false;
const classButtons = document.getElementById("only"), rejectRestButton = document.getElementById("reject-rest");

function listTracks() {
  const listedState = STATE_BY_FILTER[store.stateFilter];
  return [...store.tracks.values()]
    .filter((track) => track.id === store.selected || ((!listedState || track.state === listedState)
      && (!store.classFilter || track.class === store.classFilter)))
    .sort((a, b) => store.drive?.live ? b.last - a.last || b.id - a.id // newest first
      : (b.uncertainty ?? 0) - (a.uncertainty ?? 0) || a.id - b.id);
}

function countByState() {
  const counts = { left: 0, accepted: 0, rejected: 0, all: store.tracks.size };
  for (const { state, class: name } of store.tracks.values()) {
    if (store.classFilter && name !== store.classFilter) { counts.all -= 1; continue; }
    counts[state === "proposed" ? "left" : state] += 1;
  }
  return counts;
}

function makeRow(track) {
  const hasBox = getBox(track) !== null, percent = Math.round(100 * track.score);
  const isSelected = track.id === store.selected;
  return element("div", {
    class: `track ${track.state}${isSelected ? " selected" : ""}${store.alsoSelected.has(track.id) ? " also-selected" : ""}`
      + (hasBox ? "" : " elsewhere"),
    role: "option", "aria-selected": String(isSelected), "data-track": track.id, id: `track-${track.id}`,
    onclick: (event) => selectTrack(track, event),
  },
  element("i", { class: "dot", style: `background:${getClassColour(track.class)}` }),
  element("span", { class: "who" }, element("b", {}, `${track.id}`), ` ${track.class}`),
  element("span", { class: "what" }, `${track.byFrame.size} frame${track.byFrame.size === 1 ? "" : "s"}`,
          track.source === "imported" ? " · imported" : ` · ${percent} % ${track.source}`),
  ...(store.mode === "label" ? [
    makeDecisionButton(track, "accept", "check", "accepted"), makeDecisionButton(track, "reject", "reject", "rejected"),
  ] : []));
}

function makeDecisionButton(track, decision, iconName, state) {
  return element("button", {
    class: `bare ${decision}`, tabindex: -1, title: `${decision[0].toUpperCase()}${decision.slice(1)}`,
    "aria-label": `${decision} track ${track.id}`, "aria-pressed": String(track.state === state),
    onclick: (event) => {
      event.stopPropagation();
      select(track.id);
      decideTrack(track.state === state ? "reopen" : decision);
    },
  }, icon(iconName));
}

async function selectTrack(track, event) {
  select(track.id, { extend: event.ctrlKey || event.metaKey });
  if (!getBox(track) && !event.ctrlKey && !event.metaKey) await goTo(findNearestFrame(track));
  notify("focus");
}

function findNearestFrame(track) {
  return [...track.byFrame.keys()].reduce((nearest, frame) =>
    Math.abs(frame - store.frame) < Math.abs(nearest - store.frame) ? frame : nearest, track.first);
}

function rebuild() {
  store.shownTracks = listTracks();
  notify("track-list");
  const counts = countByState();
  for (const tab of filterTabs.children) {
    tab.setAttribute("aria-selected", String(tab.dataset.filter === store.stateFilter));
    tab.querySelector("span").textContent = counts[tab.dataset.filter];
  }
  rejectRestButton.disabled = counts.left === 0;
  rejectRestButton.querySelector("span").textContent = counts.left || "";
  showClassButtons();
  renderRows();
  const index = store.shownTracks.findIndex((track) => track.id === store.selected);
  list.setAttribute("aria-activedescendant", index < 0 ? "" : `track-${store.selected}`);
}

/** If there are tracks of several classes, show a button for each class that filters the list. */
function showClassButtons() {
  const names = [...new Set([...store.tracks.values()].map((track) => track.class))].sort();
  if (store.classFilter && !names.includes(store.classFilter)) store.classFilter = null;
  classButtons.hidden = names.length < 2;
  const key = `${names} ${store.classFilter} ${getTheme()}`;
  if (classButtons.hidden || classButtons.dataset.key === key) return;
  classButtons.dataset.key = key;
  classButtons.replaceChildren(...names.map((name) => element("button", {
    class: "chip", "aria-pressed": String(name === store.classFilter), title: `Show only ${name}, or all classes`,
    onclick: () => { store.classFilter = store.classFilter === name ? null : name; rebuild(); },
  }, element("i", { class: "dot", style: `background:${getClassColour(name)}` }), name)));
}

/** Render the visible rows. While a row is pressed, rendering waits, so that the click hits the same row. */
function renderRows() {
  if (isRowPressed) { isRenderPending = true; return; }
  const tracks = store.shownTracks, first = Math.max(0, Math.floor(list.scrollTop / ROW_PX) - 2);
  const visible = tracks.slice(first, first + Math.ceil(list.clientHeight / ROW_PX) + 4);
  const countBelow = tracks.length - first - visible.length;
  const makeGap = (count) => element("div", { style: `height:${count * ROW_PX}px`, "aria-hidden": "true" });
  list.replaceChildren(makeGap(first), ...visible.map(makeRow), makeGap(countBelow));
  if (tracks.length === 0) list.append(element("p", { class: "hint" }, getEmptyHint()));
}

function getEmptyHint() {
  if (store.mode === "view") return "No tracks in this recording.";
  if (store.tracks.size === 0 && store.progress?.busy) {
    return "The detectors are processing the whole drive. Proposals appear here when they have finished. "
      + "Meanwhile, you can press S and click an object, or press B and click to add a box.";
  }
  if (store.tracks.size === 0) {
    return "No tracks yet. Press P to propose tracks with the detectors, press S and click an object, or "
      + "press B and click to add a box.";
  }
  return store.stateFilter === "left" ? "All tracks are decided." : `No ${store.stateFilter} tracks.`;
}

function scrollToSelected() {
  const index = store.shownTracks.findIndex((track) => track.id === store.selected);
  if (index < 0) return;
  const top = index * ROW_PX;
  if (top < list.scrollTop) list.scrollTop = top;
  else if (top + ROW_PX > list.scrollTop + list.clientHeight) list.scrollTop = top + ROW_PX - list.clientHeight;
}

function moveSelection(step) {
  const tracks = store.shownTracks, index = tracks.findIndex((track) => track.id === store.selected);
  const track = tracks[Math.max(0, Math.min(tracks.length - 1, index + step))];
  if (track) selectTrack(track, {});
}

export function openTrackList() {
  for (const [name, title] of Object.entries(FILTER_TITLES)) {
    filterTabs.append(element("button", {
      role: "tab", "data-filter": name, "aria-controls": "tracks",
      onclick: () => { store.stateFilter = name; rebuild(); },
    }, title, element("span", { class: "count" })));
  }
  list.addEventListener("scroll", renderRows);
  list.addEventListener("pointerdown", (event) => {
    isRowPressed = event.target.closest("[data-track]") !== null;
  });
  for (const name of ["pointerup", "pointercancel"]) {
    addEventListener(name, () => setTimeout(() => { // after the click event
      isRowPressed = false;
      if (isRenderPending) { isRenderPending = false; renderRows(); }
    }));
  }
  list.addEventListener("mousedown", (event) => { // keep the focus where it is, so that arrow keys move the box
    if (event.target !== list) event.preventDefault();
  });
  list.addEventListener("keydown", (event) => {
    const step = { ArrowDown: 1, ArrowUp: -1 }[event.key];
    if (!step) return;
    event.preventDefault();
    event.stopPropagation();
    moveSelection(step);
  });
  new ResizeObserver(renderRows).observe(list);
  on("tracks selection drive frame busy theme", rebuild);
  on("selection", scrollToSelected);
}
