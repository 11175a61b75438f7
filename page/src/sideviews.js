// Top, side and front view of the selected box along its own axes, with handles for its faces, its body and
// its heading. The views do not move during a drag.

import { moveFace, moveAlongAxes, toLocal, rotate } from "./boxmath.js";
import { getTheme } from "./colours.js";
import { beforeDrawing, element, svg } from "./dom.js";
import { setDraft } from "./edits.js";
import { startDrag } from "./overlay.js";
import { on, getSelectedBox, store } from "./store.js";

// right, up: axes of the box (0 length, 1 width, 2 height) that point right and up in the view.
// flip: -1 if the first axis points left instead.
const VIEWS = [
  { name: "top", title: "Top", right: 0, up: 1, flip: 1, isRotatable: true },
  { name: "side", title: "Side", right: 0, up: 2, flip: 1 },
  { name: "front", title: "Front", right: 1, up: 2, flip: -1 },
];
const NAMES = "xyz";
const POINT_COLOURS = { dark: ["#7f8ea8", "#ffffff", "#3b4558"], light: ["#8794a8", "#0b1220", "#c3ccd8"] };
const MARGIN_M = 0.6; // margin around the box
const KNOB_DISTANCE_PX = 20; // distance of the knob from the front of the box

let anchor = null, nearPoints = [], zoom = 1; // the anchor is the box whose axes define the views

function buildView(view) {
  view.canvas = element("canvas");
  view.layer = svg("svg", { class: "handles" });
  view.stalk = svg("line", { class: "stalk" });
  view.rect = svg("rect", { class: "body", "data-handle": "move" }, svg("title", {}, "Drag to move"));
  view.front = svg("line", { class: "frontline" });
  view.group = svg("g", {}, view.rect, view.front);
  view.handles = [];
  for (const [axis, vertical] of [[view.right, false], [view.up, true]]) {
    for (const sign of [1, -1]) {
      const name = `${sign > 0 ? "+" : "-"}${NAMES[axis]}`;
      const grip = svg("line", { class: "edge", "data-handle": name });
      const dot = svg("circle", { class: "handle face", r: 4.5, "data-handle": name });
      view.group.append(grip, dot);
      view.handles.push({ axis, sign, vertical, grip, dot });
    }
  }
  view.knob = view.isRotatable ? svg("circle", { class: "handle turn", r: 6, "data-handle": "yaw" },
                               svg("title", {}, "Drag to rotate")) : null;
  if (view.knob) view.group.append(view.stalk, view.knob);
  view.layer.append(view.group);
  view.size = element("span", { class: "measure" });
  view.panel = element("figure", { class: "sideview", "data-view": view.name }, view.canvas,
                       view.layer, element("figcaption", {}, view.title), view.size);
  view.layer.addEventListener("pointerdown", (event) => startViewDrag(view, event));
  view.panel.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom = Math.min(6, Math.max(0.25, zoom * Math.exp(-event.deltaY / 600)));
    redraw();
  }, { passive: false });
  return view.panel;
}

/** Compute the scale in pixels per metre at which the box and its margin fill the view. */
function computeScale(view, width, height) {
  const boxWidth = anchor[3 + view.right] + 2 * MARGIN_M, boxHeight = anchor[3 + view.up] + 2 * MARGIN_M;
  return zoom * Math.min(width / boxWidth, height / boxHeight);
}

/** Collect the points around the anchor, as [u, v, w, ground] in the axes of the anchor. */
function collectPoints() {
  nearPoints = [];
  const { cloud } = store;
  if (!cloud || !anchor) return;
  const radius = Math.hypot(anchor[3], anchor[4]) / 2 + 6, { xyz } = cloud;
  for (let i = 0; i < cloud.count; i++) {
    const x = xyz[3 * i], y = xyz[3 * i + 1];
    if (Math.abs(x - anchor[0]) > radius || Math.abs(y - anchor[1]) > radius) continue;
    const local = toLocal(anchor, x, y, xyz[3 * i + 2]);
    if (Math.abs(local[2]) < anchor[5] / 2 + 3) nearPoints.push([...local, cloud.ground[i]]);
  }
}

function startViewDrag(view, event) {
  const name = event.target.dataset?.handle, start = getSelectedBox()?.box;
  if (!name || !start || !anchor || event.button !== 0 || store.mode !== "label") return;
  event.preventDefault();
  const area = view.layer.getBoundingClientRect(), scale = computeScale(view, area.width, area.height);
  const startAnchor = anchor.slice(), startPixel = [event.clientX, event.clientY];
  const rotation = start[6] - startAnchor[6];
  startDrag(event.target, event, (e) => {
    let right = (e.clientX - startPixel[0]) / scale * view.flip, up = -(e.clientY - startPixel[1]) / scale;
    if (name === "yaw") {
      const u = (e.clientX - area.left - area.width / 2) / scale;
      const v = -(e.clientY - area.top - area.height / 2) / scale;
      const centre = toLocal(startAnchor, ...start.slice(0, 3));
      setDraft(rotate(start, Math.atan2(v - centre[1], u - centre[0]) - rotation));
      return;
    }
    if (view.isRotatable) { // convert to the axes of the box, which may be rotated in this view
      const c = Math.cos(rotation), s = Math.sin(rotation);
      [right, up] = [c * right + s * up, -s * right + c * up];
    }
    const shift = [0, 0, 0];
    shift[view.right] = right;
    shift[view.up] = up;
    if (name === "move") {
      setDraft(moveAlongAxes(start, ...shift));
    } else {
      const axis = NAMES.indexOf(name[1]), sign = name[0] === "+" ? 1 : -1;
      setDraft(moveFace(start, axis, sign, shift[axis] * sign));
    }
  });
}

