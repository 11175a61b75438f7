// Picking of the point or box under the pointer.

import * as THREE from "three";
import { intersectBox } from "./boxmath.js";
import { listShownBoxes } from "./colours.js";
import { camera, renderer } from "./scene.js";
import { listShownResults } from "./results.js";
import { on, store } from "./store.js";

const PICK_RADIUS_PX = 9;
const vector = new THREE.Vector3(), matrix = new THREE.Matrix4();

/** Return the ray {origin, direction} through a position on the page. */
export function castRay(clientX, clientY) {
  const area = renderer.domElement.getBoundingClientRect();
  vector.set((clientX - area.left) / area.width * 2 - 1, 1 - (clientY - area.top) / area.height * 2, 0.5)
    .unproject(camera).sub(camera.position).normalize();
  return { origin: camera.position.toArray(), direction: vector.toArray() };
}

/** Project a point in the sensor frame to pixels. Returns null if it is behind the camera. */
export function project(x, y, z) {
  const area = renderer.domElement;
  vector.set(x, y, z).applyMatrix4(camera.matrixWorldInverse);
  if (vector.z > -camera.near) return null;
  vector.applyMatrix4(camera.projectionMatrix);
  return [(vector.x + 1) / 2 * area.clientWidth, (1 - vector.y) / 2 * area.clientHeight];
}

/** Return the index of the point under the pointer, or -1.
 *
 * Among the points within PICK_RADIUS_PX, it is the point nearest to the camera, unless a point slightly
 * behind it is nearer to the pointer. Testing all points is faster than building a tree for every frame. */
export function findPointAt(clientX, clientY) {
  const { cloud } = store;
  if (!cloud) return -1;
  const area = renderer.domElement.getBoundingClientRect();
  const m = matrix.multiplyMatrices(camera.projectionMatrix, camera.matrixWorldInverse).elements;
  const [a, b, c, d] = [m[3], m[7], m[11], m[15]]; // coefficients of the depth
  // Coefficients of the offset from the pointer in units of PICK_RADIUS_PX, multiplied by the depth.
  const projectOffset = (row, pointer, halfSize) => [0, 1, 2, 3].map((k) =>
    (m[row + 4 * k] - pointer * m[3 + 4 * k]) * halfSize / PICK_RADIUS_PX);
  const [ax, bx, cx, dx] = projectOffset(0, (clientX - area.left) / area.width * 2 - 1, area.width / 2);
  const [ay, by, cy, dy] = projectOffset(1, 1 - (clientY - area.top) / area.height * 2, area.height / 2);
  const { xyz, count, ground } = cloud, { near } = camera;
  let nearest = -1, minCost = Infinity;
  for (let i = 0, k = 0; i < count; i++, k += 3) {
    const x = xyz[k], y = xyz[k + 1], z = xyz[k + 2], depth = a * x + b * y + c * z + d;
    const right = ax * x + bx * y + cx * z + dx;
    if (right > depth || right < -depth) continue;
    const up = ay * x + by * y + cy * z + dy, squaredOffset = right * right + up * up;
    if (squaredOffset > depth * depth || depth < near) continue;
    const cost = (depth + squaredOffset / depth) * (ground[i] ? 1.15 : 1);
    if (cost < minCost) { minCost = cost; nearest = i; }
  }
  return nearest;
}

/** Find the nearest box under the pointer. Returns {track, result} with a track id, or a label or detection;
 * both are null if there is no box. */
export function findBoxAt(clientX, clientY) {
  const { origin, direction } = castRay(clientX, clientY), isView = store.mode === "view";
  const boxes = isView && !store.layers.tracks ? [] : listShownBoxes();
  let nearest = { track: null, result: null }, minDistance = Infinity;
  for (const entry of isView ? [...boxes, ...listShownResults()] : boxes) {
    const distance = intersectBox(origin, direction, entry.box);
    if (distance === null || distance >= minDistance) continue;
    minDistance = distance;
    nearest = entry.track ? { track: entry.track.id, result: null } : { track: null, result: entry };
  }
  return nearest;
}

const WARM_UP_PICKS = 4; // number of picks after which the browser has compiled the loop
let warmUpCount = 0;

/** Pick while the page is idle, because the first picks take ten times as long as later ones. */
function warmUp() {
  if (!store.cloud?.count || warmUpCount >= WARM_UP_PICKS) return;
  const area = renderer.domElement.getBoundingClientRect();
  findPointAt(area.left + area.width / 2, area.top + area.height / 2);
  warmUpCount += 1;
  requestIdle(warmUp);
}

const requestIdle = globalThis.requestIdleCallback ?? ((callback) => setTimeout(callback, 50));
on("cloud", () => requestIdle(warmUp));
