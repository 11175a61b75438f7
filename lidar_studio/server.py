"""HTTP server of the page. It accepts only requests from this machine that contain a token."""

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
MAX_REQUEST_BYTES = 10**7
MAX_QUEUED_EVENTS = 1000
EventQueue = asyncio.Queue[dict[str, Any] | None]  # events for one page; None disconnects a page that is too slow
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
    """Content of the page: a drive with labels or results, or a running graph.

    Attributes:
        session: Labelling session, or None to view results without labelling.
        make_layers: Function of (frame, min_score) that returns the JSON object of /api/labels, or None
            if there are no labels and detections.
        list_tracks: Function that returns the tracks to view, as JSON objects.
        token: Secret that every request must contain.
    """

    drive: Drive | LiveGraph
    session: Session | None = None
    make_layers: Callable[[int, float], dict[str, Any]] | None = None
    list_tracks: Callable[[], Sequence[dict[str, Any]]] = tuple
    token: str = field(default_factory=partial(secrets.token_urlsafe, 24))

    @property
    def live(self) -> LiveGraph | None:
        """The running graph, or None for a drive."""
        return self.drive if isinstance(self.drive, LiveGraph) else None

    def to_json(self) -> dict[str, Any]:
        """Return the JSON object of /api/drive."""
        common_fields = {
            "name": self.drive.name,
            "mode": "label" if self.session else "view",
            "classes": list_classes(),
            "live": self.live is not None,
            "min_score": ScoreParams().get(CLASSES[PEDESTRIAN]),
            "can_export": [*FORMATS] if self.session else [],
        }
        if isinstance(self.drive, LiveGraph):
            return {
                **common_fields,
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
            **common_fields,
            "path": str(self.drive.recording.path),
            "frames": frames,
            "layout": self.drive.recording.layout,
            "has": sorted(self.drive.recording.contents),
        }


