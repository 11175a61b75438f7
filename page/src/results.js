// Labels and detections of a frame, with misses and false positives.

import { makeCache, getJson } from "./api.js";
import { getClassColour } from "./colours.js";
import { showError } from "./messages.js";
import { notify, on, store } from "./store.js";

export const MISS_COLOUR = "#ff4d5e", FALSE_POSITIVE_COLOUR = "#ffb020", LABEL_COLOUR = "#94a3b8";
const SOURCE_COLOURS = ["#22c1a6", "#a78bfa", "#38bdf8", "#f472b6", "#a3e635", "#fb923c"];

const MAX_CACHED_FRAMES = 300, NO_RESULTS = { labels: [], detections: {}, matches: {} };
const cache = makeCache((frame) => getJson(`/api/labels/${frame}?score=${store.minScore}`), MAX_CACHED_FRAMES);
export const fetchResults = cache.get;

/** List the boxes of labels and detections in the shown frame, see listResultBoxes(). */
export function listShownResults() {
  return store.results.frame === store.frame ? listResultBoxes(store.results, store.frame) : [];
}

/** List the boxes of labels and detections in the results of a frame, with their appearance {box, colour,
 * emphasized, text, isSelected} and origin {frame, layer, k, row, error}. */
export function listResultBoxes({ labels, detections, matches }, frame) {
  const boxes = [], { selectedResult: selected } = store;
  const add = (entry, layer, k, row) => {
    const isSelected = selected?.frame === frame && selected.layer === layer && selected.k === k;
    boxes.push({ ...entry, box: row.slice(0, 7), frame, layer, k, row, isSelected });
  };
  const match = matches[findFirstShownSource()];
  const toSet = (rows) => new Set((store.layers.errors && rows) || []);
  const missed = toSet(match?.missed), ignoredLabels = toSet(match?.ignored_labels);
  if (store.layers.labels) {
    for (const [k, label] of labels.entries()) {
      const isMissed = missed.has(k);
      add({ emphasized: isMissed, error: isMissed ? "missed" : null, colour: isMissed ? MISS_COLOUR
        : store.mode === "view" ? LABEL_COLOUR : getClassColour(label[7]),
        text: isMissed ? `missed ${label[7]}` : ignoredLabels.has(k) ? `ignored ${label[7]}` : null },
      "labels", k, label);
    }
  }
  for (const [source, { shown, colour }] of store.sources) {
    if (!shown) continue;
    const falsePositives = toSet(matches[source]?.false), ignored = toSet(matches[source]?.ignored);
    for (const [k, row] of (detections[source] ?? []).entries()) {
      if (row[8] < store.minScore) continue;
      const isFalse = falsePositives.has(k);
      add({ emphasized: isFalse, error: isFalse ? "false positive" : null,
        colour: isFalse ? FALSE_POSITIVE_COLOUR : colour,
        text: `${isFalse ? "false positive " : ignored.has(k) ? "ignored " : ""}${row[7]} ${row[8].toFixed(2)}` },
      source, k, row);
    }
  }
  return boxes;
}

export const listResultNames = () => listShownResults().filter(({ text }) => text !== null)
  .map(({ box, colour, emphasized, text, isSelected }) => ({ box, colour, text, isSelected,
    emphasized, state: "result" }));

const findFirstShownSource = () => [...store.sources].find(([, { shown }]) => shown)?.[0];

/** Count the labels and detections of the first shown source in the shown frame. The counts add up:
 * labels = matched + missed + ignoredLabels, detections = matched + falsePositives + ignored. Unknown
 * counts are null: if there are no labels, for a running graph, and for a new minimum score until the
 * server replies. */
export function countResults() {
  const { labels, detections, matches, score } = store.results;
  const source = findFirstShownSource();
  const match = score === store.minScore ? matches[source] : undefined;
  const missed = match?.missed.length ?? null, ignoredLabels = match?.ignored_labels.length ?? null;
  return { source, labels: labels.length, missed, ignoredLabels,
           matched: match ? labels.length - missed - ignoredLabels : null,
           detections: (detections[source] ?? []).filter((row) => row[8] >= store.minScore).length,
           falsePositives: match?.false?.length ?? null, ignored: match?.ignored?.length ?? null };
}

/** Load the results of the shown frame. They are dropped if another frame is shown in the meantime. */
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
      store.sources.set(source, { shown: true, colour: SOURCE_COLOURS[store.sources.size % SOURCE_COLOURS.length] });
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
on("live-frame", (frame) => { // the frame is new or has got late boxes
  cache.delete(frame);
  if (frame === store.frame && store.cloud) loadResults();
});
