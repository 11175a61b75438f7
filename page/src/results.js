// Labels and detections of a frame, with missed and false ones.

import { makeCache, getJson } from "./api.js";
import { getClassColour } from "./colours.js";
import { showError } from "./messages.js";
import { notify, on, store } from "./store.js";

export const MISSED = "#ff4d5e", FALSE = "#ffb020";
const SOURCES = ["#22c1a6", "#a78bfa", "#38bdf8", "#f472b6", "#a3e635", "#fb923c"];
const LABEL = "#94a3b8";

const MAX_CACHED = 300, NO_RESULTS = { labels: [], detections: {}, matches: {} };
const cache = makeCache((frame) => getJson(`/api/labels/${frame}?score=${store.minScore}`), MAX_CACHED);
export const fetchResults = cache.get;

/** List the boxes of labels and detections in the frame shown, as listResultBoxes does. */
export function listShownResults() {
  return store.results.frame === store.frame ? listResultBoxes(store.results, store.frame) : [];
}

/** List the boxes of labels and detections of a frame, from its results: {box, colour, emphasized, text,
 * isSelected}, and their origin: {frame, layer, k, row, error}. */
export function listResultBoxes({ labels, detections, matches }, frame) {
  const boxes = [], { selectedResult: selected } = store;
  const add = (entry, layer, k, row) => {
    const isSelected = selected?.frame === frame && selected.layer === layer && selected.k === k;
    boxes.push({ ...entry, box: row.slice(0, 7), frame, layer, k, row, isSelected });
  };
  const match = matches[findFirstShown()];
  const toSet = (rows) => new Set((store.layers.errors && rows) || []);
  const missed = toSet(match?.missed), ignoredLabels = toSet(match?.ignored_labels);
  if (store.layers.labels) {
    for (const [k, label] of labels.entries()) {
      const isMissed = missed.has(k);
      add({ emphasized: isMissed, error: isMissed ? "missed" : null, colour: isMissed ? MISSED
        : store.mode === "view" ? LABEL : getClassColour(label[7]),
        text: isMissed ? `missed ${label[7]}` : ignoredLabels.has(k) ? `ignored ${label[7]}` : null },
      "labels", k, label);
    }
  }
  for (const [source, { shown, colour }] of store.sources) {
    if (!shown) continue;
    const falseRows = toSet(matches[source]?.false), ignored = toSet(matches[source]?.ignored);
    for (const [k, row] of (detections[source] ?? []).entries()) {
      if (row[8] < store.minScore) continue;
      const isFalse = falseRows.has(k);
      add({ emphasized: isFalse, error: isFalse ? "false" : null, colour: isFalse ? FALSE : colour,
        text: `${isFalse ? "false " : ignored.has(k) ? "ignored " : ""}${row[7]} ${row[8].toFixed(2)}` },
      source, k, row);
    }
  }
  return boxes;
}

export const listResultNames = () => listShownResults().filter(({ text }) => text !== null)
  .map(({ box, colour, emphasized, text, isSelected }) => ({ box, colour, text, isSelected,
    emphasized, state: "found" }));

const findFirstShown = () => [...store.sources].find(([, { shown }]) => shown)?.[0];

/** Count the labels and detections in the frame shown, for the first source shown: labels = hits +
 * missed + ignoredLabels, detected = hits + false + ignored. Counts are null while unknown: without
 * labels, for a running graph, and for a new score until the server replies. */
export function countResults() {
  const { labels, detections, matches, score } = store.results;
  const source = findFirstShown();
  const match = score === store.minScore ? matches[source] : undefined;
  const missed = match?.missed.length ?? null, ignoredLabels = match?.ignored_labels.length ?? null;
  return { source, labels: labels.length, missed, ignoredLabels,
           hits: match ? labels.length - missed - ignoredLabels : null,
           detected: (detections[source] ?? []).filter((row) => row[8] >= store.minScore).length,
           false: match?.false?.length ?? null, ignored: match?.ignored?.length ?? null };
}

/** Load the results of the frame shown; they are dropped if another frame is shown by then. */
export async function loadResults() {
  const { frame, minScore: score } = store;
  let results = NO_RESULTS;
  if (!store.drive.frames[frame]) return;
  try {
    results = await fetchResults(frame);
  } catch (error) {
    if (store.frame === frame) showError(error.message);
  }
  if (store.frame !== frame) return;
  for (const source of Object.keys(results.detections)) {
    if (!store.sources.has(source)) {
      store.sources.set(source, { shown: true, colour: SOURCES[store.sources.size % SOURCES.length] });
      notify("sources");
    }
  }
  store.results = { ...results, frame, score };
  notify("results");
}

export function reloadResults() {
  cache.clear();
  loadResults();
}

on("frame", loadResults);
on("live-frame", (frame) => { // it is new, or has late boxes
  cache.delete(frame);
  if (frame === store.frame && store.cloud) loadResults();
});
