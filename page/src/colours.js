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
const SEEN = { dark: "#ffffff", light: "#000000" };
const SPAN = 4; // metres above the ground over which height is coloured

export const rgb = (hex) => [1, 3, 5].map((k) => parseInt(hex.slice(k, k + 2), 16));

export function theme() {
  const chosen = document.documentElement.dataset.theme;
  if (chosen === "light" || chosen === "dark") return chosen;
  return matchMedia("(prefers-color-scheme: light)").matches ? "light" : "dark";
}

function ramp(stops, steps = 256) {
  const table = new Uint8Array(3 * steps), ends = stops.map(rgb);
  for (let i = 0; i < steps; i++) {
    const at = i / (steps - 1) * (ends.length - 1), k = Math.min(ends.length - 2, Math.floor(at));
    for (let c = 0; c < 3; c++) {
      table[3 * i + c] = Math.round(ends[k][c] + (at - k) * (ends[k + 1][c] - ends[k][c]));
    }
  }
  return table;
}
const TABLES = { dark: ramp(RAMPS.dark), light: ramp(RAMPS.light) };

/** Any hue for a number, the same each time. */
function hue(number, which) {
  const h = number * 0.61803398875 % 1, light = which === "dark" ? 0.66 : 0.4;
  return [0, 8, 4].map((n) => {
    const k = (n + 12 * h) % 12;
    return 255 * (light - 0.75 * Math.min(light, 1 - light) * Math.max(-1, Math.min(k - 3, 9 - k, 1)));
  });
}

export function colourOfClass(name) {
  return classOf(name)?.color ?? "#9b8afb"; // a class that nobody here knows
}

/** Fill (4 a point) with the colours of a cloud; returns how many points were coloured. */
export function paint(colours, cloud, how, marked = 0) {
  const which = theme(), { count } = cloud;
  const put = (i, [r, g, b]) => { colours[4 * i] = r; colours[4 * i + 1] = g; colours[4 * i + 2] = b; };
  const muted = rgb(MUTED[which]), ground = rgb(GROUND[which]), thing = rgb(THING[which]);
  if (how === "height" || how === "intensity") {
    const table = TABLES[which], { xyz, intensity } = cloud;
    for (let i = 0; i < count; i++) {
      const at = how === "intensity" ? 255 * Math.sqrt(intensity[i] / 255)
        : 255 * Math.min(1, Math.max(0, (xyz[3 * i + 2] - cloud.floor) / SPAN));
      const k = 3 * Math.round(at), dim = how === "height" && cloud.ground[i];
      if (dim) put(i, ground);
      else put(i, [table[k], table[k + 1], table[k + 2]]);
    }
  } else if (how === "ground") {
    const brown = rgb(which === "dark" ? "#5b6f93" : "#7d8fb0");
    for (let i = 0; i < count; i++) put(i, cloud.ground[i] ? brown : thing);
  } else if (how === "cluster") {
    const known = new Map();
    for (let i = 0; i < count; i++) {
      const id = cloud.cluster[i];
      if (id && !known.has(id)) known.set(id, hue(id, which));
      put(i, id ? known.get(id) : cloud.ground[i] ? ground : muted);
    }
  } else {
    for (let i = 0; i < count; i++) put(i, cloud.ground[i] ? ground : muted);
    paintClasses(put, cloud);
  }
  if (marked) {
    const seen = rgb(SEEN[which]);
    for (let i = 0; i < count; i++) if (cloud.cluster[i] === marked) put(i, seen);
  }
  return count;
}

function paintClasses(put, cloud) {
  for (const { box, colour } of shownBoxes()) {
    const reach = Math.hypot(box[3], box[4]) / 2, shade = rgb(colour), { xyz } = cloud;
    for (let i = 0; i < cloud.count; i++) {
      if (Math.abs(xyz[3 * i] - box[0]) > reach || Math.abs(xyz[3 * i + 1] - box[1]) > reach) continue;
      const at = toLocal(box, xyz[3 * i], xyz[3 * i + 1], xyz[3 * i + 2]);
      if (Math.abs(at[0]) <= box[3] / 2 && Math.abs(at[1]) <= box[4] / 2
          && Math.abs(at[2]) <= box[5] / 2) put(i, shade);
    }
  }
}

/** The boxes of tracks in the frame shown that are not rejected: {track, box, kind, colour}. */
export function shownBoxes() {
  const found = [];
  for (const track of store.tracks.values()) {
    if (track.state === "rejected" && track.id !== store.selected) continue;
    const here = boxOf(track);
    if (here) found.push({ track, ...here, colour: colourOfClass(track.class) });
  }
  return found;
}