/** Return an array that is true for each collected point inside a box. */
function findPointsInside(box) {
  const c = Math.cos(box[6] - anchor[6]), s = Math.sin(box[6] - anchor[6]);
  const centre = toLocal(anchor, box[0], box[1], box[2]), [l, w, h] = box.slice(3, 6).map((v) => v / 2);
  return nearPoints.map((point) => {
    const u = point[0] - centre[0], v = point[1] - centre[1];
    return Math.abs(c * u + s * v) <= l && Math.abs(-s * u + c * v) <= w
      && Math.abs(point[2] - centre[2]) <= h;
  });
}

function drawView(view, box, inside) {
  const { clientWidth: width, clientHeight: height } = view.panel;
  const ratio = Math.min(devicePixelRatio, 2), { canvas } = view;
  if (canvas.width !== width * ratio || canvas.height !== height * ratio) {
    canvas.width = width * ratio;
    canvas.height = height * ratio;
  }
  const pen = canvas.getContext("2d");
  pen.clearRect(0, 0, canvas.width, canvas.height);
  view.group.style.display = box ? "" : "none";
  view.size.textContent = box ? formatSize(view, box) : "";
  if (!box) return;
  const scale = computeScale(view, width, height), depth = 3 - view.right - view.up;
  const colours = POINT_COLOURS[getTheme()], dot = (nearPoints.length > 3000 ? 1.2 : 1.8) * ratio;
  const positions = [[], [], []]; // x, y, x, y, … of points outside, inside and on the ground
  for (const [k, point] of nearPoints.entries()) {
    const x = (width / 2 + point[view.right] * scale * view.flip) * ratio - dot / 2;
    const y = (height / 2 - point[view.up] * scale) * ratio - dot / 2;
    if (x < -dot || y < -dot || x > canvas.width || y > canvas.height) continue;
    if (depth !== 2 && Math.abs(point[depth]) > anchor[3 + depth] / 2 + 0.3 && !inside[k]) continue;
    positions[inside[k] ? 1 : point[3] ? 2 : 0].push(x, y);
  }
  for (const kind of [2, 0, 1]) {
    pen.fillStyle = colours[kind];
    for (let k = 0; k < positions[kind].length; k += 2) {
      pen.fillRect(positions[kind][k], positions[kind][k + 1], dot, dot);
    }
  }
  placeHandles(view, box, width, height, scale);
}

function placeHandles(view, box, width, height, scale) {
  const centre = toLocal(anchor, box[0], box[1], box[2]);
  const rotation = view.isRotatable ? -(box[6] - anchor[6]) * 180 / Math.PI : 0;
  const x = width / 2 + centre[view.right] * scale * view.flip, y = height / 2 - centre[view.up] * scale;
  const a = box[3 + view.right] * scale / 2, b = box[3 + view.up] * scale / 2;
  const set = (node, values) => {
    for (const [name, value] of Object.entries(values)) node.setAttribute(name, value.toFixed?.(2) ?? value);
  };
  set(view.group, { transform: `translate(${x} ${y}) rotate(${rotation})` });
  set(view.rect, { x: -a, y: -b, width: 2 * a, height: 2 * b });
  set(view.front, view.right === 0 ? { x1: a, x2: a, y1: -b, y2: b } : { x1: 0, x2: 0, y1: 0, y2: 0 });
  for (const { sign, vertical, grip, dot } of view.handles) {
    const side = vertical ? -sign : sign * view.flip;
    set(grip, vertical ? { x1: -a, x2: a, y1: side * b, y2: side * b }
      : { x1: side * a, x2: side * a, y1: -b, y2: b });
    set(dot, vertical ? { cx: 0, cy: side * b } : { cx: side * a, cy: 0 });
  }
  if (view.knob) {
    set(view.stalk, { x1: a, x2: a + KNOB_DISTANCE_PX, y1: 0, y2: 0 });
    set(view.knob, { cx: a + KNOB_DISTANCE_PX, cy: 0 });
  }
}

function formatSize(view, box) {
  return `${box[3 + view.right].toFixed(2)} × ${box[3 + view.up].toFixed(2)} m`;
}

const redraw = beforeDrawing(() => {
  const box = getSelectedBox()?.box ?? null;
  if (box && !store.draft && !equals(anchor, box)) {
    anchor = box.slice();
    collectPoints();
  }
  const shownBox = anchor ? box : null, inside = shownBox ? findPointsInside(shownBox) : [];
  for (const view of VIEWS) {
    view.panel.classList.toggle("empty", !box);
    drawView(view, shownBox, inside);
  }
});

const equals = (a, b) => a !== null && a.every((value, k) => value === b[k]);

export function openSideViews() {
  const area = document.getElementById("sideviews");
  area.append(...VIEWS.map(buildView));
  new ResizeObserver(redraw).observe(area);
  on("cloud", () => { anchor = null; redraw(); });
  on("selection tracks draft theme", redraw);
}

