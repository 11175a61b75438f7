// Pointer events in the 3D view: select and drag boxes, click seeds, add boxes.

import { intersectBox } from "./boxmath.js";
import { addBox, addSeed } from "./edits.js";
import { showNote } from "./messages.js";
import { CLICK_RADIUS_PX, dragBody } from "./overlay.js";
import { findBoxAt, findPointAt, castRay } from "./picking.js";
import { controls, highlightCluster, renderer } from "./scene.js";
import { notify, on, select, selectResult, getSelectedBox, store } from "./store.js";

const canvas = renderer.domElement;
let pressedAt = null, hoverRequest = 0;

// Capture the event before the listeners of the camera, so that a box can be dragged.
canvas.addEventListener("pointerdown", (event) => {
  canvas.focus({ preventScroll: true });
  if (event.button !== 0) return;
  pressedAt = [event.clientX, event.clientY];
  const box = getSelectedBox()?.box;
  const hasNoModifiers = !event.ctrlKey && !event.metaKey && !event.shiftKey;
  if (store.mode !== "label" || store.tool !== "select" || !box || !hasNoModifiers) return;
  const { origin, direction } = castRay(event.clientX, event.clientY);
  if (intersectBox(origin, direction, box) === null) return;
  if (dragBody(canvas, event)) event.stopImmediatePropagation();
}, { capture: true });

canvas.addEventListener("pointerup", (event) => {
  if (!pressedAt || event.button !== 0) return;
  const distance = Math.hypot(event.clientX - pressedAt[0], event.clientY - pressedAt[1]);
  pressedAt = null;
  if (distance <= CLICK_RADIUS_PX) click(event);
});

function click(event) {
  if (store.tool === "select") {
    const { track, result } = findBoxAt(event.clientX, event.clientY);
    if (result) selectResult(result);
    else select(track, { extend: event.ctrlKey || event.metaKey });
    return;
  }
  const index = findPointAt(event.clientX, event.clientY);
  if (index < 0) {
    showNote("No point under the pointer. Click a point of the object.");
    return;
  }
  const xyz = [...store.cloud.xyz.subarray(3 * index, 3 * index + 3)];
  if (store.tool === "seed") addSeed(xyz);
  else addBox(xyz);
}

canvas.addEventListener("pointermove", (event) => {
  if (event.buttons || hoverRequest) return;
  hoverRequest = requestAnimationFrame(() => {
    hoverRequest = 0;
    hover(event);
  });
});
canvas.addEventListener("pointerleave", () => { highlightCluster(0); setHover(null); });
on("frame", () => { if (store.selectedResult && store.selectedResult.frame !== store.frame) select(null); });

function hover(event) {
  if (store.tool === "seed") {
    const index = findPointAt(event.clientX, event.clientY);
    highlightCluster(index < 0 ? 0 : store.cloud.cluster[index]);
    return;
  }
  const { track: id, result } = store.tool === "select" ? findBoxAt(event.clientX, event.clientY)
    : { track: null, result: null };
  setHover(id);
  canvas.style.cursor = id === null && !result ? "" : id === store.selected && store.mode === "label"
    ? "move" : "pointer";
}

function setHover(id) {
  if (id === store.hover) return;
  store.hover = id;
  notify("hover");
}

export function setTool(tool) {
  store.tool = store.mode === "view" ? "select" : tool;
  notify("tool");
}

/** Click at the centre of the view, for use without a mouse. */
export function clickCentre() {
  const area = canvas.getBoundingClientRect();
  click({ clientX: area.left + area.width / 2, clientY: area.top + area.height / 2 });
}

on("tool", () => {
  highlightCluster(0);
  canvas.style.cursor = store.tool === "select" ? "" : "crosshair";
  canvas.dataset.tool = store.tool;
  document.getElementById("cross").toggleAttribute("hidden", store.tool === "select");
  controls.update();
});

canvas.addEventListener("dblclick", (event) => {
  const index = findPointAt(event.clientX, event.clientY);
  if (index < 0 || store.tool !== "select") return;
  controls.target.fromArray(store.cloud.xyz, 3 * index);
  controls.update();
});
