"""Pieces of a recording that are looked at: consecutive frames, of which the last are held out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lidar_perception.data.frame import Frame, Recording
from lidar_perception.labeling.interpolation import Motion
from lidar_perception.tracking.ego import Odometry, recorded_source, usable
from lidar_perception.types import InputError

PIECE = 60        # frames of a piece, where not all are looked at
HELD = 5          # one of so many frames is held out, at the end of each piece
FEWEST = 10       # frames
WENT = 1.0        # metres that the sensor must go


@dataclass(frozen=True)
class Piece:
    """Consecutive frames of one drive, their numbers in the recording; name: of the drive."""

    name: str
    numbers: tuple[int, ...]

    @property
    def learned(self) -> range:
        """Positions of the frames that are learned from: the first ones."""
        return range(len(self.numbers) - len(self.numbers) // HELD)

    @property
    def held(self) -> range:
        """Positions of those that are not."""
        return range(len(self.learned), len(self.numbers))


def frames_of(recording: Recording) -> Sequence[Frame]:
    """The frames of a recording. InputError for less than FEWEST."""
    count = len(recording)
    if count < FEWEST:
        raise InputError(f"{recording.path} has {count} frame{'s' * (count != 1)}; adapting needs "
                         f"a drive of {FEWEST} at least, of which minutes are best")
    return recording.frames[:]  # of a bag, without the clouds that iterating would keep


def pieces_of(frames: Sequence[Frame], most: int) -> list[Piece]:
    """All frames by drive; where there are more than `most`, pieces of PIECE spread over all."""
    drives: dict[str, list[int]] = {}
    for number, frame in enumerate(frames):
        drives.setdefault(frame.sequence, []).append(number)
    pieces = [Piece(name, tuple(numbers)) for name, numbers in drives.items()]
    if len(frames) <= most:
        return pieces
    parts = [Piece(piece.name, piece.numbers[i:i + PIECE]) for piece in pieces
             for i in range(0, len(piece.numbers), PIECE)]
    parts = [part for part in parts if len(part.numbers) >= min(PIECE // 2, most)] or parts
    count = min(max(1, most // PIECE), len(parts))
    return [parts[i] for i in np.unique(np.linspace(0, len(parts) - 1, count).astype(int))]


def seconds_of(frames: Sequence[Frame], piece: Piece) -> np.ndarray:
    """(F,) float64 seconds since the first frame of a piece; 0.1 s a frame where the stamps do not
    rise."""
    return Motion.of(np.array([frames[n].stamp_ns for n in piece.numbers])).times


def poses_of(frames: Sequence[Frame], piece: Piece) -> Iterator[Any]:
    """(4, 4) of each frame of a piece in a frame that stands, from its recorded_source. InputError
    where there is none."""
    own = [frames[number].pose() for number in piece.numbers]
    if recorded_source(all(map(usable, own))) == "recording":
        yield from own
        return
    odometry = Odometry()
    for number in piece.numbers:
        yield odometry(frames[number].load().xyz)


def require_motion(poses: Sequence[np.ndarray], source: Path) -> None:
    """InputError where the sensor goes nowhere in any piece; poses: by piece, (F, 4, 4)."""
    went = [np.linalg.norm(each[:, :2, 3] - each[0, :2, 3], axis=1).max() for each in poses]
    if max(went) < WENT:
        raise InputError(f"{source}: the sensor stands still ({max(went):.1f} m in all), and from "
                         "one place people that stand cannot be told from posts; record a drive of "
                         "some metres at least")
