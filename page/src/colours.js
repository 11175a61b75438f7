// Colours of points, classes and tracks, for a dark and a light page.

import { toLocal } from "./boxmath.js";
import { boxOf, classOf, store } from "./store.js";

const RAMPS = {
  dark: ["#3d4f7c", "#3286b8", "#2fb39a", "#a4d04f", "#fbdc5a"],
  light: ["#8fa0c0", "#2a6fb0", "#0f8377", "#5a8a12", "#b25c00"],
};
const MUTED = { dark: "#4a5568", light: "#b3bccb" };
const GROUND = { dark: "#333e52", light: "#cdd5e0" };
const THING = { dark: "#d7dee9", light: "#2d3a4f" };
export const SEEN = { dark: "#ffffff", light: "#000000" };
const ROAD = { dark: "#5b6f93", light: "#7d8fb0" };
const BRIGHT = 150; // of 255: brighter colours are darkened on a light page
const SPAN = 4; // metres above the ground over which height is coloured

export const rgb = (hex) => [1, 3, 5].map((k) => parseInt(hex.slice(k, k + 2), 16));

export function theme() {
  const chosen = document.documentElement.dataset.theme;
  if (chosen === "light" || chosen === "dark") return chosen;
  return matchMedia("(prefers-color-scheme: light)").matches ? "light" : "dark";
}

/** A colour as a 32-bit number. */
const packed = ([r, g, b]) => (r | g << 8 | b << 16) >>> 0;

function ramp(stops, steps = 256) {
  const table = new Uint32Array(steps), ends = stops.map(rgb);
  for (let i = 0; i < steps; i++) {
    const at = i / (steps - 1) * (ends.length - 1), k = Math.min(ends.length - 2, Math.floor(at));
    table[i] = packed(ends[k].map((c, n) => Math.round(c + (at - k) * (ends[k + 1][n] - c))));
  }
  return table;
}
const TABLES = { dark: ramp(RAMPS.dark), light: ramp(RAMPS.light) };

/** A colour for a number, always the same. */
function hue(number, which) {
  const h = number * 0.61803398875 % 1, light = which === "dark" ? 0.66 : 0.4;
  return packed([0, 8, 4].map((n) => {
    const k = (n + 12 * h) % 12, swing = 0.75 * Math.min(light, 1 - light);
    return Math.round(255 * (light - swing * Math.max(-1, Math.min(k - 3, 9 - k, 1))));
  }));
}

export function colourOfClass(name) {
  const colour = classOf(name)?.color ?? "#9b8afb"; // an unknown class
  const parts = rgb(colour), bright = 0.3 * parts[0] + 0.59 * parts[1] + 0.11 * parts[2];
  if (theme() === "dark" || bright < BRIGHT) return colour;
  return `#${parts.map((c) => Math.round(c * BRIGHT / bright).toString(16).padStart(2, "0")).join("")}`;
}

/** Fill `bytes` with the colours of a cloud, four bytes per point. */
export function paint(bytes, cloud, how) {
  const colours = new Uint32Array(bytes.buffer), which = theme();
  const { count, xyz, intensity, ground, cluster, floor } = cloud, table = TABLES[which];
  const [muted, flat, thing] = [MUTED, GROUND, THING].map((c) => packed(rgb(c[which])));
  if (how === "height") {
    for (let i = 0; i < count; i++) {
      const share = Math.min(1, Math.max(0, (xyz[3 * i + 2] - floor) / SPAN));
      colours[i] = ground[i] ? flat : table[255 * share | 0];
    }
  } else if (how === "intensity") {
    for (let i = 0; i < count; i++) colours[i] = table[255 * Math.sqrt(intensity[i] / 255) | 0];
  } else if (how === "ground") {
    const road = packed(rgb(ROAD[which]));
    for (let i = 0; i < count; i++) colours[i] = ground[i] ? road : thing;
  } else if (how === "cluster") {
    const known = new Map([[0, muted]]);
    for (let i = 0; i < count; i++) {
      const id = cluster[i];
      if (!known.has(id)) known.set(id, hue(id, which));
      colours[i] = !id && ground[i] ? flat : known.get(id);
    }
  } else {
    for (let i = 0; i < count; i++) colours[i] = ground[i] ? flat : muted;
    paintClasses(colours, cloud);
  }
}

function paintClasses(colours, { xyz, count }) {
  for (const { box, colour } of shownBoxes()) {
    const reach = Math.hypot(box[3], box[4]) / 2, shade = packed(rgb(colour));
    for (let i = 0, k = 0; i < count; i++, k += 3) {
      if (Math.abs(xyz[k] - box[0]) > reach || Math.abs(xyz[k + 1] - box[1]) > reach) continue;
      const at = toLocal(box, xyz[k], xyz[k + 1], xyz[k + 2]);
      if (at.every((value, n) => Math.abs(value) <= box[3 + n] / 2)) colours[i] = shade;
    }
  }
}

/** Boxes of tracks in the frame shown, without rejected ones unless selected: {track, box, kind,
 * colour}. */
export function shownBoxes() {
  const found = [];
  for (const track of store.tracks.values()) {
    if (track.state === "rejected" && track.id !== store.selected) continue;
    const here = boxOf(track);
    if (here) found.push({ track, ...here, colour: colourOfClass(track.class) });
  }
  return found;
}
