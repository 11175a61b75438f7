// In view mode: labels, what each source detected, what was missed and what is false.

import { getJson } from "./api.js";
import { colourOfClass } from "./colours.js";
import { sayError } from "./messages.js";
import { goTo } from "./cloud.js";
import { say } from "./messages.js";
import { changed, on, selectFound, store } from "./store.js";

export const MISSED = "#ff4d5e", FALSE = "#ffb020";
const SOURCES = ["#22c1a6", "#a78bfa", "#38bdf8", "#f472b6", "#a3e635", "#fb923c"];
const LABEL = "#94a3b8";

const kept = new Map(); // frame -> promise
const KEPT = 300, NOTHING = { labels: [], detections: {}, matches: {} };

/** Boxes of the frame shown besides those of tracks: {box, colour, strong, text, chosen}, and what
 * each is of: {frame, layer, k, row, wrong}. */
export function resultBoxes() {
  return store.results.frame === store.frame ? boxesIn(store.results, store.frame) : [];
}

function boxesIn({ labels, detections, matches }, frame) {
  const found = [];
  const add = (entry, layer, k, row) => {
    const { found: it } = store;
    found.push({ ...entry, box: row.slice(0, 7), frame, layer, k, row,
      chosen: it?.frame === frame && it.layer === layer && it.k === k });
  };
  const compared = [...store.sources].find(([, { shown }]) => shown)?.[0];
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

let search = 0;

/** The next, or by -1 the last, label that was missed or detection that is false, in this frame or
 * another. */
export async function nextWrong(by) {
  const mine = ++search, { frames, first } = store.drive;
  const wrongIn = (results, frame) => boxesIn(results, frame).filter(({ wrong }) => wrong);
  let { frame } = store, wrong = wrongIn(store.results, frame);
  let at = wrong.findIndex(({ chosen }) => chosen);
  at = at < 0 && by < 0 ? wrong.length - 1 : at + by;
  try {
    while (!wrong[at]) {
      frame += by;
      if (frame < first || frame >= frames.length) {
        say(`Nothing is missed or false ${by > 0 ? "after" : "before"} this.`);
        return;
      }
      wrong = wrongIn(await resultsOf(frame), frame);
      if (mine !== search) return;
      at = by > 0 ? 0 : wrong.length - 1;
    }
    await goTo(frame);
    await loadResults();
  } catch (error) {
    sayError(error.message);
    return;
  }
  if (mine !== search || store.frame !== frame) return;
  selectFound(wrong[at]);
  changed("focus");
}

/** Counts of the frame shown, of the first source shown. labels = hits + missed + ignoredLabels,
 * found = hits + false + ignored; null where that is not known: without labels, of a running graph,
 * and for a new score until the server has answered. */
export function resultCounts() {
  const { labels, detections, matches, score } = store.results;
  const source = [...store.sources].find(([, { shown }]) => shown)?.[0];
  const match = score === store.minScore ? matches[source] : undefined;
  const missed = match?.missed.length ?? null, ignoredLabels = match?.ignored_labels.length ?? null;
  return { source, labels: labels.length, missed, ignoredLabels,
           hits: match ? labels.length - missed - ignoredLabels : null,
           found: (detections[source] ?? []).filter((row) => row[8] >= store.minScore).length,
           false: match?.false?.length ?? null, ignored: match?.ignored?.length ?? null };
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

/** What is known of a frame has changed. */
export function forget(frame) {
  kept.delete(frame);
  if (frame === store.frame && store.cloud) loadResults();
}

/** Show those of the frame shown; boxes of another frame are never seen with it. */
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
  kept.clear();
  loadResults();
}

on("frame", loadResults);
