// The panel of view mode: which boxes are shown, the score threshold, and the errors of a frame.

import { goTo } from "./cloud.js";
import { element } from "./dom.js";
import { liveRows } from "./live.js";
import { say, sayError } from "./messages.js";
import { boxesIn, FALSE, loadResults, MISSED, reload, resultCounts, resultsOf } from "./results.js";
import { changed, on, selectFound, store } from "./store.js";

const LAYERS = [["labels", "Labels", "#94a3b8"], ["errors", "Missed and false", MISSED],
                ["tracks", "Tracks", null], ["trails", "Trails of tracks", null]];
const panel = document.getElementById("results");

function check(name, title, colour, value, set) {
  const box = element("input", { type: "checkbox", checked: value, "data-layer": name,
    onchange: () => set(box.checked) });
  return element("label", { class: "layer" }, box,
    element("i", { class: "dot", style: colour ? `background:${colour}` : "" }), title);
}

function build() {
  if (store.mode !== "view") return;
  const layers = LAYERS.map(([name, title, colour]) => check(name, title, colour, store.layers[name],
    (value) => { store.layers[name] = value; changed("layers"); }));
  const sources = [...store.sources].map(([name, source]) => check(name, name, source.colour,
    source.shown, (value) => { source.shown = value; changed("layers"); }));
  const number = element("output", {}, store.minScore.toFixed(2));
  const slider = element("input", { type: "range", id: "score", min: 0, max: 1, step: 0.01,
    value: store.minScore, "aria-label": "Minimum score", oninput: () => {
      store.minScore = Number(slider.value);
      number.textContent = store.minScore.toFixed(2);
      changed("layers");
    }, onchange: reload });
  panel.replaceChildren(element("h2", {}, "Layers"), ...layers,
    element("h2", {}, "Detections"), ...(sources.length ? sources
      : [element("p", { class: "hint" }, "None in this recording.")]),
    element("div", { class: "slider" }, element("span", {}, "Min. score"), slider, number),
    element("h2", {}, "This frame"), element("div", { id: "counts" }),
    ...(store.drive.live ? [element("h2", {}, "Reception"), element("div", { id: "reception" })] : []));
  showCounts();
  showReception();
}

const rowOf = (title, value, colour, what, part) => element("div",
  { class: `count-row${part ? " part" : ""}`, title: what },
  element("span", {}, title), element("b", { style: colour ? `color:${colour}` : "" },
    value === null ? "–" : String(value)));

function showReception() {
  document.getElementById("reception")?.replaceChildren(...liveRows().flatMap(
    ([title, value, what, wrong]) => [rowOf(title, value, "", what),
      ...(wrong ? [rowOf("", wrong, FALSE, what)] : [])]));
}

function showCounts() {
  const area = document.getElementById("counts");
  if (!area) return;
  const { source, labels, hits, missed, ignoredLabels, found, false: wrong, ignored } = resultCounts();
  const part = (title, value, colour, what = "") => rowOf(title, value, colour, what, true);
  area.replaceChildren(rowOf("labels", labels, "", "Found, missed and ignored labels"),
    part("found", hits, ""), part("missed", missed, missed ? MISSED : ""),
    part("ignored", ignoredLabels, "", "Labels of classes that are not scored, such as vans"),
    rowOf(source ? `by ${source}` : "detections", found, "", "Correct, false and ignored detections"),
    part("correct", hits, ""), part("false", wrong, wrong ? FALSE : ""),
    part("ignored", ignored, "", "On ignored labels, or outside the camera image, where nothing is labelled"));
}

let search = 0;

/** Go to the next (1) or previous (-1) missed label or false detection, in this or another frame. */
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
        say(`No missed label or false detection ${by > 0 ? "after" : "before"} this one.`);
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

export function openResults() {
  on("drive sources", build);
  on("results layers", showCounts);
  on("status", showReception);
}
