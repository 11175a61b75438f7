// The 3D view: one cloud, the boxes, a camera. It is drawn only after changes.

import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { theme } from "./colours.js";
import { beforeDrawing } from "./dom.js";
import { markPoints, openPoints, pointCount, render, setPointSize, setPoints, thinTo } from "./points.js";
import { on, selectedBox, store } from "./store.js";

// Points drawn while the camera moves; their order is random.
export const limits = { thinned: 30_000 };
const REST_MS = 160;
const BACKGROUND = { dark: 0x11151c, light: 0xf5f7fa };
const RINGS = [10, 20, 40, 60, 80];

const canvas = document.getElementById("scene"), software = drawsInSoftware();
export const renderer = new THREE.WebGLRenderer({ canvas, antialias: !software });
export const scene = new THREE.Scene();
export const camera = new THREE.PerspectiveCamera(50, 1, 0.3, 600);
camera.up.set(0, 0, 1);
export const controls = new OrbitControls(camera, canvas);
controls.zoomToCursor = true;
controls.enableDamping = false;
controls.maxPolarAngle = Math.PI * 0.495;
controls.minDistance = 1;
controls.maxDistance = 250;

openPoints(scene);
const rings = new THREE.LineSegments(new THREE.BufferGeometry(),
                                     new THREE.LineBasicMaterial({ transparent: true }));
rings.frustumCulled = false;
scene.add(rings);

/** True without a GPU; antialiasing would then take two thirds of the drawing time. */
function drawsInSoftware() {
  const gl = document.createElement("canvas").getContext("webgl2");
  const known = gl?.getExtension("WEBGL_debug_renderer_info");
  const name = known ? gl.getParameter(known.UNMASKED_RENDERER_WEBGL) : "";
  gl?.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|software/i.test(name);
}

/** Functions that are called after each drawing, for overlays. */
export const afterDrawing = [];
export const drawn = { ms: 0, pictures: 0, points: 0 }; // the last drawing, for measurements

let resting = 0, still = true;

export const draw = beforeDrawing(() => {
  const start = performance.now();
  render(renderer, scene, camera, software && still && !store.playing);
  for (const then of afterDrawing) then();
  drawn.ms = performance.now() - start;
  drawn.pictures += 1;
  drawn.points = pointCount();
});

function moving() {
  if (still) thin(true);
  clearTimeout(resting);
  resting = setTimeout(() => thin(false), REST_MS);
  draw();
}
controls.addEventListener("change", moving);

function thin(yes) {
  still = !yes;
  const all = store.cloud?.count ?? 0;
  thinTo(yes || store.playing ? Math.min(limits.thinned, all) : all);
  draw();
}

function setCloud() {
  if (!store.cloud) return;
  setPoints();
  setRings(store.cloud.floor);
  moving(); // thinned at first, then all points
}

function repaint() {
  if (!store.cloud) return;
  setPoints();
  draw();
}

/** Highlight one cluster of the cloud; 0 for none. */
export function mark(cluster) {
  if (store.cloud && markPoints(cluster)) draw();
}

function setRings(floor) {
  const at = [];
  for (const radius of RINGS) {
    const steps = 96;
    for (let k = 0; k < steps; k++) {
      for (const end of [k, k + 1]) {
        const angle = end / steps * 2 * Math.PI;
        at.push(radius * Math.cos(angle), radius * Math.sin(angle), floor);
      }
    }
  }
  at.push(0, 0, floor, 3, 0, floor); // the forward direction
  rings.geometry.setAttribute("position", new THREE.Float32BufferAttribute(at, 3));
}

function setTheme() {
  const which = theme();
  scene.background = new THREE.Color(BACKGROUND[which]);
  rings.material.color.set(which === "dark" ? 0x6b7a94 : 0x8a97ab);
  rings.material.opacity = which === "dark" ? 0.35 : 0.5;
  repaint();
}

function resize() {
  const { clientWidth: width, clientHeight: height } = canvas.parentElement;
  if (!width || !height) return;
  const ratio = Math.min(devicePixelRatio, 2);
  renderer.setPixelRatio(ratio);
  renderer.setSize(width, height, false);
  setPointSize(1.6 * ratio);
  camera.aspect = width / height;
  camera.updateProjectionMatrix();
  draw();
}

/** The initial view: from behind the sensor, forward. */
export function resetView() {
  camera.position.set(-16, 0, 12);
  controls.target.set(8, 0, -1);
  controls.update();
  draw();
}

/** Look at a position from another, both in the sensor's frame. */
export function lookAt(place, from) {
  controls.target.fromArray(place);
  camera.position.fromArray(from);
  controls.update();
  camera.updateMatrixWorld();
  draw();
}

export function topView() {
  const { target } = controls;
  camera.position.set(target.x - 0.01, target.y, target.z + Math.max(20, distance()));
  controls.update();
}

/** Zoom in on the selected box, keeping the direction of view. */
export function focus() {
  const box = selectedBox()?.box;
  if (!box) return;
  const target = new THREE.Vector3(box[0], box[1], box[2]);
  const away = camera.position.clone().sub(controls.target);
  away.setLength(Math.max(5, 2.6 * Math.max(box[3], box[4], box[5])));
  away.z = Math.max(away.z, 0.45 * away.length());
  controls.target.copy(target);
  camera.position.copy(target.clone().add(away));
  controls.update();
}

const distance = () => camera.position.distanceTo(controls.target);

/** Move the camera along the ground by shares of its distance, turn it, or scale its distance. */
export function fly(right, ahead, turn = 0, nearer = 1) {
  const away = camera.position.clone().sub(controls.target);
  const level = new THREE.Vector3(-away.x, -away.y, 0).normalize();
  const side = new THREE.Vector3(level.y, -level.x, 0);
  controls.target.addScaledVector(level, ahead * distance()).addScaledVector(side, right * distance());
  away.applyAxisAngle(camera.up, turn).multiplyScalar(nearer);
  camera.position.copy(controls.target).add(away);
  controls.update();
}

/** Start drawing. */
export function openScene() {
  new ResizeObserver(resize).observe(canvas.parentElement);
  matchMedia("(prefers-color-scheme: light)").addEventListener("change", setTheme);
  on("theme", setTheme);
  on("cloud", setCloud);
  on("colour", repaint);
  on("playing", () => thin(!still));
  on("tracks draft", () => { if (store.colour === "class") repaint(); });
  setTheme();
  resize();
  resetView();
}
