// The cloud in the 3D view. Without a GPU, drawing all points takes a tenth of a second, so while the
// camera stands still their image and depth are cached, and everything else is drawn over it.

import * as THREE from "three";
import { SEEN, paint, rgb, theme } from "./colours.js";
import { store } from "./store.js";

const size = { value: 2 }; // pixels of a distant point
const vertexShader = `attribute vec4 colour; uniform float size, nearer; varying vec3 shade;
  void main() { shade = colour.rgb; gl_Position = projectionMatrix * modelViewMatrix
    * vec4(position, 1.0); gl_Position.z -= nearer * gl_Position.w;
    gl_PointSize = size * clamp(28.0 / gl_Position.w, 1.0, 2.5); }`;
const fragmentShader = "varying vec3 shade; void main() { gl_FragColor = vec4(shade, 1.0); }";

const drawnAs = (nearer) => new THREE.Points(new THREE.BufferGeometry(), new THREE.ShaderMaterial({
  uniforms: { size, nearer: { value: nearer } }, vertexShader, fragmentShader }));
const points = drawnAs(0), chosen = drawnAs(1e-4);

const target = new THREE.WebGLRenderTarget(1, 1, {
  depthTexture: new THREE.DepthTexture(1, 1), minFilter: THREE.NearestFilter,
  magFilter: THREE.NearestFilter });
const kept = new THREE.Mesh(new THREE.PlaneGeometry(2, 2), new THREE.ShaderMaterial({
  uniforms: { colour: { value: target.texture }, depth: { value: target.depthTexture } },
  vertexShader: "void main() { gl_Position = vec4(position.xy, 0.0, 1.0); }",
  fragmentShader: `uniform sampler2D colour; uniform highp sampler2D depth;
    void main() { ivec2 at = ivec2(gl_FragCoord.xy); float far = texelFetch(depth, at, 0).r;
      if (far == 1.0) discard;
      gl_FragColor = texelFetch(colour, at, 0); gl_FragDepth = far; }`,
  depthFunc: THREE.AlwaysDepth,
}));
kept.renderOrder = -1; // first, for correct depth tests

let shown = null, marked = 0, painted = 0, most = Infinity, keptAs = "";

export function openPoints(scene) {
  for (const thing of [points, chosen, kept]) {
    thing.frustumCulled = false;
    scene.add(thing);
  }
}

/** Show the cloud of the frame, coloured. */
export function setPoints() {
  const { cloud } = store;
  if (cloud !== shown) {
    shown = cloud;
    setGeometry(points, cloud.xyz, new Uint8Array(4 * cloud.count));
    thinTo(most);
    markPoints(0);
  }
  const colour = points.geometry.getAttribute("colour");
  paint(colour.array, cloud, store.colour);
  colour.needsUpdate = true;
  painted += 1;
}

/** Highlight the points of one cluster; 0 for none. Returns true if that is a change. */
export function markPoints(cluster) {
  if (cluster === marked) return false;
  marked = cluster;
  const at = [];
  for (let i = 0; cluster && i < shown.count; i++) {
    if (shown.cluster[i] === cluster) at.push(...shown.xyz.subarray(3 * i, 3 * i + 3));
  }
  setGeometry(chosen, new Float32Array(at), new Uint8Array(at.length / 3 * 4));
  const colour = chosen.geometry.getAttribute("colour"), seen = [...rgb(SEEN[theme()]), 255];
  for (let i = 0; i < colour.count; i++) colour.array.set(seen, 4 * i);
  return true;
}

function setGeometry(thing, xyz, colours) {
  thing.geometry.dispose();
  thing.geometry = new THREE.BufferGeometry();
  thing.geometry.setAttribute("position", new THREE.BufferAttribute(xyz, 3));
  thing.geometry.setAttribute("colour", new THREE.BufferAttribute(colours, 4, true));
}

/** Draw only the first `count` points of this and later clouds; their order is random. */
export function thinTo(count) {
  most = count;
  points.geometry.setDrawRange(0, count);
}
export const pointCount = () => Math.min(points.geometry.drawRange.count, shown?.count ?? 0);
export const setPointSize = (pixels) => { size.value = pixels; };

/** Draw the scene. keep: use the cached image of the points, updated if they or the view changed. */
export function render(renderer, scene, camera, keep) {
  kept.visible = keep;
  points.visible = !keep;
  if (keep) keepPicture(renderer, camera);
  renderer.render(scene, camera);
}

function keepPicture(renderer, camera) {
  const { width, height } = renderer.domElement;
  camera.updateMatrixWorld();
  const as = [painted, pointCount(), width, height, size.value, ...camera.matrixWorld.elements,
              ...camera.projectionMatrix.elements].join(" ");
  if (as === keptAs) return;
  keptAs = as;
  target.setSize(width, height);
  points.visible = true;
  renderer.setRenderTarget(target);
  renderer.render(points, camera);
  renderer.setRenderTarget(null);
  points.visible = false;
}
