"""Which frames of a recording are learned from, and which are held out."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from lidar_perception.data.drives import drives_of
from lidar_perception.data.frame import BOXES, Frame, Recording
from lidar_perception.data.mount_check import apply_measured_height, load_first_clouds
from lidar_perception.data.open import open_recording
from lidar_perception.training.scenes import RecordedScenes
from lidar_perception.types import InputError

T = TypeVar("T")
TOO_FEW = "one frame cannot be split into frames to train and to validate on; give --val"


@dataclass(frozen=True)
class LabelledFrames:
    """Frames of the recording at path. drives: whether they follow each other in time; height: of
    the sensor above the ground, metres, where it is not what the recording says."""

    path: Path
    frames: tuple[Frame, ...]
    drives: bool = True
    height: float | None = None

    def scenes(self, view: bool = True) -> RecordedScenes:
        """As a source of scenes."""
        return RecordedScenes(self.path, tuple(frame.name for frame in self.frames), view,
                              self.height)

    def without(self, others: Iterable[LabelledFrames], what: str) -> LabelledFrames:
        """The frames that others do not have, under whatever path. InputError, saying for what, if
        there is none."""
        known = {mark for other in others for frame in other.frames for mark in _marks(frame)}
        left = tuple(frame for frame in self.frames if known.isdisjoint(_marks(frame)))
        if not left:
            raise InputError(f"{self.path}: no frame is left to {what}, as no frame may be trained "
                             "on and validated on; give other frames, or leave --val out to hold "
                             "some out")
        return replace(self, frames=left)

    def held_out(self, share: float, seed: int) -> tuple[LabelledFrames, LabelledFrames]:
        """The frames to train on, and a share of those with labels to validate on: of drives
        drive_split, else random_split. InputError if there are not two."""
        if self.drives:
            known = [frame for frame in self.frames if _has_labels(frame)] or self.frames
            runs = [[known[i] for i in run] for several in drives_of(known).values()
                    for run in several]
            names = {frame.name for frame in drive_split(runs, share, seed)}
        else:
            names = {frame.name for frame in random_split(self.frames, share, seed)}
        if not 0 < len(names) < len(self.frames):
            raise InputError(TOO_FEW)
        parts = [tuple(frame for frame in self.frames if (frame.name in names) == held)
                 for held in (False, True)]
        return replace(self, frames=parts[0]), replace(self, frames=parts[1])


def labelled_frames(path: Path, split: Path | None = None, height: float = 0.0,
             mixed: bool = False) -> LabelledFrames:
    """The frames of a recording, or of those that a split file names. InputError names what is not
    there, and a recording without labelled boxes.

    height: of the sensor, metres, also against what the recording says, unless it is mixed with
    simulated scans, whose height it is then. 0: what the recording says, or else its first clouds.
    """
    recording = open_recording(path, split=split)
    recording.require(BOXES, "train")
    return LabelledFrames(path, tuple(recording.frames[:]), recording.drives,
                          _height(recording, height, mixed))


def _height(recording: Recording, height: float, mixed: bool) -> float | None:
    if height and not (mixed and recording.mounted):
        return height
    measured = apply_measured_height(recording, load_first_clouds(recording))
    return None if measured is recording else next(iter(measured)).sensor_height


def _has_labels(frame: Frame) -> bool:
    """Also if they are broken, which is said when they are read."""
    try:
        return frame.truth() is not None
    except InputError:
        return True


def _marks(frame: Frame) -> set[tuple[Path, str]]:
    """What no other frame has, by whatever path the recording was opened: its file, or its name in
    each file of a bag."""
    if frame.points is not None:
        return {(frame.points.resolve(), "")}
    return {(file.resolve(), frame.name) for file in frame.files}


def random_split(items: Sequence[T], share: float, seed: int) -> list[T]:
    """A share of the items, drawn by the seed, in the order given: one at least, and not all.
    InputError if there are not two."""
    chosen = np.random.default_rng(seed).choice(len(items), _held(len(items), share), replace=False)
    return [items[i] for i in np.sort(chosen)]


def drive_split(drives: Sequence[Sequence[T]], share: float, seed: int) -> list[T]:
    """A share of all items, one at least, and not all: whole drives, drawn by the seed, as long as
    they fit into it, and then the end of one more, since neighbours in time are much alike.
    InputError if there are not two items."""
    left = _held(sum(map(len, drives)), share)
    order = np.random.default_rng(seed).permutation(len(drives))
    whole: list[T] = []
    longer: list[Sequence[T]] = []
    for drive in (drives[i] for i in order):
        if len(drive) <= left:
            whole.extend(drive)
            left -= len(drive)
        else:
            longer.append(drive)
    return [*whole, *(longer[0][-left:] if left else ())]


def _held(count: int, share: float) -> int:
    if count < 2:
        raise InputError(TOO_FEW)
    return min(max(round(share * count), 1), count - 1)
