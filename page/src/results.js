// In view mode: labels, what each source detected, what was missed and what is false.

import { getJson } from "./api.js";
import { colourOfClass } from "./colours.js";
import { sayError } from "./messages.js";
import { changed, on, store } from "./store.js";

export const MISSED = "#ff4d5e", FALSE = "#ffb020";
const SOURCES = ["#22c1a6", "#a78bfa", "#38bdf8", "#f472b6", "#a3e635", "#fb923c"];
const LABEL = "#94a3b8";

const kept = new Map(); // frame -> promise
const KEPT = 300, NOTHING = { labels: [], detections: {}, matches: {} };

/** Boxes of the frame shown besides those of tracks: {box, colour, strong, text}. */
export function resultBoxes() {
  const { labels, detections, matches } = store.results, found = [];
  if (store.results.frame !== store.frame) return found;
  const compared = [...store.sources].find(([, { shown }]) => shown)?.[0];
  const missed = new Set(store.layers.errors ? matches[compared]?.missed : []);
  if (store.layers.labels) {
    for (const [k, label] of labels.entries()) {
      const wrong = missed.has(k);
      found.push({ box: label.slice(0, 7), strong: wrong, colour: wrong ? MISSED
        : store.mode === "view" ? LABEL : colourOfClass(label[7]),
        text: wrong ? `missed ${label[7]}` : null });
    }
  }
  for (const [source, { shown, colour }] of store.sources) {
    if (!shown) continue;
    const wrong = new Set(store.layers.errors ? matches[source]?.false : []);
    for (const [k, row] of (detections[source] ?? []).entries()) {
      if (row[8] < store.minScore) continue;
      found.push({ box: row.slice(0, 7), strong: wrong.has(k), colour: wrong.has(k) ? FALSE : colour,
        text: `${wrong.has(k) ? "false " : ""}${row[7]} ${row[8].toFixed(2)}` });
    }
  }
  return found;
}

export const resultNames = () => resultBoxes().filter(({ text }) => text !== null)
  .map(({ box, colour, strong, text }) => ({ box, colour, text, loud: strong, state: "found" }));

/** How many of the frame shown: {labels, missed, found, false} of the first source shown. */
export function resultCounts() {
  const { labels, detections, matches } = store.results;
  const source = [...store.sources].find(([, { shown }]) => shown)?.[0];
  const rows = detections[source] ?? [], match = matches[source];
  return { source, labels: labels.length, missed: match?.missed.length ?? null,
           found: rows.filter((row) => row[8] >= store.minScore).length,
           false: match ? match.false.filter((k) => rows[k][8] >= store.minScore).length : null };
}

/** The answer of the server for a frame, asked for once. */
export function resultsOf(frame) {
  if (!kept.has(frame)) {
    const asked = getJson(`/api/labels/${frame}?score=${store.minScore}`);
    asked.catch(() => kept.delete(frame));
    kept.set(frame, asked);
    if (kept.size > KEPT) kept.delete(kept.keys().next().value);
  }
  return kept.get(frame);
}

/** Show those of the frame shown; boxes of another frame are never seen with it. */
export async function loadResults() {
  const { frame } = store;
  let found = NOTHING;
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
  store.results = { ...found, frame };
  changed("results");
}

export function reload() {
  kept.clear();
  loadResults();
}

on("frame", loadResults);
