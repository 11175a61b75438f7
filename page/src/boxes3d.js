// Boxes of the shown frame as lines in the 3D view. The filled face is the front.

import * as THREE from "three";
import { LineMaterial } from "three/addons/lines/LineMaterial.js";
import { LineSegments2 } from "three/addons/lines/LineSegments2.js";
import { LineSegmentsGeometry } from "three/addons/lines/LineSegmentsGeometry.js";
import { EDGES, computeCorners, toSensorFrame, toFixedFrame } from "./boxmath.js";
import { rgb, listShownBoxes, getTheme } from "./colours.js";
import { listShownResults } from "./results.js";
import { draw, scene } from "./scene.js";
import { on, store } from "./store.js";

const TRAIL_FRAMES = 30;
const SELECTION_COLOUR = { dark: [255, 255, 255], light: [17, 24, 39] };
const OPACITY_BY_KIND = { proposed: 0.6, interpolated: 0.75, key: 1 };

const thinLines = makeLines(1.6), thickLines = makeLines(3.2);
const frontFaces = new THREE.Mesh(new THREE.BufferGeometry(), new THREE.MeshBasicMaterial({
  vertexColors: true, transparent: true, opacity: 0.28, side: THREE.DoubleSide, depthWrite: false,
}));
const trails = new THREE.LineSegments(new THREE.BufferGeometry(), new THREE.LineBasicMaterial({
  vertexColors: true, transparent: true, opacity: 0.9 }));
for (const object of [frontFaces, trails]) {
  object.frustumCulled = false;
  scene.add(object);
}

function makeLines(linewidth) {
  const segments = new LineSegments2(new LineSegmentsGeometry(),
                                     new LineMaterial({ vertexColors: true, linewidth }));
  segments.frustumCulled = false;
  segments.visible = false;
  scene.add(segments);
  return segments;
}

const linear = new THREE.Color();
const toLinear = ([r, g, b]) => linear.setRGB(r / 255, g / 255, b / 255, THREE.SRGBColorSpace).toArray();

/** Blend a colour with the background, so that uncertain boxes look fainter. */
function blend(colour, opacity) {
  const background = getTheme() === "dark" ? 17 : 245;
  return colour.map((c) => background + (c - background) * opacity);
}

function setLines(target, boxes) {
  const positions = [], colours = [];
  for (const { box, colour } of boxes) {
    const corners = computeCorners(box), shade = toLinear(colour);
    for (const [a, b] of EDGES) {
      positions.push(...corners[a], ...corners[b]);
      colours.push(...shade, ...shade);
    }
  }
  target.visible = positions.length > 0;
  if (!target.visible) return;
  target.geometry.dispose();
  target.geometry = new LineSegmentsGeometry();
  target.geometry.setPositions(positions);
  target.geometry.setColors(colours);
}

function setFrontFaces(boxes) {
  const positions = [], colours = [];
  for (const { box, colour } of boxes) {
    const corners = computeCorners(box);
    for (const k of [0, 1, 5, 0, 5, 4]) positions.push(...corners[k]);
    for (let k = 0; k < 6; k++) colours.push(...toLinear(colour));
  }
  frontFaces.geometry.dispose();
  frontFaces.geometry = new THREE.BufferGeometry();
  frontFaces.geometry.setAttribute("position", new THREE.Float32BufferAttribute(positions, 3));
  frontFaces.geometry.setAttribute("color", new THREE.Float32BufferAttribute(colours, 3));
}

/** Compute the last positions of a track in the sensor frame at `frame`. Without poses, each position is in
 * the sensor frame at its own time. */
function computeTrail(track, frame = store.frame) {
  if (track.trails) return track.trails[frame] ?? []; // the tracker has published them
  const { frames } = store.drive, currentPose = frames[frame].pose, positions = [];
  for (let i = Math.max(0, frame - TRAIL_FRAMES); i <= frame; i++) {
    const box = track.byFrame.get(i)?.box;
    if (!box) continue;
    const { pose } = frames[i];
    positions.push(currentPose && pose ? toSensorFrame(toFixedFrame(box, pose), currentPose)
      : box.slice(0, 3));
  }
  return positions;
}

function setTrails(boxes) {
  const positions = [], colours = [];
  for (const { track, colour } of boxes) {
    if (!track) continue;
    const trail = computeTrail(track);
    const fadeAt = (k) => toLinear(blend(colour, 0.3 + 0.7 * k / trail.length));
    for (let k = 1; k < trail.length; k++) {
      positions.push(...trail[k - 1], ...trail[k]);
      colours.push(...fadeAt(k - 1), ...fadeAt(k));
    }
  }
  trails.geometry.dispose();
  trails.geometry = new THREE.BufferGeometry();
  trails.geometry.setAttribute("position", new THREE.Float32BufferAttribute(positions, 3));
  trails.geometry.setAttribute("color", new THREE.Float32BufferAttribute(colours, 3));
}

function rebuild() {
  if (!store.drive) return;
  const normal = [], emphasized = [];
  const showsTracks = store.mode === "label" || store.layers.tracks;
  for (const shown of showsTracks ? listShownBoxes() : []) {
    const { track, box, kind, colour } = shown, isSelected = track.id === store.selected;
    const opacity = track.state === "accepted" ? 1 : track.state === "rejected" ? 0.35
      : OPACITY_BY_KIND[kind];
    const item = { track, box, colour: isSelected ? SELECTION_COLOUR[getTheme()] : blend(rgb(colour), opacity) };
    const isEmphasized = isSelected || store.alsoSelected.has(track.id) || track.id === store.hover;
    (isEmphasized ? emphasized : normal).push(item);
  }
  for (const { box, colour, emphasized: isError, isSelected } of listShownResults()) {
    const item = { box, colour: isSelected ? SELECTION_COLOUR[getTheme()] : rgb(colour) };
    (isError || isSelected ? emphasized : normal).push(item);
  }
  setLines(thinLines, normal);
  setLines(thickLines, emphasized);
  setFrontFaces([...normal, ...emphasized]);
  setTrails(store.mode === "view" && !store.layers.trails ? [] : store.mode === "view"
    ? [...normal, ...emphasized] : emphasized);
  draw();
}

on("tracks frame selection hover draft theme drive results layers", rebuild);
