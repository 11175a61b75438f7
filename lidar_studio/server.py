"""HTTP server of the page, for this machine only; every request needs a token."""

from __future__ import annotations

import asyncio
import hmac
import logging
import re
import secrets
import signal
from collections.abc import Awaitable, Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from aiohttp import WSMsgType, web

from lidar_perception.detectors.params import ScoreParams
from lidar_perception.labels.exchange import FORMATS
from lidar_perception.runs.files import shorten_error
from lidar_perception.types import CLASSES, PEDESTRIAN, InputError
from lidar_studio.actions import require_track
from lidar_studio.drive import Drive, list_classes
from lidar_studio.live_graph import LiveGraph
from lidar_studio.session import Session
from lidar_studio.state import find_next_uncertain

LOG = logging.getLogger(__name__)
HOSTS = ("127.0.0.1", "localhost")
PAGE = Path(__file__).with_name("page")
MAX_REQUEST = 10**7  # maximum size of a request in bytes
MAX_QUEUED_EVENTS = 1000
PREFETCH_FRAMES = 2  # number of frames to prefetch on either side of the requested one
Events = asyncio.Queue[dict[str, Any] | None]  # events of one page; None if the page is too far behind
HEADERS = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Content-Security-Policy": "default-src 'self'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; frame-ancestors 'none'",
}
Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


@dataclass(eq=False)
class PageContent:
    """A drive with labels or results, or a running graph.

    session: None to view results without labelling.
    layers: returns the JSON object of /api/labels for (i, min_score); None without labels and
        detections.
    tracks: returns the JSON objects of the tracks to view.
    token: every request must contain it.
    """

    drive: Drive | LiveGraph
    session: Session | None = None
    layers: Callable[[int, float], dict[str, Any]] | None = None
    tracks: Callable[[], Sequence[dict[str, Any]]] = tuple
    token: str = field(default_factory=partial(secrets.token_urlsafe, 24))

    @property
    def live(self) -> LiveGraph | None:
        """The running graph, None for a drive."""
        return self.drive if isinstance(self.drive, LiveGraph) else None

    def to_json(self) -> dict[str, Any]:
        """Return the JSON object of /api/drive."""
        common = {
            "name": self.drive.name,
            "mode": "label" if self.session else "view",
            "classes": list_classes(),
            "live": self.live is not None,
            "min_score": ScoreParams().get(CLASSES[PEDESTRIAN]),
            "can_export": [*FORMATS] if self.session else [],
        }
        if isinstance(self.drive, LiveGraph):
            return {
                **common,
                "path": "",
                "layout": "live",
                "has": [],
                "first": self.drive.first,
                "frames": self.drive.list_frames(),
                "status": self.drive.get_status(),
            }
        poses = (self.session or self.drive).motion.poses
        frames = [
            {
                "name": f.name,
                "stamp_ns": f.stamp_ns,
                "sequence": f.sequence,
                "pose": None if poses is None else poses[i].ravel().tolist(),
            }
            for i, f in enumerate(self.drive.frames)
        ]
        return {
            **common,
            "path": str(self.drive.recording.path),
            "frames": frames,
            "layout": self.drive.recording.layout,
            "has": sorted(self.drive.recording.contents),
        }


