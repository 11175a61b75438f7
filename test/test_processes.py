"""Processes that work for another one end with it, and give back what they hold."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

HELD = []
ROOT = Path(__file__).resolve().parents[1]


def holding() -> Callable[[int], bytes]:
    """Work that holds many semaphores of the system and makes more than a pipe takes."""
    HELD.extend(multiprocessing.get_context("forkserver").Semaphore() for _ in range(40))
    return lambda item: bytes(300_000)


def test_processes_that_are_ended_give_back_what_they_hold():
    script = ("import itertools\n"
              "from lidar_perception.runs.processes import in_order\n"
              "from test_processes import holding\n"
              "for _ in range(8):\n"
              "    made = in_order(holding, itertools.count(), 2, 4, 'worked')\n"
              "    assert [len(next(made)) for _ in range(3)] == [300_000] * 3\n"
              "    made.close()\n")
    path = os.pathsep.join(map(str, (ROOT, ROOT / "test")))
    run = subprocess.run([sys.executable, "-c", script], text=True, capture_output=True,
                         env={**os.environ, "PYTHONPATH": path}, check=False)
    assert (run.returncode, run.stderr) == (0, "")
