"""Pieces of a recording that are looked at: consecutive frames, of which the last are held out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lidar_perception.data.drives import GAP, drives_of
from lidar_perception.data.frame import Frame, Recording
from lidar_perception.geometry import elevations
from lidar_perception.labeling.interpolation import Motion
from lidar_perception.sensor_setup.scans import require_metres, require_space
from lidar_perception.tracking.ego import Odometry, recorded_source, usable
from lidar_perception.types import InputError
from lidar_perception.wire.messages import recorded_intensity_problem

PIECE = 60        # frames of a piece, where not all are looked at
HELD = 5          # one of so many frames is held out, at the end of each piece
FEWEST = 10       # frames
CHECKED = 5       # clouds, for what they are
WENT = 1.0        # metres that the sensor must go
TURNED = 20.0     # degrees from x ahead of it to where it goes, from which on that is said


class Refused(InputError):
    """Drives of which nothing can be learned, so that there is nothing to resume either."""


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


def checked(frames: Sequence[Frame], source: Path) -> list[str]:
    """What to say of the clouds of some frames, spread over all. InputError where they have no
    points, or such as of no sensor that can be adapted to."""
    chosen = np.unique(np.linspace(0, len(frames) - 1, CHECKED).astype(int))
    clouds = [frames[i].load() for i in chosen]
    xyz = np.concatenate([cloud.xyz for cloud in clouds]).astype(np.float64)
    if len(xyz) == 0:
        raise InputError(f"{source}: its clouds have no points; record while the sensor turns")
    require_metres(xyz, str(source))
    require_space(np.degrees(elevations(xyz)), str(source))
    lit = [cloud for cloud in clouds if cloud.intensity is not None and cloud.intensity.any()]
    if lit:
        return [*filter(None, [recorded_intensity_problem(source, lit[0])])]
    return [f"{source} has no intensity, which the networks were trained with, so that they may "
            "find little: turn it on in the driver"]


def pieces_of(frames: Sequence[Frame], most: int) -> list[Piece]:
    """All frames by drive; where there are more than `most`, pieces of PIECE, or of `most` if that
    is less, or shorter drives, spread over all, as many as hold `most` frames together. Refused
    where none has FEWEST."""
    drives = drives_of(frames)
    if max(len(run) for runs in drives.values() for run in runs) < FEWEST:
        raise Refused(f"no {FEWEST} frames follow each other within {GAP:g} s, so that nothing "
                      "can be followed; record every scan")
    whole, size = len(frames) <= most, max(FEWEST, min(PIECE, most))
    pieces: list[Piece] = []
    for name, runs in drives.items():
        parts = [run[i:i + size] for run in runs
                 for i in range(0, max(len(run) - size, 0) + 1, size)]
        cut = runs if whole else parts
        pieces += [Piece(f"{name or 'drive'} {k}" if len(cut) > 1 else name or "drive", tuple(part))
                   for k, part in enumerate(cut, 1)]
    if whole:
        return pieces
    longest = max(len(piece.numbers) for piece in pieces)
    return _spread([piece for piece in pieces if len(piece.numbers) >= max(FEWEST, longest // 2)],
                   most)


def _spread(pieces: Sequence[Piece], most: int) -> list[Piece]:
    """Some of the pieces, the middle ones of equal shares of all: as many as hold `most` frames
    together, at least one."""
    for count in range(len(pieces), 0, -1):
        middles = (np.arange(count) + 0.5) * len(pieces) / count
        chosen = [pieces[i] for i in middles.astype(int)]
        if sum(len(piece.numbers) for piece in chosen) <= most:
            break
    return chosen


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
    """Refused where the sensor goes nowhere in any piece; poses: by piece, (F, 4, 4)."""
    went = [np.linalg.norm(each[:, :2, 3] - each[0, :2, 3], axis=1).max() for each in poses]
    if max(went) < WENT:
        raise Refused(f"{source}: the sensor stands still ({max(went):.1f} m in all), and from one "
                      "place people that stand cannot be told from posts; record a drive of some "
                      "metres at least")


def turned_problem(poses: Sequence[np.ndarray], source: Path) -> str | None:
    """What to say where the sensor goes elsewhere than along its x axis, where detectors look
    ahead; None where it does not, or goes to and fro. poses: by piece, (F, 4, 4)."""
    steps = [np.einsum("fji,fj->fi", each[:-1, :3, :3], np.diff(each[:, :3, 3], axis=0))[:, :2]
             for each in poses]
    ways = np.concatenate(steps)
    went = ways.sum(axis=0)
    angle = float(np.degrees(np.arctan2(went[1], went[0])))
    if np.linalg.norm(went) < 0.5 * np.linalg.norm(ways, axis=1).sum() or abs(angle) < TURNED:
        return None
    return (f"{source}: the sensor drives towards {angle:.0f} deg of its x axis, where detectors "
            "look ahead; setup and convert --robot make a bag with x ahead")
