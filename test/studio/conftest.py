"""A browser, and the page of label in it."""

from __future__ import annotations

import socket

import pytest
from browsing import browsing
from labeling_pages import Label, labelled_person, opened, serving

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
    """The labelling of a drive, at the address that stays the same when its server is started
    again."""
    out, port = tmp_path_factory.mktemp("labels"), free_port()
    arguments = ("label", "--data", str(drive_bag), "--out", str(out), "--no-open", "--no-propose",
                 "--port", str(port))
    with serving(*arguments) as server:
        yield Label(server.process, server.url, out, arguments)


@pytest.fixture(scope="module")
def first_page(browser, labels):
    with opened(browser, labels.url) as made:
        yield made


@pytest.fixture
def page(first_page):
    """A page on the first frame, in which nothing is selected: the same for all tests, as an
    annotator's stays open."""
    first_page.keyboard.press("Escape")
    first_page.keyboard.press("Escape")
    first_page.keyboard.press("Home")
    return first_page


@pytest.fixture(scope="module")
def person(drive_bag):
    """(7,) the box of a labelled person near the sensor in the first frame."""
    return labelled_person(next(iter(open_recording(drive_bag))))
