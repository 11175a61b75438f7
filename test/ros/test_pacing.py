"""Pacing of the player: when the next cloud may be sent."""

from __future__ import annotations

import os
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")

from lidar_perception.nodes.replay import pacing
from lidar_perception.runs.threads import PASSIVE_WAITING


def make_stamp(number):
    return number.to_bytes(8, "little")


def make_pace(topics, ahead, timeout=10.0):
    return pacing.Pace(SimpleNamespace(create_subscription=lambda *_, **__: None), topics, ahead, timeout)


def test_player_limits_clouds_in_flight():
    """Results may arrive late, twice, or never."""
    rng = np.random.default_rng(0)
    for _ in range(100):
        topics, ahead = ["/a", "/b"][: rng.integers(1, 3)], int(rng.integers(1, 4))
        pace, answers = make_pace(topics, ahead), 0

        def serve(pace=pace, topics=topics):
            nonlocal answers
            number, topic = int(rng.integers(0, 40)), str(rng.choice(topics))
            before = len(pace.unanswered_clouds)
            pace.add_answer(make_stamp(number), topic)
            assert len(pace.unanswered_clouds) <= before
            answers += 1

        for number in range(40):
            pace.wait_for_room(serve, lambda: False)
            assert len(pace.unanswered_clouds) < ahead
            pace.add_cloud(b"\0" * 4 + make_stamp(number))
            assert list(pace.unanswered_clouds)[-1] == make_stamp(number)
        assert answers and pace.missing_answers <= 40 * len(topics)


def test_answer_marks_earlier_clouds_as_missed():
    pace = make_pace(["/a"], 2)
    for number in range(3):
        pace.add_cloud(b"\0" * 4 + make_stamp(number))
    pace.add_answer(make_stamp(0), "/a")
    assert pace.missing_answers == 0 and list(pace.unanswered_clouds) == [make_stamp(1), make_stamp(2)]
    pace.add_answer(make_stamp(2), "/a")
    assert pace.missing_answers == 1 and not pace.unanswered_clouds


def test_player_waits_full_timeout_only_once(monkeypatch):
    now = 0.0
    monkeypatch.setattr(pacing, "monotonic", lambda: now)

    def serve():
        nonlocal now
        now += 0.25

    pace = make_pace(["/a"], 1, timeout=8.0)
    for number in range(5):
        pace.wait_for_room(serve, lambda: False)
        pace.add_cloud(b"\0" * 4 + make_stamp(number))
    assert pace.missing_answers == 4 and 8 + 3 < pace.held_s <= 8 + 3 + 4 * 0.25
    held = pace.held_s
    pace.wait_for_answers(serve, lambda: False)
    assert pace.missing_answers == 5 and not pace.unanswered_clouds and pace.held_s == held


@pytest.mark.parametrize("own", [{}, {"OMP_WAIT_POLICY": "active"}], ids=["ours", "the user's"])
def test_waiting_threads_sleep_by_default(own):
    """The command sets the variables before it loads torch, which reads them on import."""
    program = (
        "import atexit, os, sys; sys.argv[1:] = ['--version']; "
        "atexit.register(lambda: print([os.environ.get(k) for k in "
        f"{list(PASSIVE_WAITING)}], "
        "'torch' in sys.modules)); from lidar_perception.cli.main import main; main()"
    )
    environment = {k: v for k, v in os.environ.items() if k not in PASSIVE_WAITING} | own
    output = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True
    ).stdout.splitlines()[-1]
    expected = own or PASSIVE_WAITING
    assert output == f"{[expected.get(k) for k in PASSIVE_WAITING]} False"
