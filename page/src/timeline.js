// Timeline with the boxes of each track by kind, the current frame and the checked frames.

import { getClassColour, getTheme } from "./colours.js";
import { goTo } from "./cloud.js";
import { beforeDrawing } from "./dom.js";
import { stopAndGoTo } from "./playback.js";
import { toggleChecked } from "./edits.js";
import { on, select, store } from "./store.js";

const ROW_PX = 13, HEADER_PX = 16, NAMES_PX = 88;
const PALETTE = {
  dark: { text: "#9fb0c8", line: "#232b38", cursor: "#f8fafc", check: "#34d399", selected: "#1d2838" },
  light: { text: "#475569", line: "#e3e8ef", cursor: "#0f172a", check: "#059669", selected: "#e6edf7" },
};
const canvas = document.getElementById("timeline");
const container = canvas.parentElement;

const getFirstFrame = () => store.drive?.first ?? 0;
const countFrames = () => (store.drive?.frames.length ?? 1) - getFirstFrame();
const computeCellWidth = () => (container.clientWidth - NAMES_PX - 6) / Math.max(1, countFrames());
const frameToX = (frame) => NAMES_PX + (frame - getFirstFrame()) * computeCellWidth();
const getTracks = () => store.shownTracks;

const redraw = beforeDrawing(() => { if (store.drive) paint(); });

function paint() {
  const ratio = Math.min(devicePixelRatio, 2), width = container.clientWidth, height = container.clientHeight;
  canvas.width = width * ratio;
  canvas.height = height * ratio;
  canvas.style.height = `${height}px`;
  document.getElementById("timeline-length").style.height =
    `${Math.max(0, HEADER_PX + getTracks().length * ROW_PX - height)}px`; // the rest is covered by the canvas, which is sticky
  const pen = canvas.getContext("2d"), palette = PALETTE[getTheme()], cellWidth = computeCellWidth();
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, width, height);
  pen.font = "11px system-ui, sans-serif";
  pen.textBaseline = "middle";
  const top = Math.floor(container.scrollTop / ROW_PX), count = Math.ceil(height / ROW_PX) + 1;
  for (const [k, track] of getTracks().slice(top, top + count).entries()) {
    paintRow(pen, palette, track, HEADER_PX + (top + k) * ROW_PX - container.scrollTop, width, cellWidth);
  }
  paintHeader(pen, palette, width, cellWidth, height);
}

function paintRow(pen, palette, track, y, width, cellWidth) {
  if (track.id === store.selected || store.alsoSelected.has(track.id)) {
    pen.fillStyle = palette.selected;
    pen.fillRect(0, y, width, ROW_PX);
  }
  const colour = getClassColour(track.class);
  pen.globalAlpha = track.state === "rejected" ? 0.3 : 1;
  pen.fillStyle = palette.text;
  pen.fillText(`${track.id} ${track.class}`, 6, y + ROW_PX / 2 + 0.5, NAMES_PX - 12);
  for (const [frame, { kind }] of track.byFrame) {
    const x = frameToX(frame), w = Math.max(1, cellWidth - (cellWidth > 4 ? 1 : 0));
    pen.fillStyle = colour;
    pen.globalAlpha = (track.state === "rejected" ? 0.25 : 1)
      * (kind === "key" ? 1 : kind === "interpolated" ? 0.7 : 0.4);
    if (kind === "interpolated") pen.fillRect(x, y + 5, w, 3);
    else pen.fillRect(x, y + 3, w, ROW_PX - 6);
    if (kind === "key" && cellWidth > 5) {
      pen.fillStyle = palette.cursor;
      pen.fillRect(x + w / 2 - 1.5, y + ROW_PX / 2 - 1.5, 3, 3);
    }
  }
  pen.globalAlpha = 1;
  if (track.state === "accepted") {
    pen.fillStyle = palette.check;
    pen.fillRect(0, y + 2, 3, ROW_PX - 4);
  }
}

