"""Inference of the intensity scale of a recording, which is the same for all its frames."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from functools import cache, partial
from typing import TypeVar

import numpy as np

from lidar_perception.intensity import StreamScale
from lidar_perception.types import InputError

SAMPLE_SIZE = 10  # number of clouds from which the scale of a recording is inferred
MAX_READ = 100  # maximum number of clouds of a bag to read to find SAMPLE_SIZE usable ones

Item = TypeVar("Item")
Column = tuple[np.ndarray, np.dtype] | None  # see wire.messages.read_raw_intensity


def make_scale_reader(items: Sequence[Item], read: Callable[[Item], Column]) -> Callable[[], float]:
    """Return a cached function that infers the intensity scale of a recording.

    It reads SAMPLE_SIZE clouds that are spread evenly over the recording.

    Args:
        items: files, or other arguments of `read`.
        read: read(item) returns the recorded intensities and their dtype, or None. Items for which
            it raises InputError are ignored.
    """
    count = min(SAMPLE_SIZE, len(items))
    indices = np.linspace(0, max(len(items) - 1, 0), count).astype(int).tolist()
    return cache(partial(infer_scale, [items[i] for i in indices], read))


def infer_scale(items: Iterable[Item], read: Callable[[Item], Column]) -> float:
    """Infer the scale from the first SAMPLE_SIZE clouds; return 1 if there are none.

    For the arguments see make_scale_reader. Empty clouds and clouds of zeros, which drivers publish
    at startup, are ignored.
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
    return scale.full_scale or 1.0
