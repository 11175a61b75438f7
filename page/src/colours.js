// Colours of points, classes and tracks for the dark and the light theme.

import { toLocal } from "./boxmath.js";
import { getBox, findClass, store } from "./store.js";

const RAMPS = {
  dark: ["#3d4f7c", "#3286b8", "#2fb39a", "#a4d04f", "#fbdc5a"],
  light: ["#8fa0c0", "#2a6fb0", "#0f8377", "#5a8a12", "#b25c00"],
};
const MUTED = { dark: "#4a5568", light: "#b3bccb" };
const GROUND = { dark: "#333e52", light: "#cdd5e0" };
const OBJECT = { dark: "#d7dee9", light: "#2d3a4f" };
export const HIGHLIGHT = { dark: "#ffffff", light: "#000000" };
const ROAD = { dark: "#5b6f93", light: "#7d8fb0" };
const MAX_BRIGHTNESS = 150; // maximum brightness (0 to 255) of a colour in the light theme
const HEIGHT_SPAN_M = 4; // height above the ground at which the colour ramp ends

export const rgb = (hex) => [1, 3, 5].map((k) => parseInt(hex.slice(k, k + 2), 16));

export function getTheme() {
  const theme = document.documentElement.dataset.theme;
  if (theme === "light" || theme === "dark") return theme;
  return matchMedia("(prefers-color-scheme: light)").matches ? "light" : "dark";
}

/** Pack a colour into a 32-bit number. */
const pack = ([r, g, b]) => (r | g << 8 | b << 16) >>> 0;

function makeRamp(stops, steps = 256) {
  const table = new Uint32Array(steps), colours = stops.map(rgb);
  for (let i = 0; i < steps; i++) {
    const position = i / (steps - 1) * (colours.length - 1), k = Math.min(colours.length - 2, Math.floor(position));
    table[i] = pack(colours[k].map((c, n) => Math.round(c + (position - k) * (colours[k + 1][n] - c))));
  }
  return table;
}
const TABLES = { dark: makeRamp(RAMPS.dark), light: makeRamp(RAMPS.light) };

/** Return a colour for a number. The same number always gives the same colour. */
function getNumberColour(number, themeName) {
  const hue = number * 0.61803398875 % 1, lightness = themeName === "dark" ? 0.66 : 0.4;
  return pack([0, 8, 4].map((n) => {
    const k = (n + 12 * hue) % 12, amplitude = 0.75 * Math.min(lightness, 1 - lightness);
    return Math.round(255 * (lightness - amplitude * Math.max(-1, Math.min(k - 3, 9 - k, 1))));
  }));
}

export function getClassColour(name) {
  const colour = findClass(name)?.color ?? "#9b8afb"; // colour of unknown classes
  const channels = rgb(colour), brightness = 0.3 * channels[0] + 0.59 * channels[1] + 0.11 * channels[2];
  if (getTheme() === "dark" || brightness < MAX_BRIGHTNESS) return colour;
  const darkerChannels = channels.map((c) => Math.round(c * MAX_BRIGHTNESS / brightness));
  return `#${darkerChannels.map((c) => c.toString(16).padStart(2, "0")).join("")}`;
}

/** Fill `bytes` with the colours of the points of a cloud, four bytes per point. */
export function paintCloud(bytes, cloud, scheme) {
  const colours = new Uint32Array(bytes.buffer), themeName = getTheme();
  const { count, xyz, intensity, ground, cluster, floor } = cloud, table = TABLES[themeName];
  const [mutedColour, groundColour, objectColour] = [MUTED, GROUND, OBJECT].map((c) => pack(rgb(c[themeName])));
  if (scheme === "height") {
    for (let i = 0; i < count; i++) {
      const fraction = Math.min(1, Math.max(0, (xyz[3 * i + 2] - floor) / HEIGHT_SPAN_M));
      colours[i] = ground[i] ? groundColour : table[255 * fraction | 0];
    }
  } else if (scheme === "intensity") {
    for (let i = 0; i < count; i++) colours[i] = table[255 * Math.sqrt(intensity[i] / 255) | 0];
  } else if (scheme === "ground") {
    const roadColour = pack(rgb(ROAD[themeName]));
    for (let i = 0; i < count; i++) colours[i] = ground[i] ? roadColour : objectColour;
  } else if (scheme === "cluster") {
    const colourById = new Map([[0, mutedColour]]);
    for (let i = 0; i < count; i++) {
      const id = cluster[i];
      if (!colourById.has(id)) colourById.set(id, getNumberColour(id, themeName));
      colours[i] = !id && ground[i] ? groundColour : colourById.get(id);
    }
  } else {
    for (let i = 0; i < count; i++) colours[i] = ground[i] ? groundColour : mutedColour;
    paintClasses(colours, cloud);
  }
}

function paintClasses(colours, { xyz, count }) {
  for (const { box, colour } of listShownBoxes()) {
    const radius = Math.hypot(box[3], box[4]) / 2, packedColour = pack(rgb(colour));
    for (let i = 0, k = 0; i < count; i++, k += 3) {
      if (Math.abs(xyz[k] - box[0]) > radius || Math.abs(xyz[k + 1] - box[1]) > radius) continue;
      const local = toLocal(box, xyz[k], xyz[k + 1], xyz[k + 2]);
      if (local.every((value, n) => Math.abs(value) <= box[3 + n] / 2)) colours[i] = packedColour;
    }
  }
}

/** List the boxes of tracks in the shown frame, as {track, box, kind, colour}, without rejected tracks that
 * are not selected. */
export function listShownBoxes() {
  const boxes = [];
  for (const track of store.tracks.values()) {
    if (track.state === "rejected" && track.id !== store.selected) continue;
    const entry = getBox(track);
    if (entry) boxes.push({ track, ...entry, colour: getClassColour(track.class) });
  }
  return boxes;
}
