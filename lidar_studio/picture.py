"""A picture of the page, by chromium without a window: it is told what to do over its DevTools."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import itertools
import os
import shutil
import signal
import tempfile
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Any

import aiohttp

from lidar_perception.runs.files import write_bytes
from lidar_perception.types import InputError
from lidar_studio.served import Served
from lidar_studio.server import serve

# Those that have no window anyway take a fifth less time.
BROWSERS = ("chromium-headless-shell", "chrome-headless-shell", "chromium", "chromium-browser",
            "google-chrome", "google-chrome-stable")
FLAGS = ("--headless", "--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader",
         "--hide-scrollbars", "--disable-quic", "--no-first-run", "--disable-sync",
         "--disable-background-networking", "--disable-component-update", "--mute-audio",
         "--remote-debugging-port=0")
SIZE = (1280, 720)
START, READY = 30.0, 300.0  # seconds for the browser, and for the page, whose detector may be slow
IS_READY = "document.documentElement.dataset.ready === 'true'"
Call = Callable[..., Awaitable[dict[str, Any]]]


def browser_here() -> str | None:
    """The path of a browser that needs no window, the first of BROWSERS that is installed."""
    return next(filter(None, map(shutil.which, BROWSERS)), None)


async def screenshot_of(served: Served, path: Path, query: str = "",
                        size: tuple[int, int] = SIZE) -> None:
    """Write a PNG of the page with what is served, as it is once all is shown. query: of the page's
    address, such as frame=12. InputError where there is no browser, or the page does not come."""
    if (browser := browser_here()) is None:
        raise InputError("a screenshot needs chromium; install it (apt install chromium), or leave "
                         "out --screenshot and open the page in another browser")
    address: asyncio.Future[str] = asyncio.get_running_loop().create_future()
    serving = asyncio.create_task(serve(served, 0, address.set_result))
    try:
        url = await address
        async with _devtools(browser, size) as call:
            await call("Page.navigate", url=f"{url}&{query}")
            await _until_ready(call)
            taken = await call("Page.captureScreenshot", format="png")
        write_bytes(path, base64.b64decode(taken["data"]))
    finally:
        serving.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await serving


async def _until_ready(call: Call) -> None:
    end = asyncio.get_running_loop().time() + READY
    while asyncio.get_running_loop().time() < end:
        found = await call("Runtime.evaluate", expression=IS_READY)
        if found["result"].get("value") is True:
            return
        await asyncio.sleep(0.1)
    raise InputError(f"the page was not ready within {READY:.0f} s; open it without --screenshot "
                     "to see why")


@contextlib.asynccontextmanager
async def _devtools(browser: str, size: tuple[int, int]) -> AsyncIterator[Call]:
    """call(method, **params) of a new page of a browser, which ends with the block."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        process = await asyncio.create_subprocess_exec(
            browser, *FLAGS, f"--window-size={size[0]},{size[1]}", f"--user-data-dir={profile}",
            "about:blank", stdin=asyncio.subprocess.DEVNULL, stdout=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.DEVNULL, start_new_session=True)
        try:
            port = await _port(browser, Path(profile) / "DevToolsActivePort", process)
            async with aiohttp.ClientSession() as http:
                async with http.get(f"http://127.0.0.1:{port}/json/list") as reply:
                    page = next(p for p in await reply.json() if p["type"] == "page")
                async with http.ws_connect(page["webSocketDebuggerUrl"], max_msg_size=0) as socket:
                    call = _caller(socket)
                    await call("Emulation.setDeviceMetricsOverride", width=size[0],
                               height=size[1], deviceScaleFactor=1, mobile=False)
                    yield call
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)  # the command may be a script that waits
            await process.wait()


async def _port(browser: str, file: Path, process: asyncio.subprocess.Process) -> int:
    end = asyncio.get_running_loop().time() + START
    while asyncio.get_running_loop().time() < end and process.returncode is None:
        with contextlib.suppress(OSError, ValueError, IndexError):
            return int(file.read_text().splitlines()[0])
        await asyncio.sleep(0.05)
    raise InputError(f"{browser} did not start; try it by hand: {browser} --headless about:blank")


def _caller(socket: aiohttp.ClientWebSocketResponse) -> Call:
    numbers = itertools.count(1)

    async def call(method: str, **params: Any) -> dict[str, Any]:
        number = next(numbers)
        await socket.send_json({"id": number, "method": method, "params": params})
        while True:
            answer = await socket.receive_json()
            if answer.get("id") == number:
                if "error" in answer:
                    raise InputError(f"chromium: {answer['error'].get('message', method)}")
                return answer["result"]
    return call
