"""Times of several functions taken in turn, so that a busy moment of the machine hits all alike."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from time import perf_counter
from typing import Any

import numpy as np

Calls = dict[str, Callable[[], Any]]
SLOW_REPEAT = 2  # runs a frame at most beside a peer that takes seconds


def interleaved(calls: Calls, repeat: int, clock: Callable[[], float] = perf_counter
                ) -> tuple[dict[str, float], dict[str, Any]]:
    """Median ms of each call over `repeat` rounds, and what it gave in the last one. A round calls
    each once, in the order of the dict. clock: of seconds; time.process_time counts CPU time."""
    ms: dict[str, list[float]] = {name: [] for name in calls}
    results: dict[str, Any] = {}
    for _ in range(repeat):
        for name, call in calls.items():
            start = clock()
            results[name] = call()
            ms[name].append(1e3 * (clock() - start))
    return {name: float(np.median(v)) for name, v in ms.items()}, results


class Clock:
    """Gathers times over frames. The calls of warm are made once before, untimed; a thin cloud is
    enough for them."""

    def __init__(self, repeat: int, warm: Calls,
                 clock: Callable[[], float] = perf_counter) -> None:
        self.repeat, self.clock = repeat, clock
        self.ms: dict[str, list[float]] = {}
        interleaved(warm, 1)

    def time(self, calls: Calls) -> dict[str, Any]:
        """Times one frame; gives what each call gave."""
        ms, results = interleaved(calls, self.repeat, self.clock)
        for name, value in ms.items():
            self.ms.setdefault(name, []).append(value)
        return results

    def medians(self) -> dict[str, float]:
        """Median over the frames."""
        return {name: float(np.median(v)) for name, v in self.ms.items()}


def in_child(function: Callable, *arguments):
    """function(*arguments) in a fresh process, for libraries that disturb the times after them."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as child:
        return child.submit(function, *arguments).result()


def evenly_chosen(items: Sequence, count: int) -> list:
    """count of the items, evenly spread from the first to the last; all where there are fewer."""
    if len(items) <= count:
        return list(items)
    return [items[i] for i in np.linspace(0, len(items) - 1, count).round().astype(int)]


def thin(xyz: np.ndarray) -> np.ndarray:
    """Every 20th point, to warm up with."""
    return np.ascontiguousarray(xyz[::20])
