"""PointPillars v4 compact on a machine that is busy with other programs.

Compares threads of torch that sleep early, as in our nodes and commands (runs/threads.py), with
torch's default.
"""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from time import perf_counter

import numpy as np

from benchmark.rows import make_measurement, make_row
from lidar_perception.detectors.open import open_detector
from lidar_perception.runs.memory import keep_freed_memory
from lidar_perception.runs.terminal import show_progress
from lidar_perception.runs.threads import PASSIVE_WAITING, set_thread_count
from lidar_perception.types import PointCloud

BUSY = 2  # other processes
WAYS = {"ours": PASSIVE_WAITING, "torch's": {}}


def measure_busy(scans: list[PointCloud], repeat: int) -> dict:
    """Measure ms per frame, without and with BUSY busy processes, in turn."""
    title = f"PointPillars v4 compact with {BUSY} busy processes"
    ms: dict[tuple[str, int], list[float]] = {(way, n): [] for way in WAYS for n in (0, BUSY)}
    with ExitStack() as stack:
        workers = {way: stack.enter_context(_start_worker(environment, scans))
                   for way, environment in WAYS.items()}
        for _ in show_progress(range(repeat), title, repeat):
            for busy in (0, BUSY):
                with run_busy_processes(busy):
                    for way, worker in workers.items():
                        ms[way, busy] += worker.submit(_measure_times).result()
    median = {key: float(np.median(values)) for key, values in ms.items()}
    rows = [
        make_row(
            f"torch's own threads, {busy} busy processes",
            peer_ms=median["torch's", busy],
            ours_ms=median["ours", busy],
            value=median["torch's", busy] / median["ours", busy],
        )
        for busy in (0, BUSY)
    ]
    rows.append(make_row(f"(ours, {BUSY} busy processes to none)", unit="",
                         value=median["ours", BUSY] / median["ours", 0]))
    return make_measurement(title, len(scans), np.median([len(scan) for scan in scans]), rows)


@contextmanager
def _start_worker(
    environment: dict[str, str], scans: list[PointCloud]
) -> Iterator[ProcessPoolExecutor]:
    """Start a process that has loaded torch in this environment."""
    before = {name: os.environ.pop(name, None) for name in PASSIVE_WAITING}
    os.environ.update(environment)
    try:
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn"),
                                 initializer=_prepare, initargs=(scans,)) as worker:
            worker.submit(_measure_times).result()
            yield worker
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value


_ready: dict = {}  # in a worker


def _prepare(scans: list[PointCloud]) -> None:
    keep_freed_memory()
    set_thread_count(len(os.sched_getaffinity(0)))  # as the nodes do
    _ready.update(detector=open_detector("pointpillars"), scans=scans)


def _measure_times() -> list[float]:
    """Return the ms of each scan."""
    found = []
    for scan in _ready["scans"]:
        begin = perf_counter()
        _ready["detector"](scan)
        found.append(1e3 * (perf_counter() - begin))
    return found


@contextmanager
def run_busy_processes(count: int) -> Iterator[None]:
    """Run the given number of busy processes meanwhile."""
    others = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for process in others:
            process.kill()
            process.wait()
