"""The page's server: local only, with a token, for one drive."""

from __future__ import annotations

import asyncio
import hmac
import logging
import re
import signal
from collections.abc import Awaitable, Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from aiohttp import WSMsgType, web

from lidar_perception.runs.files import shorten_error
from lidar_perception.types import InputError
from lidar_studio.actions import track_of
from lidar_studio.served import Served
from lidar_studio.session import Session
from lidar_studio.state import next_uncertain

LOG = logging.getLogger(__name__)
HOSTS = ("127.0.0.1", "localhost")
PAGE = Path(__file__).with_name("page")
MAX_REQUEST = 10**7     # bytes
MAX_WAITING = 1000      # events that a page may be behind
AHEAD = 2               # frames on either side that are made ready
Events = asyncio.Queue[dict[str, Any] | None]  # for a page; None: it is too far behind
HEADERS = {"Cache-Control": "no-store", "X-Content-Type-Options": "nosniff",
           "Referrer-Policy": "no-referrer",
           "Content-Security-Policy": "default-src 'self'; style-src 'self' 'unsafe-inline'; "
                                      "img-src 'self' data: blob:; frame-ancestors 'none'"}
Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class Server:
    """The application of what is served."""

    def __init__(self, served: Served) -> None:
        self.served = served
        self.pool = ThreadPoolExecutor(2, "cloud")
        self.doing = ThreadPoolExecutor(1, "action")  # one after the other
        self.pages: set[Events] = set()
        self.ready: set[int] = set()
        self.app = web.Application(middlewares=[self.guard], client_max_size=MAX_REQUEST)
        self.app.add_routes([
            web.get("/", self.index), web.get("/static/{name}", self.static),
            web.get("/api/drive", self.drive), web.get("/api/cloud/{i}", self.cloud),
            web.get("/api/state", self.state), web.post("/api/do", self.do),
            web.get("/api/events", self.events), web.get("/api/labels/{i}", self.labels),
            web.get("/api/silhouettes", self.silhouettes), web.get("/api/next", self.next),
            web.post("/api/export", self.export)])

    @web.middleware
    async def guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Nobody but the page, and an error in one line."""
        host = (request.host or "").rsplit(":", 1)[0]
        given = request.query.get("token") or request.cookies.get(_cookie(request)) or ""
        origin = request.headers.get("Origin")
        if host not in HOSTS or (origin is not None and origin != f"http://{request.host}"):
            return web.Response(status=403, text="this page is served to this machine only\n")
        if not hmac.compare_digest(given.encode(), self.served.token.encode()):
            return web.Response(status=403, text="the token is wrong or missing; open the address "
                                                 "that lidar-perception printed\n")
        try:
            response = await handler(request)
        except InputError as error:
            response = _error(400, str(error))
        except web.HTTPException as error:
            response = _error(error.status, error.reason)
        except Exception as error:  # ours; the page is told, and the labels are as the journal has
            LOG.exception("%s %s", request.method, request.path)  # them
            response = _error(500, f"this failed: {type(error).__name__}: {shorten_error(error)}")
        if not response.prepared:
            response.headers.update(HEADERS)
        return response

    async def index(self, request: web.Request) -> web.StreamResponse:
        """The page; from now on the cookie is enough."""
        response = web.FileResponse(PAGE / "index.html")
        response.set_cookie(_cookie(request), self.served.token, httponly=True,
                            samesite="Strict", path="/")
        return response

    async def static(self, request: web.Request) -> web.StreamResponse:
        """A file of the package."""
        name = request.match_info["name"]
        if name not in {p.name for p in PAGE.iterdir() if p.is_file()}:
            return _error(404, f"there is no {name[:40]}")
        return web.FileResponse(PAGE / name)

    async def drive(self, request: web.Request) -> web.StreamResponse:
        """What is looked at."""
        return web.json_response(self.served.described())

    def frame(self, text: str) -> int:
        """The number of a frame. InputError where there is none of it."""
        first, end = self.served.drive.first, self.served.drive.end
        if not text.isascii() or not text.isdigit() or not first <= int(text[:9]) < end:
            raise InputError(f"there is no frame {text[:20]}; there are {first} .. {end - 1}")
        return int(text)

    async def cloud(self, request: web.Request) -> web.StreamResponse:
        """The points of a frame; those around it are made ready."""
        i, drive = self.frame(request.match_info["i"]), self.served.drive
        clouds = drive.clouds
        body = await self.in_thread(lambda: clouds(i).encoded())
        ahead = 0 if self.served.live else AHEAD
        for near in range(max(i - ahead, drive.first), min(i + ahead + 1, drive.end)):
            if near not in self.ready:
                self.ready.add(near)
                made = asyncio.get_running_loop().run_in_executor(self.pool, clouds, near)
                made.add_done_callback(partial(self._made_ready, near))
        return web.Response(body=body, content_type="application/octet-stream")

    def _made_ready(self, near: int, made: asyncio.Future[Any]) -> None:
        self.ready.discard(near)
        if not made.cancelled():
            made.exception()  # whoever asks for the frame is told

    async def in_thread(self, work: Callable[[], Any]) -> Any:
        """What work gives, beside the event loop."""
        return await asyncio.get_running_loop().run_in_executor(self.pool, work)

    @property
    def session(self) -> Session:
        """InputError where nothing is labelled."""
        if self.served.session is None:
            raise InputError("results are looked at; to change labels start lidar-perception label")
        return self.served.session

    async def state(self, request: web.Request) -> web.StreamResponse:
        """All labels, or all tracks of the results."""
        if self.served.session is None:
            return web.json_response({"seq": 0, "tracks": list(self.served.tracks())})
        return web.json_response(self.session.everything())

    async def do(self, request: web.Request) -> web.StreamResponse:
        """An action."""
        action = await _object(request)
        by = request.headers.get("X-Page", "")[:64]
        loop = asyncio.get_running_loop()
        seq = await loop.run_in_executor(self.doing, self.session.do, action, by)
        return web.json_response({"seq": seq})

    async def events(self, request: web.Request) -> web.StreamResponse:
        """What is done, also by other pages; what comes, where a running graph is shown: a page
        that has paused says so, and the frames are held for as long as it is there."""
        socket = web.WebSocketResponse(heartbeat=20.0)
        await socket.prepare(request)
        queue: Events = asyncio.Queue(MAX_WAITING)
        self.pages.add(queue)
        sender = asyncio.ensure_future(_send(socket, queue))
        try:
            async for message in socket:
                if message.type == WSMsgType.ERROR:
                    break
                if self.served.live and message.type == WSMsgType.TEXT:
                    self.served.live.hold(id(socket), message.data == "hold")
        finally:
            if self.served.live:
                self.served.live.hold(id(socket), False)
            self.pages.discard(queue)
            sender.cancel()
            with suppress(asyncio.CancelledError, ConnectionError):
                await sender
        return socket

    def tell(self, event: dict[str, Any]) -> None:
        """All pages; one that is too far behind is disconnected, so that it reloads."""
        for queue in list(self.pages):
            try:
                queue.put_nowait(event)
            except asyncio.QueueFull:
                self.pages.discard(queue)
                queue.get_nowait()
                queue.put_nowait(None)

    async def labels(self, request: web.Request) -> web.StreamResponse:
        """Labels and detections of a frame."""
        i, layers = self.frame(request.match_info["i"]), self.served.layers
        if layers is None:
            return web.json_response({"labels": [], "detections": {}, "matches": {}})
        score = request.query.get("score", "0")
        least = float(score) if re.fullmatch(r"[01](\.\d{1,9})?", score) else 0.0
        return web.json_response(await self.in_thread(partial(layers, i, least)))

    async def silhouettes(self, request: web.Request) -> web.StreamResponse:
        """Of the seed and a candidate."""
        made = self.session
        track = track_of(made.state, _number(request.query.get("track", "")))
        frame = self.frame(request.query.get("frame", ""))
        try:
            return web.json_response(await self.in_thread(partial(
                made.proposer.silhouettes, made.state, track, frame)))
        except InputError as error:
            return _error(404, str(error))

    async def next(self, request: web.Request) -> web.StreamResponse:
        """The next uncertain track."""
        after, only = _number(request.query.get("after", "")), request.query.get("class")
        track = next_uncertain(self.session.state, after,
                               lambda track: only in (None, track.class_name))
        return web.json_response({"track": track and track.id,
                                  "frame": track.nearest_frame() if track else 0})

    async def export(self, request: web.Request) -> web.StreamResponse:
        """Write the labels in another format."""
        asked, made = await _object(request), self.served.session
        if made is None:
            raise InputError("export is not available")
        if not isinstance(asked.get("format"), str) or not isinstance(asked.get("out"), str):
            raise InputError("an export needs a format and out, the name of a folder")
        return web.json_response(await self.in_thread(partial(
            made.export, asked["format"], asked["out"], asked.get("force") is True)))


def _number(text: str) -> int | None:
    return int(text[:18]) if text.isascii() and text.isdigit() else None


def _cookie(request: web.Request) -> str:
    """Cookies do not tell ports apart, and there may be two servers."""
    return f"token_{request.url.port}"


def _error(status: int, text: str) -> web.Response:
    return web.json_response({"error": text.splitlines()[0] if text else "error"}, status=status)


async def _object(request: web.Request) -> Mapping[str, Any]:
    try:
        found = await request.json()
    except (ValueError, RecursionError) as error:
        raise InputError(f"the request is no JSON: {shorten_error(error)}") from None
    if not isinstance(found, dict):
        raise InputError("the request is no JSON object")
    return found


async def _send(socket: web.WebSocketResponse, queue: Events) -> None:
    while not socket.closed and (event := await queue.get()) is not None:
        await socket.send_json(event)
    await socket.close()


def _in_loop(loop: asyncio.AbstractEventLoop, server: Server, event: dict[str, Any]) -> None:
    with suppress(RuntimeError):  # the loop is closed: the server ends before what it listens to
        loop.call_soon_threadsafe(server.tell, event)


async def serve(served: Served, port: int, started: Callable[[str], None]) -> None:
    """Serve until SIGINT or SIGTERM. started is told the address. InputError where the port is
    taken."""
    server, loop, end = Server(served), asyncio.get_running_loop(), asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, end.set)
    for source in (served.session, served.live):
        if source is not None:
            source.listeners.append(partial(_in_loop, loop, server))
    runner = web.AppRunner(server.app, access_log=None, shutdown_timeout=1.0)
    await runner.setup()
    site = web.TCPSite(runner, HOSTS[0], port)
    try:
        await site.start()
    except OSError as error:
        await runner.cleanup()
        raise InputError(f"cannot listen on port {port}: {error.strerror or error}; give another "
                         "--port, or 0 for any") from None
    address = runner.addresses[0]
    started(f"http://{HOSTS[0]}:{address[1]}/?token={served.token}")
    try:
        await end.wait()
    finally:
        server.pages.clear()
        await runner.cleanup()
        server.pool.shutdown(wait=False, cancel_futures=True)
        server.doing.shutdown(wait=True)
