"""Division of a recording into drives."""

from __future__ import annotations

from collections.abc import Sequence

from lidar_perception.data.frame import Frame

MAX_GAP_S = 2.0  # between two frames of a drive


def is_same_drive(previous_ns: int, stamp_ns: int) -> bool:
    """Return True if a frame continues the drive of the previous one, by their stamps."""
    return 0 <= stamp_ns - previous_ns <= MAX_GAP_S * 1e9


def split_drives(frames: Sequence[Frame]) -> dict[str, list[list[int]]]:
    """Return the frame numbers of each drive, by the name of their sequence.

    A drive ends where the stamps have a gap of more than MAX_GAP_S, or go back.
    """
    drives: dict[str, list[list[int]]] = {}
    for number, frame in enumerate(frames):
        runs = drives.setdefault(frame.sequence, [])
        if not runs or not is_same_drive(frames[runs[-1][-1]].stamp_ns, frame.stamp_ns):
            runs.append([])
        runs[-1].append(number)
    return drives
