"""PointPillars v4 compact while other programs want the cores too: torch's threads soon asleep
while they wait for work, as our nodes and commands have it (runs/threads.py), beside torch's own
way."""

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

from benchmark.rows import measured, row
from lidar_perception.detectors.open import open_detector
from lidar_perception.runs.memory import keep_freed_memory
from lidar_perception.runs.terminal import show_progress
from lidar_perception.runs.threads import PASSIVE_WAITING, set_thread_count
from lidar_perception.types import PointCloud

BUSY = 2  # other processes
WAYS = {"ours": PASSIVE_WAITING, "torch's": {}}


def measure_busy(scans: list[PointCloud], repeat: int) -> dict:
    """ms a frame, without and beside BUSY busy processes, taken in turn."""
    title = f"PointPillars v4 compact beside {BUSY} busy processes"
    ms: dict[tuple[str, int], list[float]] = {(way, n): [] for way in WAYS for n in (0, BUSY)}
    with ExitStack() as stack:
        workers = {way: stack.enter_context(_worker(environment, scans))
                   for way, environment in WAYS.items()}
        for _ in show_progress(range(repeat), title, repeat):
            for busy in (0, BUSY):
                with _beside(busy):
                    for way, worker in workers.items():
                        ms[way, busy] += worker.submit(_times).result()
    median = {key: float(np.median(values)) for key, values in ms.items()}
    rows = [row(f"torch's own threads, {busy} busy processes", peer_ms=median["torch's", busy],
                ours_ms=median["ours", busy], value=median["torch's", busy] / median["ours", busy])
            for busy in (0, BUSY)]
    rows.append(row(f"(ours, {BUSY} busy processes to none)", unit="",
                    value=median["ours", BUSY] / median["ours", 0]))
    return measured(title, len(scans), np.median([len(scan) for scan in scans]), rows)


@contextmanager
def _worker(environment: dict[str, str], scans: list[PointCloud]) -> Iterator[ProcessPoolExecutor]:
    """A process that has loaded torch in this environment."""
    before = {name: os.environ.pop(name, None) for name in PASSIVE_WAITING}
    os.environ.update(environment)
    try:
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn"),
                                 initializer=_prepare, initargs=(scans,)) as worker:
            worker.submit(_times).result()
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


def _times() -> list[float]:
    """ms of each scan."""
    found = []
    for scan in _ready["scans"]:
        begin = perf_counter()
        _ready["detector"](scan)
        found.append(1e3 * (perf_counter() - begin))
    return found


@contextmanager
def _beside(count: int) -> Iterator[None]:
    """While so many processes count without end."""
    others = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for process in others:
            process.kill()
            process.wait()
