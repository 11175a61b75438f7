// Requests to the server, and events from the server.

import { showNote, showError } from "./messages.js";
import { addLiveFrame, applyEvent, notify, setDrive, setState, store } from "./store.js";

const TOKEN = new URLSearchParams(location.search).get("token");
const PAGE = crypto.randomUUID();
const RETRY_MS = 1000;
const EVENT_TIMEOUT_MS = 1500; // without the event of an action for this time, the whole state is loaded

function withToken(path) {
  return TOKEN === null ? path
    : `${path}${path.includes("?") ? "&" : "?"}token=${encodeURIComponent(TOKEN)}`;
}

/** Fetch a path. Throws an Error with a message for the user if the request fails. */
async function request(path, options) {
  let reply;
  try {
    reply = await fetch(withToken(path), { cache: "no-store", ...options });
  } catch {
    throw new Error("the server cannot be reached; check that it is still running");
  }
  if (reply.ok) return reply;
  const text = await reply.text();
  let line = text.trim().split("\n")[0] || `the server replied with status ${reply.status}`;
  try { line = JSON.parse(text).error ?? line; } catch { /* not JSON: show the line itself */ }
  throw Object.assign(new Error(line), { status: reply.status });
}

export const getJson = async (path) => (await request(path)).json();
export const getBytes = async (path) => (await request(path)).arrayBuffer();

/** Cache load(frame) for the `maxSize` most recently used frames. Failures are not cached. */
export function makeCache(load, maxSize) {
  const cache = new Map(); // frame -> promise, in order of last use
  const get = (frame) => {
    const reply = cache.get(frame) ?? load(frame);
    cache.delete(frame);
    cache.set(frame, reply);
    reply.catch(() => { if (cache.get(frame) === reply) cache.delete(frame); });
    if (cache.size > maxSize) cache.delete(cache.keys().next().value);
    return reply;
  };
  return { get, delete: (frame) => cache.delete(frame), clear: () => cache.clear() };
}

const post = async (path, content) => (await request(path, {
  method: "POST",
  headers: { "Content-Type": "application/json", "X-Page": PAGE },
  body: JSON.stringify(content),
})).json();

let lastAction = Promise.resolve(), unsavedCount = 0; // number of actions without a reply
// Let the browser ask for confirmation before it leaves the page with unsaved actions.
addEventListener("beforeunload", (event) => { if (unsavedCount) event.preventDefault(); });

/** Send an action when all earlier actions are finished. Returns true when it is saved in the journal.
 * If it fails, nothing is changed: reports the error and returns false. */
export function sendAction(action, reportError = showError) {
  unsavedCount += 1;
  const result = lastAction.then(async () => {
    try {
      const { seq } = await post("/api/do", action);
      await waitUntilApplied(seq).catch(() => null); // it is saved, and the page reloads the state when it reconnects
      return true;
    } catch (error) {
      reportError(`Not saved (${action.do.replace("_", " ")}): ${error.message}`);
      return false;
    } finally {
      unsavedCount -= 1;
    }
  });
  lastAction = result;
  return result;
}

/** Wait until the event of an action is applied. If it does not arrive in time, load the whole state. */
async function waitUntilApplied(seq) {
  const deadline = performance.now() + EVENT_TIMEOUT_MS;
  while (store.seq < seq && performance.now() < deadline) {
    await new Promise((resolve) => waiters.push(resolve) && setTimeout(resolve, 100));
  }
  if (store.seq < seq) await loadState();
}
let waiters = [];

export async function loadDrive() {
  setDrive(await getJson("/api/drive"));
}

export async function loadState() {
  setState(await getJson("/api/state"));
}

/** Export the labels after all actions so far are saved. */
export const exportLabels = (content) => lastAction.then(() => post("/api/export", content));

export function fetchNextUncertain(after, className) {
  const classQuery = className ? `&class=${encodeURIComponent(className)}` : "";
  return getJson(`/api/next?after=${after ?? 0}${classQuery}`);
}

let socket = null;

/** Send "pause" or "resume" to the server of a running graph. */
export function sendCommand(command) {
  if (socket?.readyState === WebSocket.OPEN) socket.send(command);
}

/** Connect to the event stream of the server, and reconnect if the connection is lost. */
export function listen() {
  const url = new URL(withToken("/api/events"), location.href);
  url.protocol = url.protocol.replace("http", "ws");
  socket = new WebSocket(url);
  socket.onopen = async () => {
    const isReconnected = !store.online;
    store.online = true;
    notify("connection");
    try {
      const mustReloadDrive = isReconnected && store.drive.live;
      await Promise.all([loadState(), mustReloadDrive ? loadDrive() : null]);
      if (mustReloadDrive) notify("drive", "requested-frame", "status");
      if (isReconnected) showNote("Reconnected. The page is up to date.");
    } catch (error) {
      showError(error.message);
    }
  };
  socket.onmessage = ({ data }) => receive(JSON.parse(data));
  socket.onclose = () => {
    store.online = false;
    notify("connection");
    setTimeout(listen, RETRY_MS);
    fetch(withToken("/api/state")).then((reply) => { // because a WebSocket does not report the HTTP status
      store.refused = reply.status === 403;
      notify("connection");
    }, () => null);
  };
}

function receive(event) {
  if (event.error) showError(event.error);
  if (event.status) {
    store.status = event.status;
    notify("status");
  }
  if (event.live) addLiveFrame(event.live);
  if (event.seq === undefined) {
    if (event.progress) {
      store.progress = event.progress;
      notify("progress");
    }
    return;
  }
  if (event.seq <= store.seq) return; // the loaded state already contains it
  if (event.seq === store.seq + 1) applyEvent(event);
  else loadState().catch((error) => showError(error.message)); // events have been missed
  if (event.by && event.by !== PAGE && event.action) {
    showNote(`Changed on another page: ${event.action.do.replace("_", " ")}`
      + (event.action.track ? ` (track ${event.action.track})` : ""));
  } else if (["propose", "import"].includes(event.action?.do) && event.tracks?.length) {
    const outcome = event.action.do === "import" ? "imported" : "proposed or updated";
    showNote(`${event.tracks.length} tracks ${outcome}.`);
  }
  const resolvers = waiters;
  waiters = [];
  for (const resume of resolvers) resume();
}
