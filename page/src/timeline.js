// The timeline: boxes of each track by kind, the current frame, checked frames.

import { colourOfClass, theme } from "./colours.js";
import { goTo } from "./cloud.js";
import { beforeDrawing } from "./dom.js";
import { to } from "./playback.js";
import { checkFrame } from "./edits.js";
import { on, select, store } from "./store.js";

const ROW = 13, HEAD = 16, NAMES = 88; // pixels
const INK = {
  dark: { text: "#9fb0c8", line: "#232b38", now: "#f8fafc", check: "#34d399", chosen: "#1d2838" },
  light: { text: "#475569", line: "#e3e8ef", now: "#0f172a", check: "#059669", chosen: "#e6edf7" },
};
const canvas = document.getElementById("timeline");
const box = canvas.parentElement;

const first = () => store.drive?.first ?? 0;
const frames = () => (store.drive?.frames.length ?? 1) - first();
const cell = () => (box.clientWidth - NAMES - 6) / Math.max(1, frames());
const left = (frame) => NAMES + (frame - first()) * cell();
const rows = () => store.shownTracks;

const redraw = beforeDrawing(() => { if (store.drive) paint(); });

function paint() {
  const ratio = Math.min(devicePixelRatio, 2), width = box.clientWidth, height = box.clientHeight;
  canvas.width = width * ratio;
  canvas.height = height * ratio;
  canvas.style.height = `${height}px`;
  document.getElementById("timeline-length").style.height =
    `${Math.max(0, HEAD + rows().length * ROW - height)}px`; // below the canvas, which is sticky
  const pen = canvas.getContext("2d"), ink = INK[theme()], wide = cell();
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, width, height);
  pen.font = "11px system-ui, sans-serif";
  pen.textBaseline = "middle";
  const top = Math.floor(box.scrollTop / ROW), count = Math.ceil(height / ROW) + 1;
  for (const [k, track] of rows().slice(top, top + count).entries()) {
    paintRow(pen, ink, track, HEAD + (top + k) * ROW - box.scrollTop, width, wide);
  }
  paintHead(pen, ink, width, wide, height);
}

function paintRow(pen, ink, track, y, width, wide) {
  if (track.id === store.selected || store.also.has(track.id)) {
    pen.fillStyle = ink.chosen;
    pen.fillRect(0, y, width, ROW);
  }
  const colour = colourOfClass(track.class);
  pen.globalAlpha = track.state === "rejected" ? 0.3 : 1;
  pen.fillStyle = ink.text;
  pen.fillText(`${track.id} ${track.class}`, 6, y + ROW / 2 + 0.5, NAMES - 12);
  for (const [frame, { kind }] of track.byFrame) {
    const x = left(frame), w = Math.max(1, wide - (wide > 4 ? 1 : 0));
    pen.fillStyle = colour;
    pen.globalAlpha = (track.state === "rejected" ? 0.25 : 1)
      * (kind === "key" ? 1 : kind === "interpolated" ? 0.7 : 0.4);
    if (kind === "interpolated") pen.fillRect(x, y + 5, w, 3);
    else pen.fillRect(x, y + 3, w, ROW - 6);
    if (kind === "key" && wide > 5) {
      pen.fillStyle = ink.now;
      pen.fillRect(x + w / 2 - 1.5, y + ROW / 2 - 1.5, 3, 3);
    }
  }
  pen.globalAlpha = 1;
  if (track.state === "accepted") {
    pen.fillStyle = ink.check;
    pen.fillRect(0, y + 2, 3, ROW - 4);
  }
}

function paintHead(pen, ink, width, wide, height) {
  pen.clearRect(0, 0, width, HEAD);
  pen.strokeStyle = ink.line;
  pen.strokeRect(-1, -1, width + 2, HEAD + 0.5);
  const step = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000].find((n) => n * wide > 34) ?? 2000;
  pen.fillStyle = ink.text;
  pen.textAlign = "center";
  for (let i = step * Math.ceil(first() / step); i < first() + frames(); i += step) {
    pen.fillText(i, left(i + 0.5), HEAD / 2);
  }
  pen.textAlign = "left";
  pen.fillStyle = ink.check;
  for (const frame of store.checked) {
    pen.fillRect(left(frame), HEAD - 3, Math.max(1, wide - (wide > 4 ? 1 : 0)), 3);
  }
  const x = left(store.wanted + 0.5);
  pen.strokeStyle = ink.now;
  pen.lineWidth = 1.5;
  pen.beginPath();
  pen.moveTo(x, 0);
  pen.lineTo(x, height);
  pen.stroke();
  pen.lineWidth = 1;
}

function at(event) {
  const area = canvas.getBoundingClientRect();
  const x = event.clientX - area.left, y = event.clientY - area.top;
  const frame = first() + Math.floor((x - NAMES) / cell());
  const row = y < HEAD ? -1 : Math.floor((y - HEAD + box.scrollTop) / ROW);
  return { frame: Math.max(first(), Math.min(first() + frames() - 1, frame)), inNames: x < NAMES, track: rows()[row] };
}

export function openTimeline() {
  const slider = document.getElementById("frame");
  slider.oninput = () => to(Number(slider.value));
  canvas.addEventListener("pointerdown", (event) => {
    const { frame, track, inNames } = at(event);
    if (track) select(track.id, { more: event.ctrlKey || event.metaKey });
    if (!inNames) {
      to(frame);
      canvas.setPointerCapture(event.pointerId);
    } else if (track && !track.byFrame.has(store.frame)) goTo(track.first);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (event.buttons === 1 && !at(event).inNames) to(at(event).frame);
  });
  box.addEventListener("scroll", redraw);
  new ResizeObserver(redraw).observe(box);
  on("tracks selection wanted drive theme listed progress", redraw);
  const check = document.getElementById("check");
  check.onclick = checkFrame;
  on("frame progress", () => check.setAttribute("aria-pressed", String(store.checked.has(store.frame))));
  on("drive wanted frame playing", () => {
    const frame = store.drive.frames[store.wanted], last = first() + frames() - 1;
    slider.min = first();
    slider.max = last;
    slider.value = store.wanted;
    if (!frame) return;
    slider.setAttribute("aria-valuetext", `frame ${store.wanted}, ${frame.name}`);
    const behind = (frame.stamp_ns - store.drive.frames[last].stamp_ns) / 1e9;
    document.getElementById("frame-number").textContent = !store.drive.live
      ? `${store.wanted} / ${last}` : store.playing ? "live" : `${behind.toFixed(1)} s`;
    const name = document.getElementById("frame-name");
    const seconds = (frame.stamp_ns - store.drive.frames[first()].stamp_ns) / 1e9;
    name.textContent = frame.name.length < 20 ? frame.name : `${seconds.toFixed(2)} s`;
    name.title = frame.name;
  });
  on("selection", () => { // scroll to the row of the selected track
    const row = rows().findIndex((track) => track.id === store.selected);
    const top = row * ROW, seen = box.clientHeight - HEAD - ROW;
    if (row < 0) return;
    if (top < box.scrollTop) box.scrollTop = top;
    else if (top > box.scrollTop + seen) box.scrollTop = top - seen;
  });
}
