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
TOO_FEW_FRAMES = "one frame cannot be split into training and validation frames; give --val"


@dataclass(frozen=True)
class LabelledFrames:
    """Frames of a recording.

    Attributes:
        path: Path of the recording.
        frames: The frames.
        drives: The frames are consecutive in time.
        height: Height of the sensor above the ground in metres; None uses that of the recording.
    """

    path: Path
    frames: tuple[Frame, ...]
    drives: bool = True
    height: float | None = None

    def to_scenes(self, view: bool = True) -> RecordedScenes:
        """Convert the frames to a source of scenes. view: see RecordedScenes."""
        return RecordedScenes(self.path, tuple(frame.name for frame in self.frames), view, self.height)

    def exclude(self, others: Iterable[LabelledFrames], purpose: str) -> LabelledFrames:
        """Remove the frames that others contain, under any path.

        Args:
            others: Frames to remove.
            purpose: "train on" or "validate on", for the error message.

        Raises:
            InputError: No frame remains.
        """
        excluded = {key for other in others for frame in other.frames for key in _frame_keys(frame)}
        remaining = tuple(frame for frame in self.frames if excluded.isdisjoint(_frame_keys(frame)))
        if not remaining:
            raise InputError(
                f"{self.path}: no frame is left to {purpose}, since training and validation must not share "
                "frames; give other frames, or omit --val to hold out a part of the data"
            )
        return replace(self, frames=remaining)

    def split(self, share: float, seed: int) -> tuple[LabelledFrames, LabelledFrames]:
        """Split off a share of the labelled frames for validation.

        Frames of drives are drawn by draw_drives, others by draw_items.

        Returns:
            Training and validation frames.

        Raises:
            InputError: There are fewer than two frames.
        """
        if self.drives:
            labelled = [frame for frame in self.frames if may_have_labels(frame)] or self.frames
            runs = [[labelled[i] for i in run] for drives in split_drives(labelled).values() for run in drives]
            names = {frame.name for frame in draw_drives(runs, share, seed)}
        else:
            names = {frame.name for frame in draw_items(self.frames, share, seed)}
        if not 0 < len(names) < len(self.frames):
            raise InputError(TOO_FEW_FRAMES)
        parts = [
            tuple(frame for frame in self.frames if (frame.name in names) == held_out) for held_out in (False, True)
        ]
        return replace(self, frames=parts[0]), replace(self, frames=parts[1])


def open_labelled_frames(
    path: Path, split: Path | None = None, height: float = 0.0, mixed: bool = False
) -> LabelledFrames:
    """Open the frames of a recording.

    Args:
        path: Path of the recording.
        split: File that names the frames to use; None for all.
        height: Height of the sensor in metres. 0 uses that of the recording, or measures it on the
            first clouds. If mixed, the height of the recording has priority.
        mixed: Simulated scans are used too, and height is the height of their sensor.

    Raises:
        InputError: A file is missing, or the recording has no labelled boxes.
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
    """Return True if a frame has labels, or labels that cannot be read (reported later)."""
    try:
        return frame.truth() is not None
    except InputError:
        return True


def _frame_keys(frame: Frame) -> set[tuple[Path, str]]:
    """Return keys of a frame that are the same for any path of its recording: (file, name in a bag)."""
    if frame.points is not None:
        return {(frame.points.resolve(), "")}
    return {(file.resolve(), frame.name) for file in frame.files}


def draw_items(items: Sequence[T], share: float, seed: int) -> list[T]:
    """Draw a random share of the items, at least one and not all, in their order.

    Raises:
        InputError: There are fewer than two items.
    """
    chosen = np.random.default_rng(seed).choice(len(items), _count_held_out(len(items), share), replace=False)
    return [items[i] for i in np.sort(chosen)]


def draw_drives(drives: Sequence[Sequence[T]], share: float, seed: int) -> list[T]:
    """Draw a share of all items, at least one and not all, as complete drives and the end of one more.

    Consecutive frames are too similar to be separated at random.

    Raises:
        InputError: There are fewer than two items.
    """
    missing = _count_held_out(sum(map(len, drives)), share)
    order = np.random.default_rng(seed).permutation(len(drives))
    complete: list[T] = []
    longer: list[Sequence[T]] = []
    for drive in (drives[i] for i in order):
        if len(drive) <= missing:
            complete.extend(drive)
            missing -= len(drive)
        else:
            longer.append(drive)
    return [*complete, *(longer[0][-missing:] if missing else ())]


def _count_held_out(count: int, share: float) -> int:
    if count < 2:
        raise InputError(TOO_FEW_FRAMES)
    return min(max(round(share * count), 1), count - 1)
