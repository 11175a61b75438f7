"""Labelled frames of recordings, and their split into training and validation frames."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from lidar_perception.data.frame import BOXES, Frame, Recording, split_drives
from lidar_perception.data.mount_check import apply_measured_height, load_first_clouds
from lidar_perception.data.open import open_recording
from lidar_perception.training.scenes import RecordedScenes
from lidar_perception.types import InputError

T = TypeVar("T")
TOO_FEW = "one frame cannot be split into frames to train and to validate on; give --val"


@dataclass(frozen=True)
class LabelledFrames:
    """Frames of a recording.

    Attributes:
        path: The recording.
        frames: The frames.
        drives: The frames follow each other in time.
        height: Height of the sensor above the ground in metres; None: as the recording says.
    """

    path: Path
    frames: tuple[Frame, ...]
    drives: bool = True
    height: float | None = None

    def to_scenes(self, view: bool = True) -> RecordedScenes:
        """Return the frames as a source of scenes. view: see RecordedScenes."""
        return RecordedScenes(self.path, tuple(frame.name for frame in self.frames), view, self.height)

    def exclude(self, others: Iterable[LabelledFrames], purpose: str) -> LabelledFrames:
        """Return the frames that others do not contain, under any path.

        Raises:
            InputError: No frame is left for the purpose.
        """
        excluded = {key for other in others for frame in other.frames for key in _frame_keys(frame)}
        left = tuple(frame for frame in self.frames if excluded.isdisjoint(_frame_keys(frame)))
        if not left:
            raise InputError(
                f"{self.path}: no frame is left to {purpose}, as no frame may be "
                "trained on and validated on; give other frames, or leave --val out "
                "to hold some out"
            )
        return replace(self, frames=left)

    def split(self, share: float, seed: int) -> tuple[LabelledFrames, LabelledFrames]:
        """Split into frames to train on, and a share of those with labels to validate on.

        Frames of drives are split by draw_drives, others by draw_items.

        Raises:
            InputError: There are fewer than two frames.
        """
        if self.drives:
            labelled = [frame for frame in self.frames if may_have_labels(frame)] or self.frames
            runs = [[labelled[i] for i in run] for several in split_drives(labelled).values() for run in several]
            names = {frame.name for frame in draw_drives(runs, share, seed)}
        else:
            names = {frame.name for frame in draw_items(self.frames, share, seed)}
        if not 0 < len(names) < len(self.frames):
            raise InputError(TOO_FEW)
        parts = [
            tuple(frame for frame in self.frames if (frame.name in names) == held_out) for held_out in (False, True)
        ]
        return replace(self, frames=parts[0]), replace(self, frames=parts[1])


def open_labelled_frames(
    path: Path, split: Path | None = None, height: float = 0.0, mixed: bool = False
) -> LabelledFrames:
    """Return the frames of a recording.

    Args:
        path: The recording.
        split: File that names the frames to use; None for all.
        height: Height of the sensor in metres, which overrides the recording unless mixed. 0: as
            the recording says, or else as its first clouds show.
        mixed: Simulated scans are used too, and height is the height of their sensor.

    Raises:
        InputError: Something is missing, or the recording has no labelled boxes.
    """
    recording = open_recording(path, split=split)
    recording.require(BOXES, "train")
    return LabelledFrames(
        path, tuple(recording.frames[:]), recording.is_sequential, _find_height(recording, height, mixed)
    )


def _find_height(recording: Recording, height: float, mixed: bool) -> float | None:
    if height and not (mixed and recording.has_sensor_height):
        return height
    measured = apply_measured_height(recording, load_first_clouds(recording))
    return None if measured is recording else next(iter(measured)).sensor_height


def may_have_labels(frame: Frame) -> bool:
    """Return True if a frame has labels, or broken ones, which are reported when they are read."""
    try:
        return frame.truth() is not None
    except InputError:
        return True


def _frame_keys(frame: Frame) -> set[tuple[Path, str]]:
    """Return keys of a frame that do not depend on the path of its recording.

    They are its file, or its name in each file of a bag.
    """
    if frame.points is not None:
        return {(frame.points.resolve(), "")}
    return {(file.resolve(), frame.name) for file in frame.files}


def draw_items(items: Sequence[T], share: float, seed: int) -> list[T]:
    """Draw a share of the items, at least one and not all, in their order.

    Raises:
        InputError: There are fewer than two items.
    """
    chosen = np.random.default_rng(seed).choice(len(items), _count_held_out(len(items), share), replace=False)
    return [items[i] for i in np.sort(chosen)]


def draw_drives(drives: Sequence[Sequence[T]], share: float, seed: int) -> list[T]:
    """Draw a share of all items, at least one and not all, as whole drives.

    The end of one more drive fills the share up. Neighbours in time are too similar to be split at
    random.

    Raises:
        InputError: There are fewer than two items.
    """
    left = _count_held_out(sum(map(len, drives)), share)
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


def _count_held_out(count: int, share: float) -> int:
    if count < 2:
        raise InputError(TOO_FEW)
    return min(max(round(share * count), 1), count - 1)
