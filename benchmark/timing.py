"""Timing of several functions that are called alternately, so that other load affects all equally."""

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

    Each round makes each call once, in the order of the dict.

    Args:
        calls: Functions by name.
        repeat: Number of rounds.
        clock: Function that returns seconds. time.process_time measures CPU time.
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
    """Timer of several functions over frames.

    Args:
        repeat: Number of calls per frame.
        warm_up_calls: Calls that are made once at the start, without being timed.
        clock: See time_interleaved().
    """

    def __init__(self, repeat: int, warm_up_calls: Calls, clock: Callable[[], float] = perf_counter) -> None:
        self.repeat, self.clock = repeat, clock
        self.ms: dict[str, list[float]] = {}
        time_interleaved(warm_up_calls, 1)

    def time(self, calls: Calls) -> dict[str, Any]:
        """Time the calls for one frame, and return their results."""
        ms, results = time_interleaved(calls, self.repeat, self.clock)
        for name, value in ms.items():
            self.ms.setdefault(name, []).append(value)
        return results

    def compute_medians(self) -> dict[str, float]:
        """Return the medians over frames."""
        return {name: float(np.median(v)) for name, v in self.ms.items()}


def run_in_child(function: Callable, *arguments):
    """Run function(*arguments) in a new process, for libraries that would affect later measurements."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as child:
        return child.submit(function, *arguments).result()


def choose_evenly(items: Sequence, count: int) -> list:
    """Return `count` evenly spaced items, or all items if there are fewer."""
    if len(items) <= count:
        return list(items)
    return [items[i] for i in np.linspace(0, len(items) - 1, count).round().astype(int)]


def thin_cloud(xyz: np.ndarray) -> np.ndarray:
    """Return every 20th point. Small clouds are enough to warm up a function."""
    return np.ascontiguousarray(xyz[::20])
