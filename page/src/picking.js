// Picking: finds the point of the cloud, or the box, under the pointer.

import * as THREE from "three";
import { rayBox } from "./boxmath.js";
import { shownBoxes } from "./colours.js";
import { camera, renderer } from "./scene.js";
import { resultBoxes } from "./results.js";
import { on, store } from "./store.js";

const REACH = 9; // pixels around the pointer
const ahead = new THREE.Vector3(), matrix = new THREE.Matrix4();

/** The ray through a position on the page: {origin, direction}. */
export function rayAt(clientX, clientY) {
  const area = renderer.domElement.getBoundingClientRect();
  ahead.set((clientX - area.left) / area.width * 2 - 1, 1 - (clientY - area.top) / area.height * 2, 0.5)
    .unproject(camera).sub(camera.position).normalize();
  return { origin: camera.position.toArray(), direction: ahead.toArray() };
}

/** Project a point of the sensor's frame to pixels; null behind the camera. */
export function project(x, y, z) {
  const area = renderer.domElement;
  ahead.set(x, y, z).applyMatrix4(camera.matrixWorldInverse);
  if (ahead.z > -camera.near) return null;
  ahead.applyMatrix4(camera.projectionMatrix);
  return [(ahead.x + 1) / 2 * area.clientWidth, (1 - ahead.y) / 2 * area.clientHeight];
}

/** Index of the point under the pointer, or -1: among the points within REACH the nearest to the
 * camera, unless one slightly behind is nearer to the pointer. Testing all points costs less than
 * building a tree for every frame. */
export function pointAt(clientX, clientY) {
  const { cloud } = store;
  if (!cloud) return -1;
  const area = renderer.domElement.getBoundingClientRect();
  const m = matrix.multiplyMatrices(camera.projectionMatrix, camera.matrixWorldInverse).elements;
  const [a, b, c, d] = [m[3], m[7], m[11], m[15]]; // gives the depth
  const aside = (row, at, half) => [0, 1, 2, 3].map((k) =>
    (m[row + 4 * k] - at * m[3 + 4 * k]) * half / REACH); // gives depth x reaches from the pointer
  const [ax, bx, cx, dx] = aside(0, (clientX - area.left) / area.width * 2 - 1, area.width / 2);
  const [ay, by, cy, dy] = aside(1, 1 - (clientY - area.top) / area.height * 2, area.height / 2);
  const { xyz, count, ground } = cloud, { near } = camera;
  let best = -1, least = Infinity;
  for (let i = 0, k = 0; i < count; i++, k += 3) {
    const x = xyz[k], y = xyz[k + 1], z = xyz[k + 2], depth = a * x + b * y + c * z + d;
    const right = ax * x + bx * y + cx * z + dx;
    if (right > depth || right < -depth) continue;
    const up = ay * x + by * y + cy * z + dy, off = right * right + up * up;
    if (off > depth * depth || depth < near) continue;
    const cost = (depth + off / depth) * (ground[i] ? 1.15 : 1);
    if (cost < least) { least = cost; best = i; }
  }
  return best;
}

/** The nearest box under the pointer: {track, found}, the id of a track, or a label or detection;
 * null where it is not. */
export function hitAt(clientX, clientY) {
  const { origin, direction } = rayAt(clientX, clientY), view = store.mode === "view";
  const boxes = view && !store.layers.tracks ? [] : shownBoxes();
  let best = { track: null, found: null }, least = Infinity;
  for (const entry of view ? [...boxes, ...resultBoxes()] : boxes) {
    const along = rayBox(origin, direction, entry.box);
    if (along === null || along >= least) continue;
    least = along;
    best = entry.track ? { track: entry.track.id, found: null } : { track: null, found: entry };
  }
  return best;
}

const WARM_UPS = 4; // picks until the browser has compiled the loop
let warmed = 0;

/** Pick while idle: the first picks take ten times as long as later ones. */
function warmUp() {
  if (!store.cloud?.count || warmed >= WARM_UPS) return;
  const area = renderer.domElement.getBoundingClientRect();
  pointAt(area.left + area.width / 2, area.top + area.height / 2);
  warmed += 1;
  requestIdle(warmUp);
}

const requestIdle = globalThis.requestIdleCallback ?? ((then) => setTimeout(then, 50));
on("cloud", () => requestIdle(warmUp));
