// The 3D view with a cloud, boxes and a camera. It is drawn only after changes.

import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { getTheme } from "./colours.js";
import { beforeDrawing } from "./dom.js";
import { highlightPoints, openPoints, render, setPointSize, setPoints, limitPoints } from "./points.js";
import { on, getSelectedBox, store } from "./store.js";

const MOVING_POINTS = 30_000; // number of random points to draw while the camera moves
const REST_MS = 160; // the camera stands still if it has not moved for this time
const BACKGROUND = { dark: 0x11151c, light: 0xf5f7fa };
const RING_RADII_M = [10, 20, 40, 60, 80];

const canvas = document.getElementById("scene"), isSoftware = isSoftwareRendered();
export const renderer = new THREE.WebGLRenderer({ canvas, antialias: !isSoftware });
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

/** Return true if there is no GPU. Antialiasing would then take two thirds of the drawing time. */
function isSoftwareRendered() {
  const gl = document.createElement("canvas").getContext("webgl2");
  const extension = gl?.getExtension("WEBGL_debug_renderer_info");
  const name = extension ? gl.getParameter(extension.UNMASKED_RENDERER_WEBGL) : "";
  gl?.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|software/i.test(name);
}

/** Functions that are called after each drawing, for overlays. */
export const afterDrawing = [];

let restTimer = 0, isCameraStill = true;

export const draw = beforeDrawing(() => {
  render(renderer, scene, camera, isSoftware && isCameraStill && !store.playing);
  for (const callback of afterDrawing) callback();
});

function onCameraMove() {
  if (isCameraStill) setMoving(true);
  clearTimeout(restTimer);
  restTimer = setTimeout(() => setMoving(false), REST_MS);
  draw();
}
controls.addEventListener("change", onCameraMove);

function setMoving(isMoving) {
  isCameraStill = !isMoving;
  const count = store.cloud?.count ?? 0;
  limitPoints(isMoving || store.playing ? Math.min(MOVING_POINTS, count) : count);
  draw();
}

function setCloud() {
  if (!store.cloud) return;
  setPoints();
  setRings(store.cloud.floor);
  onCameraMove(); // draws few points first, then all of them
}

function repaint() {
  if (!store.cloud) return;
  setPoints();
  draw();
}

/** Highlight one cluster of the cloud, or none if it is 0. */
export function highlightCluster(cluster) {
  if (store.cloud && highlightPoints(cluster)) draw();
}

function setRings(floor) {
  const positions = [];
  for (const radius of RING_RADII_M) {
    const steps = 96;
    for (let k = 0; k < steps; k++) {
      for (const end of [k, k + 1]) {
        const angle = end / steps * 2 * Math.PI;
        positions.push(radius * Math.cos(angle), radius * Math.sin(angle), floor);
      }
    }
  }
  positions.push(0, 0, floor, 3, 0, floor); // line in the forward direction
  rings.geometry.setAttribute("position", new THREE.Float32BufferAttribute(positions, 3));
}

function setTheme() {
  const themeName = getTheme();
  scene.background = new THREE.Color(BACKGROUND[themeName]);
  rings.material.color.set(themeName === "dark" ? 0x6b7a94 : 0x8a97ab);
  rings.material.opacity = themeName === "dark" ? 0.35 : 0.5;
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

/** Show the initial view: from behind the sensor, looking forward. */
export function resetView() {
  camera.position.set(-16, 0, 12);
  controls.target.set(8, 0, -1);
  controls.update();
  draw();
}

/** Look at a target from a position, both in the sensor frame. */
export function lookAt(target, position) {
  controls.target.fromArray(target);
  camera.position.fromArray(position);
  controls.update();
  camera.updateMatrixWorld();
  draw();
}

export function showTopView() {
  const { target } = controls;
  camera.position.set(target.x - 0.01, target.y, target.z + Math.max(20, getDistance()));
  controls.update();
}

/** Zoom in on the selected box without changing the viewing direction. */
export function focusSelection() {
  const box = getSelectedBox()?.box;
  if (!box) return;
  const target = new THREE.Vector3(box[0], box[1], box[2]);
  const offset = camera.position.clone().sub(controls.target);
  offset.setLength(Math.max(5, 2.6 * Math.max(box[3], box[4], box[5])));
  offset.z = Math.max(offset.z, 0.45 * offset.length());
  controls.target.copy(target);
  camera.position.copy(target.clone().add(offset));
  controls.update();
}

const getDistance = () => camera.position.distanceTo(controls.target);

/** Move the camera along the ground by fractions of its distance to the target, rotate it around the target,
 * or scale the distance. */
export function moveCamera(right, ahead, rotation = 0, distanceScale = 1) {
  const offset = camera.position.clone().sub(controls.target);
  const forward = new THREE.Vector3(-offset.x, -offset.y, 0).normalize();
  const side = new THREE.Vector3(forward.y, -forward.x, 0);
  controls.target.addScaledVector(forward, ahead * getDistance()).addScaledVector(side, right * getDistance());
  offset.applyAxisAngle(camera.up, rotation).multiplyScalar(distanceScale);
  camera.position.copy(controls.target).add(offset);
  controls.update();
}

/** Start drawing. */
export function openScene() {
  new ResizeObserver(resize).observe(canvas.parentElement);
  matchMedia("(prefers-color-scheme: light)").addEventListener("change", setTheme);
  on("theme", setTheme);
  on("cloud", setCloud);
  on("colour", repaint);
  on("playing", () => setMoving(!isCameraStill));
  on("tracks draft", () => { if (store.colour === "class") repaint(); });
  setTheme();
  resize();
  resetView();
}
