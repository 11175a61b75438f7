"""Times of several functions called in turn, so that other load affects all equally."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from time import perf_counter
from typing import Any

import numpy as np

Calls = dict[str, Callable[[], Any]]
SLOW_REPEAT = 2  # maximum runs per frame of a slow peer


def time_interleaved(
    calls: Calls, repeat: int, clock: Callable[[], float] = perf_counter
) -> tuple[dict[str, float], dict[str, Any]]:
    """Return the median ms of each call over `repeat` rounds, and its last result.

    A round makes each call once, in the order of the dict. clock returns seconds; time.process_time
    measures CPU time.
    """
    ms: dict[str, list[float]] = {name: [] for name in calls}
    results: dict[str, Any] = {}
    for _ in range(repeat):
        for name, call in calls.items():
            start = clock()
            results[name] = call()
            ms[name].append(1e3 * (clock() - start))
    return {name: float(np.median(v)) for name, v in ms.items()}, results


class Clock:
    """Timer of several functions over frames. The calls in `warm` run once before, without being timed."""

    def __init__(self, repeat: int, warm: Calls, clock: Callable[[], float] = perf_counter) -> None:
        self.repeat, self.clock = repeat, clock
        self.ms: dict[str, list[float]] = {}
        time_interleaved(warm, 1)

    def time(self, calls: Calls) -> dict[str, Any]:
        """Time one frame, and return the result of each call."""
        ms, results = time_interleaved(calls, self.repeat, self.clock)
        for name, value in ms.items():
            self.ms.setdefault(name, []).append(value)
        return results

    def compute_medians(self) -> dict[str, float]:
        """Return the medians over frames."""
        return {name: float(np.median(v)) for name, v in self.ms.items()}


def run_in_child(function: Callable, *arguments):
    """Run function(*arguments) in a fresh process, for libraries that disturb later times."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as child:
        return child.submit(function, *arguments).result()


def choose_evenly(items: Sequence, count: int) -> list:
    """Return count evenly spread items, or all if there are fewer."""
    if len(items) <= count:
        return list(items)
    return [items[i] for i in np.linspace(0, len(items) - 1, count).round().astype(int)]


def thin_cloud(xyz: np.ndarray) -> np.ndarray:
    """Return every 20th point, to warm up with."""
    return np.ascontiguousarray(xyz[::20])
