// Pure functions on boxes [x y z l w h yaw] (centre and size in metres, yaw in radians, z up).

const MIN_SIZE_M = 0.1;

function wrapAngle(angle) {
  return angle - 2 * Math.PI * Math.floor((angle + Math.PI) / (2 * Math.PI));
}

/** Compute the unit vector of a local axis (0 length, 1 width, 2 height) in the sensor frame. */
export function computeAxis(box, axis) {
  const c = Math.cos(box[6]), s = Math.sin(box[6]);
  return axis === 0 ? [c, s, 0] : axis === 1 ? [-s, c, 0] : [0, 0, 1];
}

/** Move one face outwards by delta metres. The opposite face stays in place. */
export function moveFace(box, axis, sign, delta) {
  const growth = Math.max(MIN_SIZE_M, box[3 + axis] + delta) - box[3 + axis];
  const direction = computeAxis(box, axis), newBox = box.slice();
  for (let k = 0; k < 3; k++) newBox[k] += direction[k] * sign * growth / 2;
  newBox[3 + axis] += growth;
  return newBox;
}

export function translate(box, dx, dy, dz) {
  const newBox = box.slice();
  newBox[0] += dx; newBox[1] += dy; newBox[2] += dz;
  return newBox;
}

/** Move a box along its own axes. */
export function moveAlongAxes(box, forward, left, up) {
  const c = Math.cos(box[6]), s = Math.sin(box[6]);
  return translate(box, c * forward - s * left, s * forward + c * left, up);
}

export function rotate(box, angle) {
  const newBox = box.slice();
  newBox[6] = wrapAngle(box[6] + angle);
  return newBox;
}

/** Transform a point from the sensor frame to the axes of a box, relative to its centre. */
export function toLocal(box, x, y, z) {
  const c = Math.cos(box[6]), s = Math.sin(box[6]), dx = x - box[0], dy = y - box[1];
  return [c * dx + s * dy, -s * dx + c * dy, z - box[2]];
}

export function toWorld(box, u, v, w) {
  const c = Math.cos(box[6]), s = Math.sin(box[6]);
  return [box[0] + c * u - s * v, box[1] + s * u + c * v, box[2] + w];
}

const SIGNS = [[1, 1, -1], [1, -1, -1], [-1, -1, -1], [-1, 1, -1],
               [1, 1, 1], [1, -1, 1], [-1, -1, 1], [-1, 1, 1]];

/** Compute the eight corners: four at the bottom, then four at the top. The first two of each are at the
 * front. */
export function computeCorners(box) {
  return SIGNS.map(([a, b, c]) => toWorld(box, a * box[3] / 2, b * box[4] / 2, c * box[5] / 2));
}

export const EDGES = [[0, 1], [1, 2], [2, 3], [3, 0], [4, 5], [5, 6], [6, 7], [7, 4],
                      [0, 4], [1, 5], [2, 6], [3, 7]];

/** Intersect a ray with a box. Returns the distance along the ray, or null. */
export function intersectBox(origin, direction, box) {
  const o = toLocal(box, ...origin), c = Math.cos(box[6]), s = Math.sin(box[6]);
  const d = [c * direction[0] + s * direction[1], -s * direction[0] + c * direction[1],
             direction[2]];
  let entry = 0, exit = Infinity;
  for (let k = 0; k < 3; k++) {
    const halfSize = box[3 + k] / 2, a = (-halfSize - o[k]) / d[k], b = (halfSize - o[k]) / d[k];
    entry = Math.max(entry, Math.min(a, b));
    exit = Math.min(exit, Math.max(a, b));
  }
  return entry <= exit ? entry : null;
}

/** Find the point on the line p + t a (unit vector a) that is nearest to a ray. Returns t, or null if line
 * and ray are parallel. */
export function findNearestOnLine(p, a, origin, direction) {
  const dot = (u, v) => u[0] * v[0] + u[1] * v[1] + u[2] * v[2];
  const w = [p[0] - origin[0], p[1] - origin[1], p[2] - origin[2]];
  const b = dot(a, direction), c = dot(direction, direction), denominator = c - b * b;
  return denominator < 1e-4 * c ? null : (b * dot(direction, w) - c * dot(a, w)) / denominator;
}

/** Intersect a ray with the horizontal plane at height z. Returns the point, or null. */
export function intersectLevel(origin, direction, z) {
  const t = (z - origin[2]) / direction[2];
  return t > 0 && Number.isFinite(t)
    ? [origin[0] + t * direction[0], origin[1] + t * direction[1], z] : null;
}

/** Transform a box from the sensor frame to the fixed frame, ignoring roll and pitch. The pose is a 4 x 4
 * matrix as 16 numbers, row by row. */
export function toFixedFrame(box, pose) {
  const [x, y, z] = box, fixedBox = box.slice();
  for (let k = 0; k < 3; k++) {
    fixedBox[k] = pose[4 * k] * x + pose[4 * k + 1] * y + pose[4 * k + 2] * z + pose[4 * k + 3];
  }
  fixedBox[6] = wrapAngle(box[6] + Math.atan2(pose[4], pose[0]));
  return fixedBox;
}

/** Transform a point (x, y, z) from the fixed frame to the frame of a sensor with this pose. */
export function toSensorFrame(point, pose) {
  const d = [point[0] - pose[3], point[1] - pose[7], point[2] - pose[11]];
  return [0, 1, 2].map((k) => pose[k] * d[0] + pose[4 + k] * d[1] + pose[8 + k] * d[2]);
}
