// Labels and detections of a frame, with missed and false ones.

import { cached, getJson } from "./api.js";
import { colourOfClass } from "./colours.js";
import { sayError } from "./messages.js";
import { changed, on, store } from "./store.js";

export const MISSED = "#ff4d5e", FALSE = "#ffb020";
const SOURCES = ["#22c1a6", "#a78bfa", "#38bdf8", "#f472b6", "#a3e635", "#fb923c"];
const LABEL = "#94a3b8";

const MAX_CACHED = 300, NOTHING = { labels: [], detections: {}, matches: {} };
const cache = cached((frame) => getJson(`/api/labels/${frame}?score=${store.minScore}`), MAX_CACHED);
export const resultsOf = cache.get;

/** Boxes of labels and detections in the frame shown: {box, colour, strong, text, chosen}, and their
 * origin: {frame, layer, k, row, wrong}. */
export function resultBoxes() {
  return store.results.frame === store.frame ? boxesIn(store.results, store.frame) : [];
}

/** The same for given results of a frame. */
export function boxesIn({ labels, detections, matches }, frame) {
  const found = [];
  const add = (entry, layer, k, row) => {
    const { found: it } = store;
    found.push({ ...entry, box: row.slice(0, 7), frame, layer, k, row,
      chosen: it?.frame === frame && it.layer === layer && it.k === k });
  };
  const compared = firstShown();
  const rowsOf = (rows) => new Set((store.layers.errors && rows) || []);
  const missed = rowsOf(matches[compared]?.missed), passed = rowsOf(matches[compared]?.ignored_labels);
  if (store.layers.labels) {
    for (const [k, label] of labels.entries()) {
      const wrong = missed.has(k);
      add({ strong: wrong, wrong: wrong ? "missed" : null, colour: wrong ? MISSED
        : store.mode === "view" ? LABEL : colourOfClass(label[7]),
        text: wrong ? `missed ${label[7]}` : passed.has(k) ? `ignored ${label[7]}` : null },
      "labels", k, label);
    }
  }
  for (const [source, { shown, colour }] of store.sources) {
    if (!shown) continue;
    const wrong = rowsOf(matches[source]?.false), ignored = rowsOf(matches[source]?.ignored);
    for (const [k, row] of (detections[source] ?? []).entries()) {
      if (row[8] < store.minScore) continue;
      const bad = wrong.has(k);
      add({ strong: bad, wrong: bad ? "false" : null, colour: bad ? FALSE : colour,
        text: `${bad ? "false " : ignored.has(k) ? "ignored " : ""}${row[7]} ${row[8].toFixed(2)}` },
      source, k, row);
    }
  }
  return found;
}

export const resultNames = () => resultBoxes().filter(({ text }) => text !== null)
  .map(({ box, colour, strong, text, chosen }) => ({ box, colour, text, chosen, loud: strong,
    state: "found" }));

const firstShown = () => [...store.sources].find(([, { shown }]) => shown)?.[0];

/** Counts for the first shown source in the frame shown: labels = hits + missed + ignoredLabels,
 * found = hits + false + ignored. Null if unknown: without labels, for a running graph, and for a new
 * score until the server has answered. */
export function resultCounts() {
  const { labels, detections, matches, score } = store.results;
  const source = firstShown();
  const match = score === store.minScore ? matches[source] : undefined;
  const missed = match?.missed.length ?? null, ignoredLabels = match?.ignored_labels.length ?? null;
  return { source, labels: labels.length, missed, ignoredLabels,
           hits: match ? labels.length - missed - ignoredLabels : null,
           found: (detections[source] ?? []).filter((row) => row[8] >= store.minScore).length,
           false: match?.false?.length ?? null, ignored: match?.ignored?.length ?? null };
}

/** Load the results of the frame shown, and never show those of another one. */
export async function loadResults() {
  const { frame, minScore: score } = store;
  let found = NOTHING;
  if (!store.drive.frames[frame]) return;
  try {
    found = await resultsOf(frame);
  } catch (error) {
    if (store.frame === frame) sayError(error.message);
  }
  if (store.frame !== frame) return;
  for (const source of Object.keys(found.detections)) {
    if (!store.sources.has(source)) {
      store.sources.set(source, { shown: true, colour: SOURCES[store.sources.size % SOURCES.length] });
      changed("sources");
    }
  }
  store.results = { ...found, frame, score };
  changed("results");
}

export function reload() {
  cache.clear();
  loadResults();
}

on("frame", loadResults);
on("live-frame", (frame) => { // it is new, or has late boxes
  cache.delete(frame);
  if (frame === store.frame && store.cloud) loadResults();
});
