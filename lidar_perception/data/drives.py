"""Where a drive begins and ends in a recording."""

from __future__ import annotations

from collections.abc import Sequence

from lidar_perception.data.frame import Frame

GAP = 2.0  # seconds without a frame, after which another drive begins


def goes_on(before_ns: int, stamp_ns: int) -> bool:
    """Whether a frame is of the drive of the one before it, by their stamps."""
    return 0 <= stamp_ns - before_ns <= GAP * 1e9


def drives_of(frames: Sequence[Frame]) -> dict[str, list[list[int]]]:
    """By the name of their sequence: the numbers of frames that follow each other, drive by drive.
    One ends where the stamps leave a GAP, or go back."""
    drives: dict[str, list[list[int]]] = {}
    for number, frame in enumerate(frames):
        runs = drives.setdefault(frame.sequence, [])
        if not runs or not goes_on(frames[runs[-1][-1]].stamp_ns, frame.stamp_ns):
            runs.append([])
        runs[-1].append(number)
    return drives
