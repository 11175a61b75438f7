"""Helpers for tests of the page: run a server, click, drag, read the state."""

from __future__ import annotations

import json
import math
import multiprocessing
import os
import sys
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from time import monotonic, sleep
from typing import TextIO

import numpy as np

from lidar_perception.classes import PEDESTRIAN
from lidar_perception.cli.main import main
from lidar_perception.geometry import points_in_box
from lidar_studio import results, server, session  # noqa: F401
from lidar_studio.cli import label, view  # noqa: F401  loaded once, for all servers

PATIENCE = 60.0  # seconds
NEAR = 20.0  # metres


def find_nearest_person(frame) -> np.ndarray:
    """Return the box (7,) of the labelled person within NEAR with the most points."""
    cloud = frame.load().xyz
    boxes = [b for b in frame.truth().select_class(PEDESTRIAN) if math.hypot(b[0], b[1]) < NEAR]
    return max(boxes, key=lambda b: points_in_box(cloud, b).sum())


@dataclass
class Server:
    """The process of a command, the address that it printed, and its error output."""

    process: multiprocessing.Process
    url: str
    errors: TextIO


@contextmanager
def run_server(*arguments: object, before: Callable[[], None] = lambda: None) -> Iterator[Server]:
    """Run label or view in a fork of this process, which has loaded all modules.
    before: called first in the fork."""
    (out, out_end), (errors, errors_end) = os.pipe(), os.pipe()
    process = multiprocessing.get_context("fork").Process(
        target=_run_command, args=([str(a) for a in arguments], out_end, errors_end, before)
    )
    process.start()
    os.close(out_end)
    os.close(errors_end)
    with open(out) as lines, open(errors) as problems:
        try:
            url = lines.readline().strip()
            assert url.startswith("http://127.0.0.1:"), (url, problems.read())
            yield Server(process, url, problems)
        finally:
            process.kill()
            process.join()


def _run_command(arguments: list[str], out_end: int, errors_end: int, before: Callable[[], None]) -> None:
    sys.argv = ["lidar-perception", *arguments]
    sys.stdout, sys.stderr = open(out_end, "w", 1), open(errors_end, "w", 1)
    before()
    main()


@dataclass
class Label:
    """A running label server, with HTTP access to its state."""

    process: multiprocessing.Process
    url: str
    out: Path
    arguments: tuple[str, ...]

    def state(self) -> dict:
        base, _, token = self.url.partition("?")
        with urllib.request.urlopen(f"{base}api/state?{token}") as reply:
            return json.load(reply)

    def tracks(self) -> dict[int, dict]:
        return {track["id"]: track for track in self.state()["tracks"]}

    def box(self, number: int) -> list[float]:
        """Return the box of a track in frame 0."""
        return get_boxes(self.tracks()[number])[0]

    def lines(self) -> list[dict]:
        """Return the lines of the journal."""
        return [json.loads(line) for line in (self.out / "journal.jsonl").read_text().splitlines()]

    def look_at(self, page, person: np.ndarray) -> None:
        """Centre the view on a person, from the side of the sensor."""
        x, y, z = map(float, person[:3])
        away = 5.0 / math.hypot(x, y)
        page.evaluate("([place, from]) => page.lookAt(place, from)", [[x, y, z], [x - x * away, y - y * away, z + 1.5]])

    def seed(self, page, person: np.ndarray) -> int:
        """Click a person to place a seed; return the id of the new track."""
        before = set(self.tracks())
        self.look_at(page, person)
        page.keyboard.press("Escape")
        page.keyboard.press("s")
        area = page.locator("#scene").bounding_box()
        at = page.evaluate("p => page.project(...p)", [*map(float, person[:3])])
        page.mouse.click(area["x"] + at[0], area["y"] + at[1])
        page.wait_for_function(
            "before => page.store.selected !== null && !before.includes(page.store.selected)", arg=sorted(before)
        )
        page.keyboard.press("Escape")
        return page.evaluate("page.store.selected")

    def add_track(self, page, person: np.ndarray) -> int:
        """Create and select a new track of a person. After a decision the selection stays on the track."""
        number = self.seed(page, person)
        page.uncheck("#advance")
        page.locator("#scene").focus()
        page.keyboard.press("f")
        wait_until_drawn(page)
        return number

    def wait(self, page, number: int, condition) -> None:
        """Wait until a condition holds for a track, on the server and on the page."""
        end = monotonic() + PATIENCE
        while not condition(self.tracks().get(number)):
            assert monotonic() < end, (self.tracks().get(number), self.lines()[-3:])
            sleep(0.02)
        page.wait_for_function("n => page.store.seq >= n", arg=self.state()["seq"])
        page.wait_for_function("() => page.store.draft === null")


@contextmanager
def open_page(browser, url: str, before: Callable = lambda page: None) -> Iterator:
    """Open an address in a new page. before: called with the page first."""
    context = browser.new_context(viewport={"width": 1280, "height": 720})
    page, problems = context.new_page(), []
    page.set_default_timeout(60_000)
    page.on("pageerror", lambda error: problems.append(error))
    page.on(
        "request",
        lambda r: (
            problems.append(r.url) if "127.0.0.1" not in r.url and not r.url.startswith(("data:", "blob:")) else None
        ),
    )
    before(page)
    page.goto(url)
    page.wait_for_selector("html[data-ready=true]", state="attached")
    yield page
    context.close()
    assert problems == []


def get_boxes(track: dict) -> dict[int, list[float]]:
    return {row[0]: row[1:8] for row in track["boxes"]}


def get_face_positions(box: list[float]) -> dict[str, float]:
    """Return the distance of each face from the origin along its outward axis."""
    x, y, z, *size, yaw = box
    cos, sin = math.cos(yaw), math.sin(yaw)
    along = cos * x + sin * y, -sin * x + cos * y, z
    return {
        f"{sign}{axis}": (1 if sign == "+" else -1) * along[k] + size[k] / 2
        for k, axis in enumerate("xyz")
        for sign in "+-"
    }


def wait_until_drawn(page) -> None:
    """Wait until the current state of the page is drawn."""
    page.evaluate("() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")


def get_centre(page, selector: str) -> tuple[float, float]:
    """Return the centre of an element in page pixels."""
    wait_until_drawn(page)
    area = page.locator(selector).bounding_box()
    return area["x"] + area["width"] / 2, area["y"] + area["height"] / 2


def drag(page, start: tuple[float, float], offset: tuple[float, float]) -> None:
    page.mouse.move(*start)
    page.mouse.down()
    page.mouse.move(start[0] + offset[0], start[1] + offset[1], steps=5)
    page.mouse.up()
