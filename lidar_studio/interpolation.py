"""Boxes of one track over its frames: copying, interpolation, and propagation of corrections.

Boxes are interpolated over stamps, in a fixed frame if the drive has poses, else in the sensor's.
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
    """Interpolate two boxes (7,) linearly, the yaw over the shorter turn."""
    box = first + share * (last - first)
    box[6] = wrap_angle(first[6] + share * wrap_angle(last[6] - first[6]))
    return box


def apply_correction(
    boxes: Mapping[int, Box], removed: frozenset[int], frame: int, values: tuple[float, ...], motion: Motion
) -> dict[int, Box]:
    """Set the key box of a frame, and adjust the other boxes of the track.

    Up to the next key box on each side, the correction fades linearly with time, and frames without
    a box get an interpolated one. If there is no key box on a side, all boxes there take the whole
    correction and the new size. Frames in `removed` stay empty.
    """
    found = dict(boxes)
    found[frame] = Box(values, KEY)
    new = motion.to_fixed(values, frame)
    old = _estimate_box(boxes, frame, motion)
    change = np.zeros(7) if old is None else new - old
    change[6] = wrap_angle(change[6])
    for step in (-1, 1):
        side = [f for f in boxes if (f - frame) * step > 0]
        stop = min((f for f in side if boxes[f].kind == KEY), key=lambda f: abs(f - frame), default=None)
        if stop is None:
            for f in side:
                moved = motion.to_fixed(boxes[f].values, f) + change
                moved[3:6], moved[6] = new[3:6], wrap_angle(moved[6])
                found[f] = Box.of(motion.to_sensor(moved, f), boxes[f].kind)
            if side and (near := min(side, key=lambda f: abs(f - frame))) != frame + step:
                _fill_gap(found, removed, near, frame, motion)
        else:
            _distribute_correction(found, stop, frame, new, change, motion)
            _fill_gap(found, removed, stop, frame, motion)
    return found


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
    found: dict[int, Box], stop: int, frame: int, new: Array, change: Array, motion: Motion
) -> None:
    """Move the boxes between the key boxes of `stop` and `frame` by their shares of a change, and
    flip opposite headings."""
    fixed = motion.to_fixed(found[stop].values, stop)
    turn = wrap_line(change[6])
    for f in [f for f in found if min(stop, frame) < f < max(stop, frame)]:
        share = float((motion.times[f] - motion.times[stop]) / (motion.times[frame] - motion.times[stop]))
        straight, moved = interpolate_box(fixed, new, share), motion.to_fixed(found[f].values, f)
        moved[:3] += share * change[:3]
        moved[3:6] = straight[3:6]
        moved[6] += share * turn
        if abs(wrap_angle(moved[6] - straight[6])) > np.pi / 2:
            moved[6] += np.pi
        moved[6] = wrap_angle(moved[6])
        found[f] = Box.of(motion.to_sensor(moved, f), INTERPOLATED)


def _fill_gap(found: dict[int, Box], removed: frozenset[int], a: int, b: int, motion: Motion) -> None:
    frames = sorted(f for f in found if min(a, b) <= f <= max(a, b))
    for first, last in pairwise(frames):
        for f in range(first + 1, last):
            if f not in removed:
                box = _interpolate_between(found, first, last, f, motion)
                found[f] = Box.of(motion.to_sensor(box, f), INTERPOLATED)


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
    found = {f: box for f, box in boxes.items() if not before < f < after}
    _fill_gap(found, removed, before, after, motion)
    return dict(sorted(found.items()))


def fill_gaps(boxes: Mapping[int, Box], motion: Motion) -> dict[int, Box]:
    """Return proposed boxes, with the gaps between them interpolated."""
    found = dict(boxes)
    if found:
        _fill_gap(found, frozenset(), min(found), max(found), motion)
    return {f: b if f in boxes else Box(b.values, PROPOSED) for f, b in sorted(found.items())}
