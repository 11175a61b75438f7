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
        is_sequential: True if the frames are consecutive in time.
        height: Height of the sensor above the ground in metres; None uses that of the recording.
    """

    path: Path
    frames: tuple[Frame, ...]
    is_sequential: bool = True
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
        excluded_keys = {key for frames in others for frame in frames.frames for key in _list_keys(frame)}
        remaining_frames = tuple(frame for frame in self.frames if excluded_keys.isdisjoint(_list_keys(frame)))
        if not remaining_frames:
            raise InputError(
                f"{self.path}: no frame is left to {purpose}, since training and validation must not share "
                "frames; give other frames, or omit --val to hold out a part of the data"
            )
        return replace(self, frames=remaining_frames)

    def split(self, fraction: float, seed: int) -> tuple[LabelledFrames, LabelledFrames]:
        """Split off a fraction of the labelled frames for validation.

        Frames of drives are drawn by draw_drives, others by draw_items.

        Returns:
            Training and validation frames.

        Raises:
            InputError: There are fewer than two frames.
        """
        if self.is_sequential:
            frames = [frame for frame in self.frames if may_have_labels(frame)] or self.frames
            drives = [[frames[i] for i in indices] for drive in split_drives(frames).values() for indices in drive]
            names = {frame.name for frame in draw_drives(drives, fraction, seed)}
        else:
            names = {frame.name for frame in draw_items(self.frames, fraction, seed)}
        if not 0 < len(names) < len(self.frames):
            raise InputError(TOO_FEW_FRAMES)
        training = tuple(frame for frame in self.frames if frame.name not in names)
        validation = tuple(frame for frame in self.frames if frame.name in names)
        return replace(self, frames=training), replace(self, frames=validation)


def open_labelled_frames(
    path: Path, split: Path | None = None, height: float = 0.0, with_simulated: bool = False
) -> LabelledFrames:
    """Open the frames of a recording.

    Args:
        path: Path of the recording.
        split: File that names the frames to use; None for all.
        height: Height of the sensor in metres. 0 uses that of the recording, or measures it on the
            first clouds.
        with_simulated: True if the run also uses simulated scans. Then `height` is that of the
            simulated sensor, and a height given by the recording has priority.

    Raises:
        InputError: A file is missing, or the recording has no labelled boxes.
    """
    recording = open_recording(path, split=split)
    recording.require(BOXES, "train")
    return LabelledFrames(
        path, tuple(recording.frames[:]), recording.is_sequential, _find_height(recording, height, with_simulated)
    )


def _find_height(recording: Recording, height: float, with_simulated: bool) -> float | None:
    if height and not (with_simulated and recording.has_sensor_height):
        return height
    recording_with_height = apply_measured_height(recording, load_first_clouds(recording))
    return None if recording_with_height is recording else next(iter(recording_with_height)).sensor_height


def may_have_labels(frame: Frame) -> bool:
    """Return True if a frame has labels, even if they cannot be read; such errors are reported later."""
    try:
        return frame.truth() is not None
    except InputError:
        return True


def _list_keys(frame: Frame) -> set[tuple[Path, str]]:
    """Return keys (file, name in a bag) that identify a frame for any path to its recording."""
    if frame.points is not None:
        return {(frame.points.resolve(), "")}
    return {(file.resolve(), frame.name) for file in frame.files}


def draw_items(items: Sequence[T], fraction: float, seed: int) -> list[T]:
    """Draw a random fraction of the items, at least one but not all, in their original order.

    Raises:
        InputError: There are fewer than two items.
    """
    indices = np.random.default_rng(seed).choice(len(items), _count_held_out(len(items), fraction), replace=False)
    return [items[i] for i in np.sort(indices)]


def draw_drives(drives: Sequence[Sequence[T]], fraction: float, seed: int) -> list[T]:
    """Draw a fraction of all items, at least one but not all: some complete drives and the end of one more.

    Frames are not drawn one by one, because consecutive frames are too similar.

    Raises:
        InputError: There are fewer than two items.
    """
    missing_count = _count_held_out(sum(map(len, drives)), fraction)
    order = np.random.default_rng(seed).permutation(len(drives))
    items: list[T] = []
    longer_drives: list[Sequence[T]] = []
    for drive in (drives[i] for i in order):
        if len(drive) <= missing_count:
            items.extend(drive)
            missing_count -= len(drive)
        else:
            longer_drives.append(drive)
    return [*items, *(longer_drives[0][-missing_count:] if missing_count else ())]


def _count_held_out(count: int, fraction: float) -> int:
    if count < 2:
        raise InputError(TOO_FEW_FRAMES)
    return min(max(round(fraction * count), 1), count - 1)
