// All that is asked of the server, and what it says by itself.

import { hearLive, reopenLive } from "./live.js";
import { applyEvent, changed, setState, store } from "./store.js";
import { say, sayError } from "./messages.js";

const TOKEN = new URLSearchParams(location.search).get("token");
export const PAGE = crypto.randomUUID();
const RETRY_MS = 1000;
const SILENT_MS = 1500; // after this long without its event, an action's result is asked for

function address(path) {
  return TOKEN === null ? path
    : `${path}${path.includes("?") ? "&" : "?"}token=${encodeURIComponent(TOKEN)}`;
}

/** A reply; an Error with a line for a person where there is none, or the server refuses. */
async function ask(path, options) {
  let reply;
  try {
    reply = await fetch(address(path), { cache: "no-store", ...options });
  } catch {
    throw new Error("the server cannot be reached; is it still running in its terminal?");
  }
  if (reply.ok) return reply;
  const text = await reply.text();
  let line = text.trim().split("\n")[0] || `the server answered ${reply.status}`;
  try { line = JSON.parse(text).error ?? line; } catch { /* a plain line, then */ }
  throw Object.assign(new Error(line), { status: reply.status });
}

export const getJson = async (path) => (await ask(path)).json();
export const getBytes = async (path, signal) => (await ask(path, { signal })).arrayBuffer();

const post = async (path, content) => (await ask(path, {
  method: "POST",
  headers: { "Content-Type": "application/json", "X-Page": PAGE },
  body: JSON.stringify(content),
})).json();

let last = Promise.resolve(), unsaved = 0; // actions that were not answered yet
addEventListener("beforeunload", (event) => { if (unsaved) event.preventDefault(); }); // asks

/** Send an action after those before it. True once it is in the journal; else that is told, by a
 * message where not otherwise, and nothing has changed. */
export function act(action, tell = sayError) {
  unsaved += 1;
  const sent = last.then(async () => {
    try {
      const { seq } = await post("/api/do", action);
      await arrived(seq).catch(() => null); // it is saved; the state comes with the connection
      return true;
    } catch (error) {
      tell(`Not saved (${action.do.replace("_", " ")}): ${error.message}`);
      return false;
    } finally {
      unsaved -= 1;
    }
  });
  last = sent;
  return sent;
}

/** Until the event of this action has been applied; where it does not come, the whole state. */
async function arrived(seq) {
  const until = performance.now() + SILENT_MS;
  while (store.seq < seq && performance.now() < until) {
    await new Promise((resolve) => waiting.push(resolve) && setTimeout(resolve, 100));
  }
  if (store.seq < seq) await loadState();
}
let waiting = [];

export async function loadState() {
  setState(await getJson("/api/state"));
}

/** What was done before is in it too. */
export const exportLabels = (content) => last.then(() => post("/api/export", content));

export function nextUncertain(after, only) {
  return getJson(`/api/next?after=${after ?? 0}${only ? `&class=${encodeURIComponent(only)}` : ""}`);
}

let socket = null;

/** A word to the server that is no action. */
export function tellServer(word) {
  if (socket?.readyState === WebSocket.OPEN) socket.send(word);
}

/** Listen to what all pages do, for as long as the page is open. */
export function listen() {
  const url = new URL(address("/api/events"), location.href);
  url.protocol = url.protocol.replace("http", "ws");
  socket = new WebSocket(url);
  socket.onopen = async () => {
    const back = !store.online;
    store.online = true;
    changed("connection");
    try {
      await Promise.all([loadState(), back && store.drive.live ? reopenLive() : null]);
      if (back) say("Connected again; all that was saved is here.");
    } catch (error) {
      sayError(error.message);
    }
  };
  socket.onmessage = ({ data }) => hear(JSON.parse(data));
  socket.onclose = () => {
    store.online = false;
    changed("connection");
    setTimeout(listen, RETRY_MS);
    fetch(address("/api/state")).then((reply) => { // why: a browser does not say it of a socket
      store.refused = reply.status === 403;
      changed("connection");
    }, () => null);
  };
}

function hear(event) {
  if (event.error) sayError(event.error);
  if (event.live || event.status) hearLive(event);
  if (event.seq === undefined) {
    if (event.progress) {
      store.progress = event.progress;
      changed("progress");
    }
    return;
  }
  if (event.seq <= store.seq) return; // the state that was loaded has it already
  if (event.seq === store.seq + 1) applyEvent(event);
  else loadState().catch((error) => sayError(error.message)); // something was missed
  if (event.by && event.by !== PAGE && event.action) {
    say(`Another page: ${event.action.do.replace("_", " ")}`
      + (event.action.track ? ` of track ${event.action.track}` : ""));
  } else if (["propose", "import"].includes(event.action?.do) && event.tracks?.length) {
    say(`${event.tracks.length} tracks ${event.action.do === "import" ? "imported" : "proposed or followed"}.`);
  }
  const woken = waiting;
  waiting = [];
  for (const wake of woken) wake();
}
