// The cloud in the 3D view. Without a GPU, drawing all points takes 0.1 s. Their image and depth are therefore
// cached while the camera stands still, and everything else is drawn over the cached image.

import * as THREE from "three";
import { HIGHLIGHT, paintCloud, rgb, getTheme } from "./colours.js";
import { store } from "./store.js";

const size = { value: 2 }; // size of a distant point in pixels
const vertexShader = `attribute vec4 colour; uniform float size, depthOffset; varying vec3 shade;
  void main() { shade = colour.rgb; gl_Position = projectionMatrix * modelViewMatrix
    * vec4(position, 1.0); gl_Position.z -= depthOffset * gl_Position.w;
    gl_PointSize = size * clamp(28.0 / gl_Position.w, 1.0, 2.5); }`;
const fragmentShader = "varying vec3 shade; void main() { gl_FragColor = vec4(shade, 1.0); }";

const makePoints = (depthOffset) => new THREE.Points(new THREE.BufferGeometry(), new THREE.ShaderMaterial({
  uniforms: { size, depthOffset: { value: depthOffset } }, vertexShader, fragmentShader }));
const points = makePoints(0), highlighted = makePoints(1e-4);

const target = new THREE.WebGLRenderTarget(1, 1, {
  depthTexture: new THREE.DepthTexture(1, 1), minFilter: THREE.NearestFilter,
  magFilter: THREE.NearestFilter });
const cachedImage = new THREE.Mesh(new THREE.PlaneGeometry(2, 2), new THREE.ShaderMaterial({
  uniforms: { colour: { value: target.texture }, depth: { value: target.depthTexture } },
  vertexShader: "void main() { gl_Position = vec4(position.xy, 0.0, 1.0); }",
  fragmentShader: `uniform sampler2D colour; uniform highp sampler2D depth;
    void main() { ivec2 at = ivec2(gl_FragCoord.xy); float far = texelFetch(depth, at, 0).r;
      if (far == 1.0) discard;
      gl_FragColor = texelFetch(colour, at, 0); gl_FragDepth = far; }`,
  depthFunc: THREE.AlwaysDepth,
}));
cachedImage.renderOrder = -1; // drawn first, so that depth tests are correct

let shownCloud = null, highlightedCluster = 0, paintCount = 0, maxPoints = Infinity, cacheKey = "";

export function openPoints(scene) {
  for (const object of [points, highlighted, cachedImage]) {
    object.frustumCulled = false;
    scene.add(object);
  }
}

/** Show the cloud of the frame in the current colour scheme. */
export function setPoints() {
  const { cloud } = store;
  if (cloud !== shownCloud) {
    shownCloud = cloud;
    setGeometry(points, cloud.xyz, new Uint8Array(4 * cloud.count));
    limitPoints(maxPoints);
    highlightPoints(0);
  }
  const colour = points.geometry.getAttribute("colour");
  paintCloud(colour.array, cloud, store.colour);
  colour.needsUpdate = true;
  paintCount += 1;
}

/** Highlight the points of one cluster, or none if it is 0. Returns true if the highlight has changed. */
export function highlightPoints(cluster) {
  if (cluster === highlightedCluster) return false;
  highlightedCluster = cluster;
  const positions = [];
  for (let i = 0; cluster && i < shownCloud.count; i++) {
    if (shownCloud.cluster[i] === cluster) positions.push(...shownCloud.xyz.subarray(3 * i, 3 * i + 3));
  }
  setGeometry(highlighted, new Float32Array(positions), new Uint8Array(positions.length / 3 * 4));
  const colour = highlighted.geometry.getAttribute("colour"), highlight = [...rgb(HIGHLIGHT[getTheme()]), 255];
  for (let i = 0; i < colour.count; i++) colour.array.set(highlight, 4 * i);
  return true;
}

function setGeometry(object, xyz, colours) {
  object.geometry.dispose();
  object.geometry = new THREE.BufferGeometry();
  object.geometry.setAttribute("position", new THREE.BufferAttribute(xyz, 3));
  object.geometry.setAttribute("colour", new THREE.BufferAttribute(colours, 4, true));
}

/** Draw only the first `count` points of this and later clouds. The points are in random order. */
export function limitPoints(count) {
  maxPoints = count;
  points.geometry.setDrawRange(0, count);
}
export const getPointCount = () => Math.min(points.geometry.drawRange.count, shownCloud?.count ?? 0);
export const setPointSize = (pixels) => { size.value = pixels; };

/** Draw the scene. If useCache is true, the points are drawn from a cached image, which is updated if the
 * points or the view have changed. */
export function render(renderer, scene, camera, useCache) {
  cachedImage.visible = useCache;
  points.visible = !useCache;
  if (useCache) updateCachedImage(renderer, camera);
  renderer.render(scene, camera);
}

function updateCachedImage(renderer, camera) {
  const { width, height } = renderer.domElement;
  camera.updateMatrixWorld();
  const key = [paintCount, getPointCount(), width, height, size.value, ...camera.matrixWorld.elements,
               ...camera.projectionMatrix.elements].join(" ");
  if (key === cacheKey) return;
  cacheKey = key;
  target.setSize(width, height);
  points.visible = true;
  renderer.setRenderTarget(target);
  renderer.render(points, camera);
  renderer.setRenderTarget(null);
  points.visible = false;
}