class Server:
    """The web application, with one handler per route."""

    def __init__(self, content: PageContent) -> None:
        self.content = content
        self.cloud_pool = ThreadPoolExecutor(2, "cloud")
        self.action_pool = ThreadPoolExecutor(1, "action")  # a single thread, because actions run in order
        self.pages: set[EventQueue] = set()
        self.app = web.Application(middlewares=[self.check_request], client_max_size=MAX_REQUEST_BYTES)
        self.app.add_routes(
            [
                web.get("/", self.send_page),
                web.get("/static/{name}", self.send_static_file),
                web.get("/api/drive", self.send_drive),
                web.get("/api/cloud/{i}", self.send_cloud),
                web.get("/api/state", self.send_state),
                web.post("/api/do", self.execute_action),
                web.get("/api/events", self.stream_events),
                web.get("/api/labels/{i}", self.send_labels),
                web.get("/api/silhouettes", self.send_silhouettes),
                web.get("/api/next", self.send_next_track),
                web.post("/api/export", self.export_labels),
            ]
        )

    @web.middleware
    async def check_request(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Reject requests from other origins or without the token, and convert exceptions to one-line errors."""
        host = (request.host or "").rsplit(":", 1)[0]
        token = request.query.get("token") or request.cookies.get(_get_cookie_name(request)) or ""
        origin = request.headers.get("Origin")
        if host not in HOSTS or (origin is not None and origin != f"http://{request.host}"):
            return web.Response(status=403, text="this page is only available on this machine\n")
        if not hmac.compare_digest(token.encode(), self.content.token.encode()):
            return web.Response(
                status=403, text="missing or wrong token; open the address that lidar-perception printed\n"
            )
        try:
            response = await handler(request)
        except InputError as error:
            response = _make_error_response(400, str(error))
        except web.HTTPException as error:
            response = _make_error_response(error.status, error.reason)
        except Exception as error:  # a bug; the server can go on, because the journal still matches the labels
            LOG.exception("%s %s", request.method, request.path)
            response = _make_error_response(500, f"internal error: {type(error).__name__}: {shorten_error(error)}")
        if not response.prepared:
            response.headers.update(HEADERS)
        return response

    async def send_page(self, request: web.Request) -> web.StreamResponse:
        """Send the HTML page, with a cookie that contains the token for further requests."""
        response = web.FileResponse(PAGE / "index.html")
        response.set_cookie(_get_cookie_name(request), self.content.token, httponly=True, samesite="Strict", path="/")
        return response

    async def send_static_file(self, request: web.Request) -> web.StreamResponse:
        """Send a file of the page."""
        name = request.match_info["name"]
        if name not in {p.name for p in PAGE.iterdir() if p.is_file()}:
            return _make_error_response(404, f"no such file: {name[:40]}")
        return web.FileResponse(PAGE / name)

    async def send_drive(self, request: web.Request) -> web.StreamResponse:
        """Send a description of the drive or graph."""
        return web.json_response(self.content.to_json())

    def parse_frame(self, text: str) -> int:
        """Parse a frame number, or raise InputError if there is no such frame."""
        first, end = self.content.drive.first, self.content.drive.end
        if not text.isascii() or not text.isdigit() or not first <= int(text[:9]) < end:
            raise InputError(f"frame {text[:20]} does not exist; valid frames are {first} to {end - 1}")
        return int(text)

    async def send_cloud(self, request: web.Request) -> web.StreamResponse:
        """Send the points of a frame."""
        i, load_scan = self.parse_frame(request.match_info["i"]), self.content.drive.load_scan
        body = await self.run_in_thread(lambda: load_scan(i).encode())
        return web.Response(body=body, content_type="application/octet-stream")

    async def run_in_thread(self, function: Callable[[], Any]) -> Any:
        """Run a function in a thread, so that it does not block the event loop, and return its result."""
        return await asyncio.get_running_loop().run_in_executor(self.cloud_pool, function)

    @property
    def session(self) -> Session:
        """The labelling session. Raises InputError in view mode."""
        if self.content.session is None:
            raise InputError("labels cannot be changed in view mode; run lidar-perception label")
        return self.content.session

    async def send_state(self, request: web.Request) -> web.StreamResponse:
        """Send all labels, or the tracks of the results."""
        if self.content.session is None:
            return web.json_response({"seq": 0, "tracks": list(self.content.list_tracks())})
        return web.json_response(self.session.to_json())

    async def execute_action(self, request: web.Request) -> web.StreamResponse:
        """Execute an action sent by a page, and reply with its number."""
        action = await _read_json(request)
        page_id = request.headers.get("X-Page", "")[:64]
        loop = asyncio.get_running_loop()
        seq = await loop.run_in_executor(self.action_pool, self.session.execute, action, page_id)
        return web.json_response({"seq": seq})

    async def stream_events(self, request: web.Request) -> web.StreamResponse:
        """Stream the actions of all pages, or the frames of a running graph, over a WebSocket.

        A running graph adds no frames while any connected page is paused.
        """
        socket = web.WebSocketResponse(heartbeat=20.0)
        await socket.prepare(request)
        queue: EventQueue = asyncio.Queue(MAX_QUEUED_EVENTS)
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
        """Queue an event for all pages. Pages with a full queue are disconnected, so that they reload the state."""
        for queue in list(self.pages):
            try:
                queue.put_nowait(event)
            except asyncio.QueueFull:
                self.pages.discard(queue)
                queue.get_nowait()
                queue.put_nowait(None)

    async def send_labels(self, request: web.Request) -> web.StreamResponse:
        """Send the labels and detections of a frame."""
        i, make_layers = self.parse_frame(request.match_info["i"]), self.content.make_layers
        if make_layers is None:
            return web.json_response({"labels": [], "detections": {}, "matches": {}})
        score = request.query.get("score", "0")
        min_score = float(score) if re.fullmatch(r"[01](\.\d{1,9})?", score) else 0.0
        return web.json_response(await self.run_in_thread(partial(make_layers, i, min_score)))

    async def send_silhouettes(self, request: web.Request) -> web.StreamResponse:
        """Send the silhouettes of a track and of its most similar seed."""
        session = self.session
        track = require_track(session.state, _parse_number(request.query.get("track", "")))
        frame = self.parse_frame(request.query.get("frame", ""))
        try:
            return web.json_response(
                await self.run_in_thread(partial(session.proposer.compare_with_seed, session.state, track, frame))
            )
        except InputError as error:
            return _make_error_response(404, str(error))

    async def send_next_track(self, request: web.Request) -> web.StreamResponse:
        """Send the id of the next uncertain track, and the frame in which the object is nearest."""
        after, class_name = _parse_number(request.query.get("after", "")), request.query.get("class")
        track = find_next_uncertain(self.session.state, after, lambda track: class_name in (None, track.class_name))
        return web.json_response({"track": track and track.id, "frame": track.find_nearest_frame() if track else 0})

    async def export_labels(self, request: web.Request) -> web.StreamResponse:
        """Export the labels to a file or folder."""
        options, session = await _read_json(request), self.session
        if not isinstance(options.get("format"), str) or not isinstance(options.get("out"), str):
            raise InputError("an export requires `format` and `out` (a file or folder), both strings")
        return web.json_response(
            await self.run_in_thread(
                partial(session.export, options["format"], options["out"], options.get("force") is True)
            )
        )


def _parse_number(text: str) -> int | None:
    return int(text[:18]) if text.isascii() and text.isdigit() else None


def _get_cookie_name(request: web.Request) -> str:
    """Return the name of the token's cookie. It contains the port, because servers on a host share cookies."""
    return f"token_{request.url.port}"


def _make_error_response(status: int, text: str) -> web.Response:
    return web.json_response({"error": text.splitlines()[0] if text else "error"}, status=status)


async def _read_json(request: web.Request) -> Mapping[str, Any]:
    try:
        content = await request.json()
    except (ValueError, RecursionError) as error:
        raise InputError(f"the request is not valid JSON: {shorten_error(error)}") from None
    if not isinstance(content, dict):
        raise InputError("the request is not a JSON object")
    return content


async def _send_events(socket: web.WebSocketResponse, queue: EventQueue) -> None:
    while not socket.closed and (event := await queue.get()) is not None:
        await socket.send_json(event)
    await socket.close()


def _notify_in_loop(loop: asyncio.AbstractEventLoop, server: Server, event: dict[str, Any]) -> None:
    with suppress(RuntimeError):  # the loop is closed if the session or graph outlives the server
        loop.call_soon_threadsafe(server.broadcast, event)


async def serve(content: PageContent, port: int, on_start: Callable[[str], None]) -> None:
    """Serve the page until SIGINT or SIGTERM.

    Args:
        port: Port to listen on, 0 for any free port.
        on_start: Function called with the address of the page.

    Raises:
        InputError: The port is in use.
    """
    server, loop, stop_event = Server(content), asyncio.get_running_loop(), asyncio.Event()
    for signal_number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(signal_number, stop_event.set)
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
            f"cannot listen on port {port}: {error.strerror or error}; choose another --port, or 0 for any free port"
        ) from None
    address = runner.addresses[0]
    on_start(f"http://{HOSTS[0]}:{address[1]}/?token={content.token}")
    try:
        await stop_event.wait()
    finally:
        server.pages.clear()
        await runner.cleanup()
        server.cloud_pool.shutdown(wait=False, cancel_futures=True)
        server.action_pool.shutdown(wait=True)
