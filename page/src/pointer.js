// The pointer in the 3D view: select, drag, click a seed, add a box.

import { rayBox } from "./boxmath.js";
import { addAt, seedAt } from "./edits.js";
import { say } from "./messages.js";
import { CLICK_RADIUS, dragBody } from "./overlay.js";
import { hitAt, pointAt, rayAt } from "./picking.js";
import { controls, mark, renderer } from "./scene.js";
import { changed, on, select, selectFound, selectedBox, store } from "./store.js";

const canvas = renderer.domElement;
let down = null, hovering = 0;

// Before the camera's own listeners, so that a box can be dragged instead.
canvas.addEventListener("pointerdown", (event) => {
  canvas.focus({ preventScroll: true });
  if (event.button !== 0) return;
  down = [event.clientX, event.clientY];
  const box = selectedBox()?.box;
  const plain = !event.ctrlKey && !event.metaKey && !event.shiftKey;
  if (store.mode !== "label" || store.tool !== "select" || !box || !plain) return;
  const { origin, direction } = rayAt(event.clientX, event.clientY);
  if (rayBox(origin, direction, box) === null) return;
  if (dragBody(canvas, event)) event.stopImmediatePropagation();
}, { capture: true });

canvas.addEventListener("pointerup", (event) => {
  if (!down || event.button !== 0) return;
  const moved = Math.hypot(event.clientX - down[0], event.clientY - down[1]);
  down = null;
  if (moved <= CLICK_RADIUS) click(event);
});

function click(event) {
  if (store.tool === "select") {
    const { track, found } = hitAt(event.clientX, event.clientY);
    if (found) selectFound(found);
    else select(track, { more: event.ctrlKey || event.metaKey });
    return;
  }
  const index = pointAt(event.clientX, event.clientY);
  if (index < 0) {
    say("There is no point here; click one of the object's points.");
    return;
  }
  const xyz = [...store.cloud.xyz.subarray(3 * index, 3 * index + 3)];
  if (store.tool === "seed") seedAt(xyz);
  else addAt(xyz);
}

canvas.addEventListener("pointermove", (event) => {
  if (event.buttons || hovering) return;
  hovering = requestAnimationFrame(() => {
    hovering = 0;
    hover(event);
  });
});
canvas.addEventListener("pointerleave", () => { mark(0); setHover(null); });
on("frame", () => { if (store.found && store.found.frame !== store.frame) select(null); });

function hover(event) {
  if (store.tool === "seed") {
    const index = pointAt(event.clientX, event.clientY);
    mark(index < 0 ? 0 : store.cloud.cluster[index]);
    return;
  }
  const { track: id, found } = store.tool === "select" ? hitAt(event.clientX, event.clientY)
    : { track: null, found: null };
  setHover(id);
  canvas.style.cursor = id === null && !found ? "" : id === store.selected && store.mode === "label"
    ? "move" : "pointer";
}

function setHover(id) {
  if (id === store.hover) return;
  store.hover = id;
  changed("hover");
}

export function setTool(tool) {
  store.tool = store.mode === "view" ? "select" : tool;
  changed("tool");
}

/** Do what a click in the middle of the view would do, for use without a mouse. */
export function useCentre() {
  const area = canvas.getBoundingClientRect();
  click({ clientX: area.left + area.width / 2, clientY: area.top + area.height / 2 });
}

on("tool", () => {
  mark(0);
  canvas.style.cursor = store.tool === "select" ? "" : "crosshair";
  canvas.dataset.tool = store.tool;
  document.getElementById("cross").toggleAttribute("hidden", store.tool === "select");
  controls.update();
});

canvas.addEventListener("dblclick", (event) => {
  const index = pointAt(event.clientX, event.clientY);
  if (index < 0 || store.tool !== "select") return;
  controls.target.fromArray(store.cloud.xyz, 3 * index);
  controls.update();
});
