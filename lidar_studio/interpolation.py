"""Interpolation of a track's boxes between frames, and propagation of corrections.

Boxes are interpolated in time. If the drive has poses, they are interpolated in a fixed frame, otherwise
in the sensor frame.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from lidar_perception.geometry import wrap_angle, wrap_line
from lidar_perception.robot.poses import invert_pose, transform_boxes
from lidar_studio.state import INTERPOLATED, KEY, PROPOSED, Box

Array = np.ndarray[Any, Any]


@dataclass(frozen=True, eq=False)
class Motion:
    """Motion of the sensor over F frames.

    Attributes:
        times: (F,) float64 in seconds, strictly increasing.
        poses: (F, 4, 4) poses of the sensor in a fixed frame, or None if unknown.
    """

    times: Array
    poses: Array | None = None

    @staticmethod
    def from_stamps(stamps_ns: Array, poses: Array | None = None) -> Motion:
        """Make a Motion from stamps (F,) int64 in ns. If they do not increase, frames are assumed 0.1 s apart."""
        times = (stamps_ns - stamps_ns[0]) / 1e9 if len(stamps_ns) else np.zeros(0)
        if (np.diff(times) <= 0).any():
            times = np.arange(len(times)) * 0.1
        return Motion(times, poses)

    def to_fixed(self, values: Array | tuple[float, ...], frame: int) -> Array:
        """Transform a box (7,) from the sensor at `frame` to the fixed frame."""
        box = np.asarray(values, np.float64)
        return box if self.poses is None else transform_boxes(box, self.poses[frame])[0]

    def to_sensor(self, box: Array, frame: int) -> Array:
        """Transform a box (7,) from the fixed frame to the sensor at `frame`."""
        return box if self.poses is None else transform_boxes(box, invert_pose(self.poses[frame]))[0]


def interpolate_box(first: Array, last: Array, fraction: float) -> Array:
    """Interpolate linearly between two boxes (7,), with the yaw along the shorter arc."""
    box = first + fraction * (last - first)
    box[6] = wrap_angle(first[6] + fraction * wrap_angle(last[6] - first[6]))
    return box


def apply_correction(
    boxes: Mapping[int, Box], removed_frames: frozenset[int], frame: int, values: tuple[float, ...], motion: Motion
) -> dict[int, Box]:
    """Set the key box of a frame, and adjust the other boxes of the track.

    The correction decreases linearly with time to the next key box on each side, and frames between
    them without a box get an interpolated box. On a side without a key box, all boxes get the full
    correction and the new size. Frames in `removed_frames` stay empty.
    """
    corrected_boxes = dict(boxes)
    corrected_boxes[frame] = Box(values, KEY)
    new_box = motion.to_fixed(values, frame)
    old_box = _estimate_box(boxes, frame, motion)
    correction = np.zeros(7) if old_box is None else new_box - old_box
    correction[6] = wrap_angle(correction[6])
    for step in (-1, 1):
        frames = [f for f in boxes if (f - frame) * step > 0]
        key_frame = min((f for f in frames if boxes[f].kind == KEY), key=lambda f: abs(f - frame), default=None)
        if key_frame is None:
            for f in frames:
                box = motion.to_fixed(boxes[f].values, f) + correction
                box[3:6], box[6] = new_box[3:6], wrap_angle(box[6])
                corrected_boxes[f] = Box.from_array(motion.to_sensor(box, f), boxes[f].kind)
            if frames and (nearest := min(frames, key=lambda f: abs(f - frame))) != frame + step:
                _fill_gaps_between(corrected_boxes, removed_frames, nearest, frame, motion)
        else:
            _distribute_correction(corrected_boxes, key_frame, frame, new_box, correction, motion)
            _fill_gaps_between(corrected_boxes, removed_frames, key_frame, frame, motion)
    return corrected_boxes


def _estimate_box(boxes: Mapping[int, Box], frame: int, motion: Motion) -> Array | None:
    """Return the box (7,) at `frame` in fixed coordinates, interpolated if it is missing.

    Returns None before the first and after the last box.
    """
    if frame in boxes:
        return motion.to_fixed(boxes[frame].values, frame)
    previous_frame = max((f for f in boxes if f < frame), default=None)
    next_frame = min((f for f in boxes if f > frame), default=None)
    if previous_frame is None or next_frame is None:
        return None
    return _interpolate_between(boxes, previous_frame, next_frame, frame, motion)


def _interpolate_between(boxes: Mapping[int, Box], a: int, b: int, frame: int, motion: Motion) -> Array:
    fraction = float((motion.times[frame] - motion.times[a]) / (motion.times[b] - motion.times[a]))
    first, last = (motion.to_fixed(boxes[f].values, f) for f in (a, b))
    return interpolate_box(first, last, fraction)


def _distribute_correction(
    boxes: dict[int, Box], key_frame: int, frame: int, new_box: Array, correction: Array, motion: Motion
) -> None:
    """Spread a correction of the key box at `frame` over the boxes back to the key box at `key_frame`.

    The correction decreases linearly with time to 0 at `key_frame`. Headings that point backwards are flipped.
    """
    key_box = motion.to_fixed(boxes[key_frame].values, key_frame)
    yaw_correction = wrap_line(correction[6])
    for f in [f for f in boxes if min(key_frame, frame) < f < max(key_frame, frame)]:
        fraction = float((motion.times[f] - motion.times[key_frame]) / (motion.times[frame] - motion.times[key_frame]))
        interpolated_box, box = interpolate_box(key_box, new_box, fraction), motion.to_fixed(boxes[f].values, f)
        box[:3] += fraction * correction[:3]
        box[3:6] = interpolated_box[3:6]
        box[6] += fraction * yaw_correction
        if abs(wrap_angle(box[6] - interpolated_box[6])) > np.pi / 2:
            box[6] += np.pi
        box[6] = wrap_angle(box[6])
        boxes[f] = Box.from_array(motion.to_sensor(box, f), INTERPOLATED)


def _fill_gaps_between(
    boxes: dict[int, Box], removed_frames: frozenset[int], start: int, end: int, motion: Motion
) -> None:
    frames = sorted(f for f in boxes if min(start, end) <= f <= max(start, end))
    for first, last in pairwise(frames):
        for f in range(first + 1, last):
            if f not in removed_frames:
                box = _interpolate_between(boxes, first, last, f, motion)
                boxes[f] = Box.from_array(motion.to_sensor(box, f), INTERPOLATED)


def reinterpolate_frame(
    boxes: Mapping[int, Box], removed_frames: frozenset[int], frame: int, motion: Motion
) -> dict[int, Box] | None:
    """Interpolate all boxes between the key boxes before and after `frame`, except in `removed_frames`.

    Returns None if one of the two key boxes is missing.
    """
    key_frames = [f for f, box in boxes.items() if box.kind == KEY and f != frame]
    previous_frame = max((f for f in key_frames if f < frame), default=None)
    next_frame = min((f for f in key_frames if f > frame), default=None)
    if previous_frame is None or next_frame is None:
        return None
    new_boxes = {f: box for f, box in boxes.items() if not previous_frame < f < next_frame}
    _fill_gaps_between(new_boxes, removed_frames, previous_frame, next_frame, motion)
    return dict(sorted(new_boxes.items()))


def fill_gaps(boxes: Mapping[int, Box], motion: Motion) -> dict[int, Box]:
    """Fill the gaps between proposed boxes by interpolation."""
    all_boxes = dict(boxes)
    if all_boxes:
        _fill_gaps_between(all_boxes, frozenset(), min(all_boxes), max(all_boxes), motion)
    return {f: b if f in boxes else Box(b.values, PROPOSED) for f, b in sorted(all_boxes.items())}
