// Requests to the server, and the events that it sends.

import { say, sayError } from "./messages.js";
import { addLiveFrame, applyEvent, changed, setDrive, setState, store } from "./store.js";

const TOKEN = new URLSearchParams(location.search).get("token");
const PAGE = crypto.randomUUID();
const RETRY_MS = 1000;
const EVENT_TIMEOUT_MS = 1500; // without the event of an action for so long, the state is loaded

function address(path) {
  return TOKEN === null ? path
    : `${path}${path.includes("?") ? "&" : "?"}token=${encodeURIComponent(TOKEN)}`;
}

/** Fetch a path; an Error with a line for the user if there is no reply, or the server refuses. */
async function request(path, options) {
  let reply;
  try {
    reply = await fetch(address(path), { cache: "no-store", ...options });
  } catch {
    throw new Error("the server cannot be reached; check that it is still running");
  }
  if (reply.ok) return reply;
  const text = await reply.text();
  let line = text.trim().split("\n")[0] || `the server answered ${reply.status}`;
  try { line = JSON.parse(text).error ?? line; } catch { /* a plain line, then */ }
  throw Object.assign(new Error(line), { status: reply.status });
}

export const getJson = async (path) => (await request(path)).json();
export const getBytes = async (path) => (await request(path)).arrayBuffer();

/** load(frame), once for the last `limit` frames; a failed request can be repeated. */
export function cached(load, limit) {
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

let last = Promise.resolve(), unsaved = 0; // actions without a reply
addEventListener("beforeunload", (event) => { if (unsaved) event.preventDefault(); }); // confirm

/** Send an action after the previous ones. True once it is in the journal; else report the error and
 * return false, and nothing has changed. */
export function act(action, reportError = sayError) {
  unsaved += 1;
  const sent = last.then(async () => {
    try {
      const { seq } = await post("/api/do", action);
      await applied(seq).catch(() => null); // it is saved; the state comes with the connection
      return true;
    } catch (error) {
      reportError(`Not saved (${action.do.replace("_", " ")}): ${error.message}`);
      return false;
    } finally {
      unsaved -= 1;
    }
  });
  last = sent;
  return sent;
}

/** Wait until the event of an action has been applied; if it does not arrive, load the state. */
async function applied(seq) {
  const until = performance.now() + EVENT_TIMEOUT_MS;
  while (store.seq < seq && performance.now() < until) {
    await new Promise((resolve) => waiting.push(resolve) && setTimeout(resolve, 100));
  }
  if (store.seq < seq) await loadState();
}
let waiting = [];

export async function loadDrive() {
  setDrive(await getJson("/api/drive"));
}

export async function loadState() {
  setState(await getJson("/api/state"));
}

/** Export the labels, including all actions so far. */
export const exportLabels = (content) => last.then(() => post("/api/export", content));

export function nextUncertain(after, only) {
  return getJson(`/api/next?after=${after ?? 0}${only ? `&class=${encodeURIComponent(only)}` : ""}`);
}

let socket = null;

/** Send "hold" or "go on" for a running graph. */
export function sendToServer(word) {
  if (socket?.readyState === WebSocket.OPEN) socket.send(word);
}

/** Receive events for as long as the page is open. */
export function listen() {
  const url = new URL(address("/api/events"), location.href);
  url.protocol = url.protocol.replace("http", "ws");
  socket = new WebSocket(url);
  socket.onopen = async () => {
    const back = !store.online;
    store.online = true;
    changed("connection");
    try {
      const reload = back && store.drive.live;
      await Promise.all([loadState(), reload ? loadDrive() : null]);
      if (reload) changed("drive", "wanted", "status");
      if (back) say("Connected again; all saved labels are up to date.");
    } catch (error) {
      sayError(error.message);
    }
  };
  socket.onmessage = ({ data }) => receive(JSON.parse(data));
  socket.onclose = () => {
    store.online = false;
    changed("connection");
    setTimeout(listen, RETRY_MS);
    fetch(address("/api/state")).then((reply) => { // a socket does not report the status
      store.refused = reply.status === 403;
      changed("connection");
    }, () => null);
  };
}

function receive(event) {
  if (event.error) sayError(event.error);
  if (event.status) {
    store.status = event.status;
    changed("status");
  }
  if (event.live) addLiveFrame(event.live);
  if (event.seq === undefined) {
    if (event.progress) {
      store.progress = event.progress;
      changed("progress");
    }
    return;
  }
  if (event.seq <= store.seq) return; // already in the loaded state
  if (event.seq === store.seq + 1) applyEvent(event);
  else loadState().catch((error) => sayError(error.message)); // events were missed
  if (event.by && event.by !== PAGE && event.action) {
    say(`Another page: ${event.action.do.replace("_", " ")}`
      + (event.action.track ? ` of track ${event.action.track}` : ""));
  } else if (["propose", "import"].includes(event.action?.do) && event.tracks?.length) {
    say(`${event.tracks.length} tracks ${event.action.do === "import" ? "imported" : "proposed or updated"}.`);
  }
  const waiters = waiting;
  waiting = [];
  for (const resume of waiters) resume();
}
