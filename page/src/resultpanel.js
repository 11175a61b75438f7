// Panel of view mode with layers, minimum score, and counts of misses and false positives.

import { goTo } from "./cloud.js";
import { element } from "./dom.js";
import { listReceptionRows } from "./live.js";
import { showNote, showError } from "./messages.js";
import { countResults, FALSE_POSITIVE_COLOUR, fetchResults, LABEL_COLOUR, listResultBoxes, loadResults, MISS_COLOUR,
         reloadResults } from "./results.js";
import { notify, on, selectResult, store } from "./store.js";

const LAYERS = [["labels", "Labels", LABEL_COLOUR], ["errors", "Misses and false positives", MISS_COLOUR],
                ["tracks", "Tracks", null], ["trails", "Track trails", null]];
const panel = document.getElementById("results");

function makeCheckbox(name, title, colour, value, set) {
  const box = element("input", { type: "checkbox", checked: value, "data-layer": name,
    onchange: () => set(box.checked) });
  return element("label", { class: "layer" }, box,
    element("i", { class: "dot", style: colour ? `background:${colour}` : "" }), title);
}

function build() {
  if (store.mode !== "view") return;
  const layers = LAYERS.map(([name, title, colour]) => makeCheckbox(name, title, colour, store.layers[name],
    (value) => { store.layers[name] = value; notify("layers"); }));
  const sources = [...store.sources].map(([name, source]) => makeCheckbox(name, name, source.colour,
    source.shown, (value) => { source.shown = value; notify("layers"); }));
  const number = element("output", {}, store.minScore.toFixed(2));
  const slider = element("input", { type: "range", id: "score", min: 0, max: 1, step: 0.01,
    value: store.minScore, "aria-label": "Minimum score", oninput: () => {
      store.minScore = Number(slider.value);
      number.textContent = store.minScore.toFixed(2);
      notify("layers");
    }, onchange: reloadResults });
  panel.replaceChildren(element("h2", {}, "Layers"), ...layers,
    element("h2", {}, "Detections"), ...(sources.length ? sources
      : [element("p", { class: "hint" }, "None in this recording.")]),
    element("div", { class: "slider" }, element("span", {}, "Min. score"), slider, number),
    element("h2", {}, "This frame"), element("div", { id: "counts" }),
    ...(store.drive.live ? [element("h2", {}, "Reception"), element("div", { id: "reception" })] : []));
  showCounts();
  showReception();
}

const makeCountRow = (title, value, colour, tooltip, isPart) => element("div",
  { class: `count-row${isPart ? " part" : ""}`, title: tooltip },
  element("span", {}, title), element("b", { style: colour ? `color:${colour}` : "" },
    value === null ? "–" : String(value)));

function showReception() {
  document.getElementById("reception")?.replaceChildren(...listReceptionRows().flatMap(
    ([title, value, tooltip, problem]) => [makeCountRow(title, value, "", tooltip),
      ...(problem ? [makeCountRow("", problem, FALSE_POSITIVE_COLOUR, tooltip)] : [])]));
}

function showCounts() {
  const counts = document.getElementById("counts");
  if (!counts) return;
  const { source, labels, matched, missed, ignoredLabels, detections, falsePositives, ignored } = countResults();
  const makePart = (title, value, colour, tooltip = "") => makeCountRow(title, value, colour, tooltip, true);
  counts.replaceChildren(makeCountRow("labels", labels, "", "Detected, missed and ignored labels"),
    makePart("detected", matched, ""), makePart("missed", missed, missed ? MISS_COLOUR : ""),
    makePart("ignored", ignoredLabels, "", "Labels of classes that are not scored, such as vans"),
    makeCountRow(source ? `detections by ${source}` : "detections", detections, "",
                 "True positives, false positives and ignored detections"),
    makePart("true positives", matched, ""),
    makePart("false positives", falsePositives, falsePositives ? FALSE_POSITIVE_COLOUR : ""),
    makePart("ignored", ignored, "",
             "Detections that match ignored labels, or outside the camera image, where no objects are labelled"));
}

let lastSearch = 0;

/** Go to the next (1) or previous (-1) miss or false positive, in this or another frame. */
export async function goToError(step) {
  const searchNumber = ++lastSearch, { frames, first } = store.drive;
  const listErrors = (results, frame) => listResultBoxes(results, frame).filter(({ error }) => error);
  let { frame } = store, errors = listErrors(store.results, frame);
  let index = errors.findIndex(({ isSelected }) => isSelected);
  index = index < 0 && step < 0 ? errors.length - 1 : index + step;
  try {
    while (!errors[index]) {
      frame += step;
      if (frame < first || frame >= frames.length) {
        showNote(`No ${step > 0 ? "further" : "earlier"} miss or false positive.`);
        return;
      }
      errors = listErrors(await fetchResults(frame), frame);
      if (searchNumber !== lastSearch) return;
      index = step > 0 ? 0 : errors.length - 1;
    }
    await goTo(frame);
    await loadResults();
  } catch (error) {
    showError(error.message);
    return;
  }
  if (searchNumber !== lastSearch || store.frame !== frame) return;
  selectResult(errors[index]);
  notify("focus");
}

export function openResultPanel() {
  on("drive sources", build);
  on("results layers", showCounts);
  on("status", showReception);
}