function paintHeader(pen, palette, width, cellWidth, height) {
  pen.clearRect(0, 0, width, HEADER_PX);
  pen.strokeStyle = palette.line;
  pen.strokeRect(-1, -1, width + 2, HEADER_PX + 0.5);
  const step = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000].find((n) => n * cellWidth > 34) ?? 2000;
  pen.fillStyle = palette.text;
  pen.textAlign = "center";
  for (let i = step * Math.ceil(getFirstFrame() / step); i < getFirstFrame() + countFrames(); i += step) {
    pen.fillText(i, frameToX(i + 0.5), HEADER_PX / 2);
  }
  pen.textAlign = "left";
  pen.fillStyle = palette.check;
  for (const frame of store.checked) {
    pen.fillRect(frameToX(frame), HEADER_PX - 3, Math.max(1, cellWidth - (cellWidth > 4 ? 1 : 0)), 3);
  }
  const x = frameToX(store.requestedFrame + 0.5);
  pen.strokeStyle = palette.cursor;
  pen.lineWidth = 1.5;
  pen.beginPath();
  pen.moveTo(x, 0);
  pen.lineTo(x, height);
  pen.stroke();
  pen.lineWidth = 1;
}

function locate(event) {
  const area = canvas.getBoundingClientRect();
  const x = event.clientX - area.left, y = event.clientY - area.top;
  const frame = getFirstFrame() + Math.floor((x - NAMES_PX) / computeCellWidth());
  const row = y < HEADER_PX ? -1 : Math.floor((y - HEADER_PX + container.scrollTop) / ROW_PX);
  const last = getFirstFrame() + countFrames() - 1;
  return { frame: Math.max(getFirstFrame(), Math.min(last, frame)), isInNames: x < NAMES_PX,
           track: getTracks()[row] };
}

export function openTimeline() {
  const slider = document.getElementById("frame");
  slider.oninput = () => stopAndGoTo(Number(slider.value));
  canvas.addEventListener("pointerdown", (event) => {
    const { frame, track, isInNames } = locate(event);
    if (track) select(track.id, { extend: event.ctrlKey || event.metaKey });
    if (!isInNames) {
      stopAndGoTo(frame);
      canvas.setPointerCapture(event.pointerId);
    } else if (track && !track.byFrame.has(store.frame)) goTo(track.first);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (event.buttons === 1 && !locate(event).isInNames) stopAndGoTo(locate(event).frame);
  });
  container.addEventListener("scroll", redraw);
  new ResizeObserver(redraw).observe(container);
  on("tracks selection requested-frame drive theme track-list progress", redraw);
  const check = document.getElementById("check");
  check.onclick = toggleChecked;
  on("frame progress", () => check.setAttribute("aria-pressed", String(store.checked.has(store.frame))));
  on("drive requested-frame frame playing", () => {
    const frame = store.drive.frames[store.requestedFrame], last = getFirstFrame() + countFrames() - 1;
    slider.min = getFirstFrame();
    slider.max = last;
    slider.value = store.requestedFrame;
    if (!frame) return;
    slider.setAttribute("aria-valuetext", `frame ${store.requestedFrame}, ${frame.name}`);
    const ageSeconds = (frame.stamp_ns - store.drive.frames[last].stamp_ns) / 1e9;
    document.getElementById("frame-number").textContent = !store.drive.live
      ? `${store.requestedFrame} / ${last}` : store.playing ? "live" : `${ageSeconds.toFixed(1)} s`;
    const name = document.getElementById("frame-name");
    const seconds = (frame.stamp_ns - store.drive.frames[getFirstFrame()].stamp_ns) / 1e9;
    name.textContent = frame.name.length < 20 ? frame.name : `${seconds.toFixed(2)} s`;
    name.title = frame.name;
  });
  on("selection", () => { // scroll to the row of the selected track
    const row = getTracks().findIndex((track) => track.id === store.selected);
    const top = row * ROW_PX, visibleHeight = container.clientHeight - HEADER_PX - ROW_PX;
    if (row < 0) return;
    if (top < container.scrollTop) container.scrollTop = top;
    else if (top > container.scrollTop + visibleHeight) container.scrollTop = top - visibleHeight;
  });
}