class Server:
    """The web application."""

    def __init__(self, content: PageContent) -> None:
        self.content = content
        self.cloud_pool = ThreadPoolExecutor(2, "cloud")
        self.action_pool = ThreadPoolExecutor(1, "action")  # one action at a time
        self.pages: set[Events] = set()
        self.prefetching: set[int] = set()
        self.app = web.Application(middlewares=[self.check_request], client_max_size=MAX_REQUEST)
        self.app.add_routes(
            [
                web.get("/", self.index),
                web.get("/static/{name}", self.static),
                web.get("/api/drive", self.drive),
                web.get("/api/cloud/{i}", self.cloud),
                web.get("/api/state", self.state),
                web.post("/api/do", self.run_action),
                web.get("/api/events", self.events),
                web.get("/api/labels/{i}", self.labels),
                web.get("/api/silhouettes", self.silhouettes),
                web.get("/api/next", self.next),
                web.post("/api/export", self.export),
            ]
        )

    @web.middleware
    async def check_request(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Refuse requests from elsewhere, and convert exceptions to one-line errors."""
        host = (request.host or "").rsplit(":", 1)[0]
        token = request.query.get("token") or request.cookies.get(_cookie_name(request)) or ""
        origin = request.headers.get("Origin")
        if host not in HOSTS or (origin is not None and origin != f"http://{request.host}"):
            return web.Response(status=403, text="this page is only available on this machine\n")
        if not hmac.compare_digest(token.encode(), self.content.token.encode()):
            return web.Response(
                status=403, text="the token is wrong or missing; open the address that lidar-perception printed\n"
            )
        try:
            response = await handler(request)
        except InputError as error:
            response = _error_response(400, str(error))
        except web.HTTPException as error:
            response = _error_response(error.status, error.reason)
        except Exception as error:  # a bug, but the journal still matches the labels
            LOG.exception("%s %s", request.method, request.path)
            response = _error_response(500, f"internal error: {type(error).__name__}: {shorten_error(error)}")
        if not response.prepared:
            response.headers.update(HEADERS)
        return response

    async def index(self, request: web.Request) -> web.StreamResponse:
        """Serve the page, and set the cookie for all further requests."""
        response = web.FileResponse(PAGE / "index.html")
        response.set_cookie(_cookie_name(request), self.content.token, httponly=True, samesite="Strict", path="/")
        return response

    async def static(self, request: web.Request) -> web.StreamResponse:
        """Serve a file of the page."""
        name = request.match_info["name"]
        if name not in {p.name for p in PAGE.iterdir() if p.is_file()}:
            return _error_response(404, f"no such file: {name[:40]}")
        return web.FileResponse(PAGE / name)

    async def drive(self, request: web.Request) -> web.StreamResponse:
        """Describe the drive or graph."""
        return web.json_response(self.content.to_json())

    def parse_frame(self, text: str) -> int:
        """Parse the number of a frame. InputError if there is no such frame."""
        first, end = self.content.drive.first, self.content.drive.end
        if not text.isascii() or not text.isdigit() or not first <= int(text[:9]) < end:
            raise InputError(f"there is no frame {text[:20]}; there are {first} .. {end - 1}")
        return int(text)

    async def cloud(self, request: web.Request) -> web.StreamResponse:
        """Send the points of a frame, and prefetch the frames around it."""
        i, drive = self.parse_frame(request.match_info["i"]), self.content.drive
        load_scan = drive.load_scan
        body = await self.run_in_thread(lambda: load_scan(i).encode())
        prefetched = 0 if self.content.live else PREFETCH_FRAMES
        for neighbour in range(max(i - prefetched, drive.first), min(i + prefetched + 1, drive.end)):
            if neighbour not in self.prefetching:
                self.prefetching.add(neighbour)
                future = asyncio.get_running_loop().run_in_executor(self.cloud_pool, load_scan, neighbour)
                future.add_done_callback(partial(self._finish_prefetch, neighbour))
        return web.Response(body=body, content_type="application/octet-stream")

    def _finish_prefetch(self, frame: int, future: asyncio.Future[Any]) -> None:
        self.prefetching.discard(frame)
        if not future.cancelled():
            future.exception()  # marks it as retrieved; a request for the frame reports it

    async def run_in_thread(self, function: Callable[[], Any]) -> Any:
        """Run a function outside the event loop and return its result."""
        return await asyncio.get_running_loop().run_in_executor(self.cloud_pool, function)

    @property
    def session(self) -> Session:
        """The labelling session. InputError if there is none."""
        if self.content.session is None:
            raise InputError("view cannot change labels; start lidar-perception label")
        return self.content.session

    async def state(self, request: web.Request) -> web.StreamResponse:
        """Send all labels, or the tracks of the results."""
        if self.content.session is None:
            return web.json_response({"seq": 0, "tracks": list(self.content.tracks())})
        return web.json_response(self.session.to_json())

    async def run_action(self, request: web.Request) -> web.StreamResponse:
        """Execute an action of a page, and send its number."""
        action = await _read_json(request)
        page_id = request.headers.get("X-Page", "")[:64]
        loop = asyncio.get_running_loop()
        seq = await loop.run_in_executor(self.action_pool, self.session.do, action, page_id)
        return web.json_response({"seq": seq})

    async def events(self, request: web.Request) -> web.StreamResponse:
        """Stream the actions of all pages, or the frames of a running graph.

        No frames are added while a paused page is connected.
        """
        socket = web.WebSocketResponse(heartbeat=20.0)
        await socket.prepare(request)
        queue: Events = asyncio.Queue(MAX_QUEUED_EVENTS)
        self.pages.add(queue)
        sender = asyncio.ensure_future(_send_events(socket, queue))
        try:
            async for message in socket:
                if message.type == WSMsgType.ERROR:
                    break
                if self.content.live and message.type == WSMsgType.TEXT:
                    self.content.live.set_paused(id(socket), message.data == "pause")
        finally:
            if self.content.live:
                self.content.live.set_paused(id(socket), False)
            self.pages.discard(queue)
            sender.cancel()
            with suppress(asyncio.CancelledError, ConnectionError):
                await sender
        return socket

    def broadcast(self, event: dict[str, Any]) -> None:
        """Queue an event for all pages. Disconnect pages that are too far behind, so that they
        reload the state."""
        for queue in list(self.pages):
            try:
                queue.put_nowait(event)
            except asyncio.QueueFull:
                self.pages.discard(queue)
                queue.get_nowait()
                queue.put_nowait(None)

    async def labels(self, request: web.Request) -> web.StreamResponse:
        """Send the labels and detections of a frame."""
        i, layers = self.parse_frame(request.match_info["i"]), self.content.layers
        if layers is None:
            return web.json_response({"labels": [], "detections": {}, "matches": {}})
        score = request.query.get("score", "0")
        min_score = float(score) if re.fullmatch(r"[01](\.\d{1,9})?", score) else 0.0
        return web.json_response(await self.run_in_thread(partial(layers, i, min_score)))

    async def silhouettes(self, request: web.Request) -> web.StreamResponse:
        """Send the silhouettes of a track and of its most similar seed."""
        session = self.session
        track = require_track(session.state, _parse_number(request.query.get("track", "")))
        frame = self.parse_frame(request.query.get("frame", ""))
        try:
            return web.json_response(
                await self.run_in_thread(partial(session.proposer.compare_with_seed, session.state, track, frame))
            )
        except InputError as error:
            return _error_response(404, str(error))

    async def next(self, request: web.Request) -> web.StreamResponse:
        """Send the next uncertain track."""
        after, class_name = _parse_number(request.query.get("after", "")), request.query.get("class")
        track = find_next_uncertain(self.session.state, after, lambda track: class_name in (None, track.class_name))
        return web.json_response({"track": track and track.id, "frame": track.find_nearest_frame() if track else 0})

    async def export(self, request: web.Request) -> web.StreamResponse:
        """Write the labels in another format."""
        options, session = await _read_json(request), self.session
        if not isinstance(options.get("format"), str) or not isinstance(options.get("out"), str):
            raise InputError("an export needs `format`, and `out`, a file or folder")
        return web.json_response(
            await self.run_in_thread(
                partial(session.export, options["format"], options["out"], options.get("force") is True)
            )
        )


def _parse_number(text: str) -> int | None:
    return int(text[:18]) if text.isascii() and text.isdigit() else None


def _cookie_name(request: web.Request) -> str:
    """Return a name that contains the port, as all ports of a host share their cookies."""
    return f"token_{request.url.port}"


def _error_response(status: int, text: str) -> web.Response:
    return web.json_response({"error": text.splitlines()[0] if text else "error"}, status=status)


async def _read_json(request: web.Request) -> Mapping[str, Any]:
    try:
        content = await request.json()
    except (ValueError, RecursionError) as error:
        raise InputError(f"the request is not valid JSON: {shorten_error(error)}") from None
    if not isinstance(content, dict):
        raise InputError("the request is not a JSON object")
    return content


async def _send_events(socket: web.WebSocketResponse, queue: Events) -> None:
    while not socket.closed and (event := await queue.get()) is not None:
        await socket.send_json(event)
    await socket.close()


def _notify_in_loop(loop: asyncio.AbstractEventLoop, server: Server, event: dict[str, Any]) -> None:
    with suppress(RuntimeError):  # the loop may be closed, because a source can outlive the server
        loop.call_soon_threadsafe(server.broadcast, event)


async def serve(content: PageContent, port: int, on_start: Callable[[str], None]) -> None:
    """Serve until SIGINT or SIGTERM.

    Args:
        port: 0 for any free port.
        on_start: called with the address of the page.

    Raises:
        InputError: the port is in use.
    """
    server, loop, stop = Server(content), asyncio.get_running_loop(), asyncio.Event()
    for signal_number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(signal_number, stop.set)
    for source in (content.session, content.live):
        if source is not None:
            source.listeners.append(partial(_notify_in_loop, loop, server))
    runner = web.AppRunner(server.app, access_log=None, shutdown_timeout=1.0)
    await runner.setup()
    site = web.TCPSite(runner, HOSTS[0], port)
    try:
        await site.start()
    except OSError as error:
        await runner.cleanup()
        raise InputError(
            f"cannot listen on port {port}: {error.strerror or error}; give another --port, or 0 for any"
        ) from None
    address = runner.addresses[0]
    on_start(f"http://{HOSTS[0]}:{address[1]}/?token={content.token}")
    try:
        await stop.wait()
    finally:
        server.pages.clear()
        await runner.cleanup()
        server.cloud_pool.shutdown(wait=False, cancel_futures=True)
        server.action_pool.shutdown(wait=True)
