"""Fixtures: a browser, and the page of label in it."""

from __future__ import annotations

import socket

import pytest
from browsing import browsing
from labeling_pages import Label, find_nearest_person, open_page, run_server

from lidar_perception.data.open import open_recording


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


@pytest.fixture(scope="module")
def browser():
    with browsing() as started:
        yield started


@pytest.fixture(scope="module")
def labels(drive_bag, tmp_path_factory):
    """A running label server, on a port that stays the same after a restart."""
    out, port = tmp_path_factory.mktemp("labels"), free_port()
    arguments = ("label", "--data", str(drive_bag), "--out", str(out), "--no-open", "--no-propose", "--port", str(port))
    with run_server(*arguments) as server:
        yield Label(server.process, server.url, out, arguments)


@pytest.fixture(scope="module")
def first_page(browser, labels):
    with open_page(browser, labels.url) as opened_page:
        yield opened_page


@pytest.fixture
def page(first_page):
    """The shared page, on the first frame and without a selection."""
    first_page.keyboard.press("Escape")
    first_page.keyboard.press("Escape")
    first_page.keyboard.press("Home")
    return first_page


@pytest.fixture(scope="module")
def person(drive_bag):
    """Box (7,) of a labelled person near the sensor in the first frame."""
    return find_nearest_person(next(iter(open_recording(drive_bag))))
