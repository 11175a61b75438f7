// Requests to the server, and the events that it sends.

import { showNote, showError } from "./messages.js";
import { addLiveFrame, applyEvent, notify, setDrive, setState, store } from "./store.js";

const TOKEN = new URLSearchParams(location.search).get("token");
const PAGE = crypto.randomUUID();
const RETRY_MS = 1000;
const EVENT_TIMEOUT_MS = 1500; // for the event of an action; then the state is loaded instead

function withToken(path) {
  return TOKEN === null ? path
    : `${path}${path.includes("?") ? "&" : "?"}token=${encodeURIComponent(TOKEN)}`;
}

/** Fetch a path. Throws an Error with a message for the user if there is no reply or an error status. */
async function request(path, options) {
  let reply;
  try {
    reply = await fetch(withToken(path), { cache: "no-store", ...options });
  } catch {
    throw new Error("the server cannot be reached; check that it is still running");
  }
  if (reply.ok) return reply;
  const text = await reply.text();
  let line = text.trim().split("\n")[0] || `the server answered ${reply.status}`;
  try { line = JSON.parse(text).error ?? line; } catch { /* not JSON: show the line itself */ }
  throw Object.assign(new Error(line), { status: reply.status });
}

export const getJson = async (path) => (await request(path)).json();
export const getBytes = async (path) => (await request(path)).arrayBuffer();

/** Make a cache of load(frame) for the `limit` most recently used frames; failures are not cached. */
export function makeCache(load, limit) {
  const cache = new Map(); // frame -> promise, in order of last use
  const get = (frame) => {
    const reply = cache.get(frame) ?? load(frame);
    cache.delete(frame);
    cache.set(frame, reply);
    reply.catch(() => { if (cache.get(frame) === reply) cache.delete(frame); });
    if (cache.size > limit) cache.delete(cache.keys().next().value);
    return reply;
  };
  return { get, delete: (frame) => cache.delete(frame), clear: () => cache.clear() };
}

const post = async (path, content) => (await request(path, {
  method: "POST",
  headers: { "Content-Type": "application/json", "X-Page": PAGE },
  body: JSON.stringify(content),
})).json();

let lastAction = Promise.resolve(), unsavedCount = 0; // actions without a reply
addEventListener("beforeunload", (event) => { if (unsavedCount) event.preventDefault(); }); // confirm

/** Send an action after the previous ones. Returns true once it is in the journal. After an error,
 * reports it and returns false; nothing has changed. */
export function sendAction(action, reportError = showError) {
  unsavedCount += 1;
  const sent = lastAction.then(async () => {
    try {
      const { seq } = await post("/api/do", action);
      await waitUntilApplied(seq).catch(() => null); // saved; the state is loaded on reconnection
      return true;
    } catch (error) {
      reportError(`Not saved (${action.do.replace("_", " ")}): ${error.message}`);
      return false;
    } finally {
      unsavedCount -= 1;
    }
  });
  lastAction = sent;
  return sent;
}

/** Wait for the event of an action to be applied; load the state if it does not arrive in time. */
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

/** Export the labels, including all actions so far. */
export const exportLabels = (content) => lastAction.then(() => post("/api/export", content));

export function fetchNextUncertain(after, className) {
  const only = className ? `&class=${encodeURIComponent(className)}` : "";
  return getJson(`/api/next?after=${after ?? 0}${only}`);
}

let socket = null;

/** Send "pause" or "resume" to the server of a running graph. */
export function sendCommand(command) {
  if (socket?.readyState === WebSocket.OPEN) socket.send(command);
}

/** Connect to the event stream of the server, and reconnect whenever the connection is lost. */
export function listen() {
  const url = new URL(withToken("/api/events"), location.href);
  url.protocol = url.protocol.replace("http", "ws");
  socket = new WebSocket(url);
  socket.onopen = async () => {
    const reconnected = !store.online;
    store.online = true;
    notify("connection");
    try {
      const reload = reconnected && store.drive.live;
      await Promise.all([loadState(), reload ? loadDrive() : null]);
      if (reload) notify("drive", "requested-frame", "status");
      if (reconnected) showNote("Connected again; all saved labels are up to date.");
    } catch (error) {
      showError(error.message);
    }
  };
  socket.onmessage = ({ data }) => receive(JSON.parse(data));
  socket.onclose = () => {
    store.online = false;
    notify("connection");
    setTimeout(listen, RETRY_MS);
    fetch(withToken("/api/state")).then((reply) => { // a socket does not report the status
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
  if (event.seq <= store.seq) return; // already in the loaded state
  if (event.seq === store.seq + 1) applyEvent(event);
  else loadState().catch((error) => showError(error.message)); // events were missed
  if (event.by && event.by !== PAGE && event.action) {
    showNote(`Another page: ${event.action.do.replace("_", " ")}`
      + (event.action.track ? ` of track ${event.action.track}` : ""));
  } else if (["propose", "import"].includes(event.action?.do) && event.tracks?.length) {
    const verb = event.action.do === "import" ? "imported" : "proposed or updated";
    showNote(`${event.tracks.length} tracks ${verb}.`);
  }
  const resolvers = waiters;
  waiters = [];
  for (const resume of resolvers) resume();
}
