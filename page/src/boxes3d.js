// Boxes of the frame shown, as lines in the 3D view; the filled face is the front.

import * as THREE from "three";
import { LineMaterial } from "three/addons/lines/LineMaterial.js";
import { LineSegments2 } from "three/addons/lines/LineSegments2.js";
import { LineSegmentsGeometry } from "three/addons/lines/LineSegmentsGeometry.js";
import { EDGES, corners, intoPose, throughPose } from "./boxmath.js";
import { rgb, shownBoxes, theme } from "./colours.js";
import { resultBoxes } from "./results.js";
import { draw, scene } from "./scene.js";
import { on, store } from "./store.js";

const TRAIL = 30; // frames
const SELECTED = { dark: [255, 255, 255], light: [17, 24, 39] };
const FAINT = { proposed: 0.6, interpolated: 0.75, key: 1 };

const thin = lines(1.6), thick = lines(3.2);
const fronts = new THREE.Mesh(new THREE.BufferGeometry(), new THREE.MeshBasicMaterial({
  vertexColors: true, transparent: true, opacity: 0.28, side: THREE.DoubleSide, depthWrite: false,
}));
const trails = new THREE.LineSegments(new THREE.BufferGeometry(), new THREE.LineBasicMaterial({
  vertexColors: true, transparent: true, opacity: 0.9 }));
for (const thing of [fronts, trails]) {
  thing.frustumCulled = false;
  scene.add(thing);
}

function lines(linewidth) {
  const drawn = new LineSegments2(new LineSegmentsGeometry(),
                                  new LineMaterial({ vertexColors: true, linewidth }));
  drawn.frustumCulled = false;
  drawn.visible = false;
  scene.add(drawn);
  return drawn;
}

const linear = new THREE.Color();
const shade = ([r, g, b]) => linear.setRGB(r / 255, g / 255, b / 255, THREE.SRGBColorSpace).toArray();

/** Blend a colour with the background; less certain boxes are fainter. */
function faded(colour, share) {
  const back = theme() === "dark" ? 17 : 245;
  return colour.map((c) => back + (c - back) * share);
}

function setLines(target, boxes) {
  const at = [], colours = [];
  for (const { box, colour } of boxes) {
    const found = corners(box), shaded = shade(colour);
    for (const [a, b] of EDGES) {
      at.push(...found[a], ...found[b]);
      colours.push(...shaded, ...shaded);
    }
  }
  target.visible = at.length > 0;
  if (!target.visible) return;
  target.geometry.dispose();
  target.geometry = new LineSegmentsGeometry();
  target.geometry.setPositions(at);
  target.geometry.setColors(colours);
}

function setFronts(boxes) {
  const at = [], colours = [];
  for (const { box, colour } of boxes) {
    const found = corners(box);
    for (const k of [0, 1, 5, 0, 5, 4]) at.push(...found[k]);
    for (let k = 0; k < 6; k++) colours.push(...shade(colour));
  }
  fronts.geometry.dispose();
  fronts.geometry = new THREE.BufferGeometry();
  fronts.geometry.setAttribute("position", new THREE.Float32BufferAttribute(at, 3));
  fronts.geometry.setAttribute("color", new THREE.Float32BufferAttribute(colours, 3));
}

/** Positions of a track's last boxes in the coordinates of a frame; without poses, each in those of
 * its own frame. */
function trailOf(track, frame = store.frame) {
  if (track.trails) return track.trails[frame] ?? []; // published by the tracker
  const { frames } = store.drive, here = frames[frame].pose, found = [];
  for (let i = Math.max(0, frame - TRAIL); i <= frame; i++) {
    const box = track.byFrame.get(i)?.box;
    if (!box) continue;
    const { pose } = frames[i];
    found.push(here && pose ? intoPose(throughPose(box, pose), here) : box.slice(0, 3));
  }
  return found;
}

function setTrails(boxes) {
  const at = [], colours = [];
  for (const { track, colour } of boxes) {
    if (!track) continue;
    const trail = trailOf(track), fade = (k) => shade(faded(colour, 0.3 + 0.7 * k / trail.length));
    for (let k = 1; k < trail.length; k++) {
      at.push(...trail[k - 1], ...trail[k]);
      colours.push(...fade(k - 1), ...fade(k));
    }
  }
  trails.geometry.dispose();
  trails.geometry = new THREE.BufferGeometry();
  trails.geometry.setAttribute("position", new THREE.Float32BufferAttribute(at, 3));
  trails.geometry.setAttribute("color", new THREE.Float32BufferAttribute(colours, 3));
}

function rebuild() {
  if (!store.drive) return;
  const usual = [], strong = [];
  const withTracks = store.mode === "label" || store.layers.tracks;
  for (const shown of withTracks ? shownBoxes() : []) {
    const { track, box, kind, colour } = shown, chosen = track.id === store.selected;
    const sure = track.state === "accepted" ? 1 : track.state === "rejected" ? 0.35 : FAINT[kind];
    const entry = { track, box, colour: chosen ? SELECTED[theme()] : faded(rgb(colour), sure) };
    (chosen || store.also.has(track.id) || track.id === store.hover ? strong : usual).push(entry);
  }
  for (const { box, colour, strong: loud, chosen } of resultBoxes()) {
    (loud || chosen ? strong : usual).push({ box, colour: chosen ? SELECTED[theme()] : rgb(colour) });
  }
  setLines(thin, usual);
  setLines(thick, strong);
  setFronts([...usual, ...strong]);
  setTrails(store.mode === "view" && !store.layers.trails ? [] : store.mode === "view"
    ? [...usual, ...strong] : strong);
  draw();
}

on("tracks frame selection hover draft theme drive results layers", rebuild);
