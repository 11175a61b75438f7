"""Intensity scale of a recording: the same for all its frames, in whatever order they are read."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from functools import cache, partial
from typing import TypeVar

import numpy as np

from lidar_perception.intensity import StreamScale
from lidar_perception.types import InputError

SAMPLE_SIZE = 10  # clouds from which the scale of a recording is inferred
MAX_READ = 100  # clouds of a bag that are read to find them

Item = TypeVar("Item")
Column = tuple[np.ndarray, np.dtype] | None  # see wire.messages.read_raw_intensity


def make_scale_reader(items: Sequence[Item], read: Callable[[Item], Column]
                      ) -> Callable[[], float]:
    """Return a function that infers the full_scale() of a recording when it is first called.

    It reads SAMPLE_SIZE clouds, spread evenly. Clouds that raise InputError are ignored.

    Args:
        items: files, or other arguments of `read`.
        read: read(item) returns the intensities as recorded and their dtype, or None.
    """
    count = min(SAMPLE_SIZE, len(items))
    chosen = np.linspace(0, max(len(items) - 1, 0), count).astype(int).tolist()
    return cache(partial(infer_scale, [items[i] for i in chosen], read))


def infer_scale(items: Iterable[Item], read: Callable[[Item], Column]) -> float:
    """Return the scale of the first SAMPLE_SIZE clouds; 1 without any. Arguments as in
    make_scale_reader.

    Clouds that are empty or all 0, as drivers publish at their start, are not counted.
    """
    scale, count = StreamScale(), 0
    for item in items:
        with suppress(InputError):
            column = read(item)
            if column is not None:
                scale(*column)
            count += column is None or bool((column[0] > 0).any())
        if count == SAMPLE_SIZE:
            break
    return scale.full or 1.0
