// Helpers that create HTML and SVG elements.

const SVG = "http://www.w3.org/2000/svg";

function applyAttributes(node, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) node[name] = value;
    else if (name === "style") node.style.cssText = value; // the Content-Security-Policy forbids the style attribute
    else if (value === true) node.setAttribute(name, "");
    else if (value !== false && value !== null && value !== undefined) {
      node.setAttribute(name, value);
    }
  }
  node.append(...children.filter((child) => child !== null));
  return node;
}

export function element(name, attributes = {}, ...children) {
  return applyAttributes(document.createElement(name), attributes, children);
}

export function svg(name, attributes = {}, ...children) {
  return applyAttributes(document.createElementNS(SVG, name), attributes, children);
}

// Icon paths, in a 24 by 24 viewBox.
const PATHS = {
  close: "M6 6l12 12M18 6L6 18",
  undo: "M9 14L4 9l5-5M4 9h10a6 6 0 0 1 0 12h-3",
  redo: "M15 14l5-5-5-5M20 9H10a6 6 0 0 0 0 12h3",
  play: "M7 4l13 8-13 8z",
  pause: "M8 5v14M16 5v14",
  previous: "M15 5l-7 7 7 7",
  next: "M9 5l7 7-7 7",
  check: "M4 12l6 6L20 6",
  reject: "M6 6l12 12M18 6L6 18",
  select: "M5 3l14 8-6 2-3 6z",
  seed: "M12 3v4M12 17v4M3 12h4M17 12h4M12 9a3 3 0 1 0 0 6 3 3 0 0 0 0-6",
  add: "M12 5v14M5 12h14",
  theme: "M12 3a9 9 0 1 0 9 9 7 7 0 0 1-9-9",
  help: "M9 9a3 3 0 1 1 4 3c-1 .6-1 1-1 2M12 17.5v.5",
  log: "M4 6h16M4 12h16M4 18h10",
  export: "M12 15V4M8 8l4-4 4 4M4 15v5h16v-5",
  wand: "M4 20L15 9M17 3v4M15 5h4M20 10v3M18.5 11.5h3M9 4v3M7.500 5.500h3",
  focus: "M4 9V4h5M20 9V4h-5M4 15v5h5M20 15v5h-5",
  copy: "M9 9h11v11H9zM5 15H4V4h11v1",
  remove: "M5 7h14M10 7V4h4v3M7 7l1 13h8l1-13",
};

export function icon(name) {
  return svg("svg", { viewBox: "0 0 24 24", class: "icon", "aria-hidden": "true" },
    svg("path", { d: PATHS[name] }));
}

/** Return a function that schedules `callback` before the next drawing. Repeated calls schedule it only once. */
export function beforeDrawing(callback) {
  let isRequested = false;
  return () => {
    if (isRequested) return;
    isRequested = true;
    requestAnimationFrame(() => {
      isRequested = false;
      callback();
    });
  };
}
