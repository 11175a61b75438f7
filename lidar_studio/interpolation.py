"""Boxes of one track over time: interpolation, and propagation of corrections.

Boxes are interpolated by stamps, in a fixed frame if the drive has poses, else in the sensor frame.
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
    """Motion of the sensor in F frames.

    times: (F,) float64 in seconds, increasing.
    poses: (F, 4, 4) in a fixed frame; None if unknown.
    """

    times: Array
    poses: Array | None = None

    @staticmethod
    def of(stamps_ns: Array, poses: Array | None = None) -> Motion:
        """Make a Motion from stamps (F,) int; frames are 0.1 s apart if stamps do not increase."""
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


def interpolate_box(first: Array, last: Array, share: float) -> Array:
    """Interpolate linearly between two boxes (7,); the yaw takes the shorter turn."""
    box = first + share * (last - first)
    box[6] = wrap_angle(first[6] + share * wrap_angle(last[6] - first[6]))
    return box


def apply_correction(
    boxes: Mapping[int, Box], removed: frozenset[int], frame: int, values: tuple[float, ...], motion: Motion
) -> dict[int, Box]:
    """Set the key box of a frame, and adjust the other boxes of the track.

    Towards the next key box on each side, the correction fades linearly with time, and frames
    without a box get an interpolated one. On a side without a key box, all boxes get the full
    correction and the new size. Frames in `removed` stay empty.
    """
    corrected = dict(boxes)
    corrected[frame] = Box(values, KEY)
    new_box = motion.to_fixed(values, frame)
    old_box = _estimate_box(boxes, frame, motion)
    correction = np.zeros(7) if old_box is None else new_box - old_box
    correction[6] = wrap_angle(correction[6])
    for step in (-1, 1):
        side = [f for f in boxes if (f - frame) * step > 0]
        stop = min((f for f in side if boxes[f].kind == KEY), key=lambda f: abs(f - frame), default=None)
        if stop is None:
            for f in side:
                moved = motion.to_fixed(boxes[f].values, f) + correction
                moved[3:6], moved[6] = new_box[3:6], wrap_angle(moved[6])
                corrected[f] = Box.of(motion.to_sensor(moved, f), boxes[f].kind)
            if side and (nearest := min(side, key=lambda f: abs(f - frame))) != frame + step:
                _fill_gap(corrected, removed, nearest, frame, motion)
        else:
            _distribute_correction(corrected, stop, frame, new_box, correction, motion)
            _fill_gap(corrected, removed, stop, frame, motion)
    return corrected


def _estimate_box(boxes: Mapping[int, Box], frame: int, motion: Motion) -> Array | None:
    """Return the box (7,) of a frame in the fixed frame, interpolated if missing; None before the
    first and after the last box."""
    if frame in boxes:
        return motion.to_fixed(boxes[frame].values, frame)
    before = max((f for f in boxes if f < frame), default=None)
    after = min((f for f in boxes if f > frame), default=None)
    if before is None or after is None:
        return None
    return _interpolate_between(boxes, before, after, frame, motion)


def _interpolate_between(boxes: Mapping[int, Box], a: int, b: int, frame: int, motion: Motion) -> Array:
    share = float((motion.times[frame] - motion.times[a]) / (motion.times[b] - motion.times[a]))
    first, last = (motion.to_fixed(boxes[f].values, f) for f in (a, b))
    return interpolate_box(first, last, share)


def _distribute_correction(
    boxes: dict[int, Box], key_frame: int, frame: int, new_box: Array, correction: Array, motion: Motion
) -> None:
    """Move the boxes between the key boxes of `key_frame` and `frame` by a share of the correction
    that falls linearly to 0 at `key_frame`, and flip opposite headings."""
    key_box = motion.to_fixed(boxes[key_frame].values, key_frame)
    turn = wrap_line(correction[6])
    for f in [f for f in boxes if min(key_frame, frame) < f < max(key_frame, frame)]:
        share = float((motion.times[f] - motion.times[key_frame]) / (motion.times[frame] - motion.times[key_frame]))
        interpolated, moved = interpolate_box(key_box, new_box, share), motion.to_fixed(boxes[f].values, f)
        moved[:3] += share * correction[:3]
        moved[3:6] = interpolated[3:6]
        moved[6] += share * turn
        if abs(wrap_angle(moved[6] - interpolated[6])) > np.pi / 2:
            moved[6] += np.pi
        moved[6] = wrap_angle(moved[6])
        boxes[f] = Box.of(motion.to_sensor(moved, f), INTERPOLATED)


def _fill_gap(boxes: dict[int, Box], removed: frozenset[int], start: int, end: int, motion: Motion) -> None:
    frames = sorted(f for f in boxes if min(start, end) <= f <= max(start, end))
    for first, last in pairwise(frames):
        for f in range(first + 1, last):
            if f not in removed:
                box = _interpolate_between(boxes, first, last, f, motion)
                boxes[f] = Box.of(motion.to_sensor(box, f), INTERPOLATED)


def reinterpolate_frame(
    boxes: Mapping[int, Box], removed: frozenset[int], frame: int, motion: Motion
) -> dict[int, Box] | None:
    """Interpolate the boxes between the key boxes around `frame`, except in `removed` frames.

    Return None if one of the two key boxes is missing.
    """
    keys = [f for f, box in boxes.items() if box.kind == KEY and f != frame]
    before = max((f for f in keys if f < frame), default=None)
    after = min((f for f in keys if f > frame), default=None)
    if before is None or after is None:
        return None
    result = {f: box for f, box in boxes.items() if not before < f < after}
    _fill_gap(result, removed, before, after, motion)
    return dict(sorted(result.items()))


def fill_gaps(boxes: Mapping[int, Box], motion: Motion) -> dict[int, Box]:
    """Fill the gaps between proposed boxes by interpolation."""
    filled = dict(boxes)
    if filled:
        _fill_gap(filled, frozenset(), min(filled), max(filled), motion)
    return {f: b if f in boxes else Box(b.values, PROPOSED) for f, b in sorted(filled.items())}
