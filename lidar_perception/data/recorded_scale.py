"""The intensity scale of a recording: one for all its frames, whichever of them is read first."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from functools import cache, partial
from typing import TypeVar

import numpy as np

from lidar_perception.intensity import StreamScale
from lidar_perception.types import InputError

SAMPLE = 10  # clouds on which the scale of a recording is decided
MAX_READ = 100  # clouds of a bag that are read for them

Item = TypeVar("Item")
Column = tuple[np.ndarray, np.dtype] | None  # see wire.messages.raw_intensity


def recorded_scale(items: Sequence[Item], read: Callable[[Item], Column]
                   ) -> Callable[[], float]:
    """Return a function that gives the full_scale() of a recording, read from SAMPLE of its clouds,
    spread over all, when it is called first.

    items: files, or other arguments of read; read(item): the intensities as they are written, and
    their type, or None. Clouds that raise InputError do not count.
    """
    chosen = np.linspace(0, max(len(items) - 1, 0), min(SAMPLE, len(items))).astype(int).tolist()
    return cache(partial(scale_of, [items[i] for i in chosen], read))


def scale_of(items: Iterable[Item], read: Callable[[Item], Column]) -> float:
    """Return the scale of the first SAMPLE clouds, not counting those that are empty or all 0, as
    drivers publish at their start; 1 without any. Arguments as of recorded_scale."""
    scale, count = StreamScale(), 0
    for item in items:
        with suppress(InputError):
            column = read(item)
            if column is not None:
                scale(*column)
            count += column is None or bool((column[0] > 0).any())
        if count == SAMPLE:
            break
    return scale.full or 1.0
