"""Screenshot of the page with headless Chromium, controlled over its DevTools protocol."""

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
from lidar_studio.page_content import PageContent
from lidar_studio.server import serve

# The headless builds come first: they start faster.
BROWSERS = ("chromium-headless-shell", "chrome-headless-shell", "chromium", "chromium-browser",
            "google-chrome", "google-chrome-stable")
FLAGS = ("--headless", "--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader",
         "--hide-scrollbars", "--disable-quic", "--no-first-run", "--disable-sync",
         "--disable-background-networking", "--disable-component-update", "--mute-audio",
         "--remote-debugging-port=0")
DEFAULT_SIZE = (1280, 720)
BROWSER_TIMEOUT_S, PAGE_TIMEOUT_S = 30.0, 300.0  # the page may wait for a slow detector
IS_READY = "document.documentElement.dataset.ready === 'true'"
Call = Callable[..., Awaitable[dict[str, Any]]]


def find_browser() -> str | None:
    """Return the path of the first installed browser of BROWSERS, or None."""
    return next(filter(None, map(shutil.which, BROWSERS)), None)


async def write_screenshot(content: PageContent, path: Path, query: str = "",
                           size: tuple[int, int] = DEFAULT_SIZE) -> None:
    """Write a PNG of the completely loaded page.

    Args:
        query: for the page's address, such as frame=12.
        size: width and height of the window in pixels.

    Raises:
        InputError: no browser is installed, or the page does not load.
    """
    if (browser := find_browser()) is None:
        raise InputError("a screenshot needs chromium; install it (apt install chromium), or leave "
                         "out --screenshot and open the page in another browser")
    address: asyncio.Future[str] = asyncio.get_running_loop().create_future()
    serving = asyncio.create_task(serve(content, 0, address.set_result))
    try:
        url = await address
        async with _open_devtools(browser, size) as call:
            await call("Page.navigate", url=f"{url}&{query}")
            await _wait_until_ready(call)
            image = await call("Page.captureScreenshot", format="png")
        write_bytes(path, base64.b64decode(image["data"]))
    finally:
        serving.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await serving


async def _wait_until_ready(call: Call) -> None:
    end = asyncio.get_running_loop().time() + PAGE_TIMEOUT_S
    while asyncio.get_running_loop().time() < end:
        found = await call("Runtime.evaluate", expression=IS_READY)
        if found["result"].get("value") is True:
            return
        await asyncio.sleep(0.1)
    raise InputError(f"the page was not ready within {PAGE_TIMEOUT_S:.0f} s; open it without "
                     "--screenshot to see the reason")


@contextlib.asynccontextmanager
async def _open_devtools(browser: str, size: tuple[int, int]) -> AsyncIterator[Call]:
    """Start a browser and yield call(method, **params) of its page; the browser ends with the
    context."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        process = await asyncio.create_subprocess_exec(
            browser, *FLAGS, f"--window-size={size[0]},{size[1]}", f"--user-data-dir={profile}",
            "about:blank", stdin=asyncio.subprocess.DEVNULL, stdout=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.DEVNULL, start_new_session=True)
        try:
            port = await _read_port(browser, Path(profile) / "DevToolsActivePort", process)
            async with aiohttp.ClientSession() as http:
                async with http.get(f"http://127.0.0.1:{port}/json/list") as reply:
                    page = next(p for p in await reply.json() if p["type"] == "page")
                async with http.ws_connect(page["webSocketDebuggerUrl"], max_msg_size=0) as socket:
                    call = _make_caller(socket)
                    await call("Emulation.setDeviceMetricsOverride", width=size[0],
                               height=size[1], deviceScaleFactor=1, mobile=False)
                    yield call
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)  # the command may be a wrapper script
            await process.wait()


async def _read_port(browser: str, file: Path, process: asyncio.subprocess.Process) -> int:
    end = asyncio.get_running_loop().time() + BROWSER_TIMEOUT_S
    while asyncio.get_running_loop().time() < end and process.returncode is None:
        with contextlib.suppress(OSError, ValueError, IndexError):
            return int(file.read_text().splitlines()[0])
        await asyncio.sleep(0.05)
    raise InputError(f"{browser} did not start; try it by hand: {browser} --headless about:blank")


def _make_caller(socket: aiohttp.ClientWebSocketResponse) -> Call:
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
