// In view mode: labels, what each source detected, what was missed and what is false.

import { getJson } from "./api.js";
import { colourOfClass } from "./colours.js";
import { changed, on, store } from "./store.js";

export const MISSED = "#ff4d5e", FALSE = "#ffb020";
const SOURCES = ["#22c1a6", "#a78bfa", "#38bdf8", "#f472b6", "#a3e635", "#fb923c"];
const LABEL = "#94a3b8";

let loaded = -1;

/** Boxes of the frame shown besides those of tracks: {box, colour, strong, text}. */
export function resultBoxes() {
  const { labels, detections, matches } = store.results, found = [];
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
  .map(({ box, colour, text }) => ({ box, colour, text, state: "found" }));

/** How many of the frame shown: {labels, missed, found, false} of the first source shown. */
export function resultCounts() {
  const { labels, detections, matches } = store.results;
  const source = [...store.sources].find(([, { shown }]) => shown)?.[0];
  const rows = detections[source] ?? [], match = matches[source];
  return { source, labels: labels.length, missed: match?.missed.length ?? null,
           found: rows.filter((row) => row[8] >= store.minScore).length,
           false: match ? match.false.filter((k) => rows[k][8] >= store.minScore).length : null };
}

async function load() {
  const { frame } = store;
  if (loaded === frame || !store.cloud || !store.drive) return;
  loaded = frame;
  try {
    const found = await getJson(`/api/labels/${frame}?score=${store.minScore}`);
    if (store.frame !== frame) return;
    for (const source of Object.keys(found.detections)) {
      if (!store.sources.has(source)) {
        store.sources.set(source, { shown: true, colour: SOURCES[store.sources.size % SOURCES.length] });
        changed("sources");
      }
    }
    store.results = found;
  } catch {
    store.results = { labels: [], detections: {}, matches: {} };
  }
  changed("results");
}

export function reload() {
  loaded = -1;
  load();
}

on("frame", load);
