// The panel of view mode: which boxes are shown, from which score on, and what is wrong.

import { element } from "./dom.js";
import { liveRows } from "./live.js";
import { FALSE, MISSED, reload, resultCounts } from "./results.js";
import { changed, on, store } from "./store.js";

const LAYERS = [["labels", "Labels", "#94a3b8"], ["errors", "Missed and false", MISSED],
                ["tracks", "Tracks", null], ["trails", "Ways of tracks", null]];
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
    value: store.minScore, "aria-label": "Least score", oninput: () => {
      store.minScore = Number(slider.value);
      number.textContent = store.minScore.toFixed(2);
      changed("layers");
    }, onchange: reload });
  panel.replaceChildren(element("h2", {}, "Shown"), ...layers,
    element("h2", {}, "Detections"), ...(sources.length ? sources
      : [element("p", { class: "hint" }, "None in this recording.")]),
    element("div", { class: "slider" }, element("span", {}, "Score from"), slider, number),
    element("h2", {}, "This frame"), element("div", { id: "counts" }),
    ...(store.drive.live ? [element("h2", {}, "What comes"), element("div", { id: "comes" })] : []));
  count();
  showComing();
}

const rowOf = (title, value, colour, what, part) => element("div",
  { class: `count-row${part ? " part" : ""}`, title: what },
  element("span", {}, title), element("b", { style: colour ? `color:${colour}` : "" },
    value === null ? "–" : String(value)));

function showComing() {
  document.getElementById("comes")?.replaceChildren(...liveRows().flatMap(
    ([title, value, what, wrong]) => [rowOf(title, value, "", what),
      ...(wrong ? [rowOf("", wrong, FALSE, what)] : [])]));
}

function count() {
  const area = document.getElementById("counts");
  if (!area) return;
  const { source, labels, hits, missed, ignoredLabels, found, false: wrong, ignored } = resultCounts();
  const part = (title, value, colour, what = "") => rowOf(title, value, colour, what, true);
  area.replaceChildren(rowOf("labels", labels, "", "Found, missed and ignored ones"),
    part("found", hits, ""), part("missed", missed, missed ? MISSED : ""),
    part("ignored", ignoredLabels, "", "Labels of classes that are not scored, such as vans"),
    rowOf(source ? `by ${source}` : "detections", found, "", "Right, false and ignored ones"),
    part("right", hits, ""), part("false", wrong, wrong ? FALSE : ""),
    part("ignored", ignored, "", "On ignored labels, or outside the image, where labels end"));
}

export function openResults() {
  on("drive sources", build);
  on("results layers", count);
  on("status", showComing);
}
