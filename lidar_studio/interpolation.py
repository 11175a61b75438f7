"""Boxes of one track from frame to frame: carried along, between, and after a correction.

All of it happens in a fixed frame where the drive has poses, else in the sensor's. Time is that of
the stamps.
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
    """times (F,) float64 seconds, rising; poses (F, 4, 4) of the sensor in a fixed frame, None
    where they are unknown."""

    times: Array
    poses: Array | None = None

    @staticmethod
    def of(stamps_ns: Array, poses: Array | None = None) -> Motion:
        """From stamps (F,) int; frames that do not follow each other in time count as 0.1 s."""
        times = (stamps_ns - stamps_ns[0]) / 1e9 if len(stamps_ns) else np.zeros(0)
        if (np.diff(times) <= 0).any():
            times = np.arange(len(times)) * 0.1
        return Motion(times, poses)

    def fixed(self, values: Array | tuple[float, ...], frame: int) -> Array:
        """(7,) a box of a frame in the fixed frame."""
        box = np.asarray(values, np.float64)
        return box if self.poses is None else transform_boxes(box, self.poses[frame])[0]

    def seen(self, box: Array, frame: int) -> Array:
        """The inverse of fixed."""
        return box if self.poses is None else transform_boxes(
            box, invert_pose(self.poses[frame]))[0]

    def carried(self, values: Array | tuple[float, ...], frm: int, to: int) -> Array:
        """(7,) a box of one frame as it is in another if it stands."""
        return self.seen(self.fixed(values, frm), to)


def between(first: Array, last: Array, share: float) -> Array:
    """(7,) a box on the way from one to another, both (7,), the yaw by the shorter turn."""
    box = first + share * (last - first)
    box[6] = wrap_angle(first[6] + share * wrap_angle(last[6] - first[6]))
    return box


def corrected(boxes: Mapping[int, Box], gone: frozenset[int], frame: int,
              values: tuple[float, ...], motion: Motion) -> dict[int, Box]:
    """The boxes of a track after a person set the one of a frame.

    It is a key box from now on. Up to the next key box on either side the boxes follow: by the
    whole correction where it is set, by none of it at the other key box, in between by its share of
    the time; frames without a box get one on the straight way. Beyond the outermost key box they
    take the whole correction, and the size. Key boxes stay, and frames in gone stay empty.
    """
    found = dict(boxes)
    found[frame] = Box(values, KEY)
    new = motion.fixed(values, frame)
    old = _estimated(boxes, frame, motion)
    change = np.zeros(7) if old is None else new - old
    change[6] = wrap_angle(change[6])
    for step in (-1, 1):
        side = [f for f in boxes if (f - frame) * step > 0]
        stop = min((f for f in side if boxes[f].kind == KEY), key=lambda f: abs(f - frame),
                   default=None)
        if stop is None:
            for f in side:
                moved = motion.fixed(boxes[f].values, f) + change
                moved[3:6], moved[6] = new[3:6], wrap_angle(moved[6])
                found[f] = Box.of(motion.seen(moved, f), boxes[f].kind)
            if side and (near := min(side, key=lambda f: abs(f - frame))) != frame + step:
                _fill(found, gone, near, frame, motion)
        else:
            _ramp(found, stop, frame, new, change, motion)
            _fill(found, gone, stop, frame, motion)
    return found


def _estimated(boxes: Mapping[int, Box], frame: int, motion: Motion) -> Array | None:
    """(7,) where the track is in a frame, in the fixed one; None before its begin and after its
    end."""
    if frame in boxes:
        return motion.fixed(boxes[frame].values, frame)
    before = max((f for f in boxes if f < frame), default=None)
    after = min((f for f in boxes if f > frame), default=None)
    if before is None or after is None:
        return None
    return _on_the_way(boxes, before, after, frame, motion)


def _on_the_way(boxes: Mapping[int, Box], a: int, b: int, frame: int, motion: Motion) -> Array:
    share = float((motion.times[frame] - motion.times[a]) / (motion.times[b] - motion.times[a]))
    return between(motion.fixed(boxes[a].values, a), motion.fixed(boxes[b].values, b), share)


def _ramp(found: dict[int, Box], stop: int, frame: int, new: Array, change: Array,
          motion: Motion) -> None:
    """Move the boxes between the key boxes of stop and frame by their shares of a change; a
    heading comes to the side of those of the key boxes."""
    fixed = motion.fixed(found[stop].values, stop)
    turn = wrap_line(change[6])
    for f in [f for f in found if min(stop, frame) < f < max(stop, frame)]:
        share = float((motion.times[f] - motion.times[stop])
                      / (motion.times[frame] - motion.times[stop]))
        straight, moved = between(fixed, new, share), motion.fixed(found[f].values, f)
        moved[:3] += share * change[:3]
        moved[3:6] = straight[3:6]
        moved[6] += share * turn
        if abs(wrap_angle(moved[6] - straight[6])) > np.pi / 2:
            moved[6] += np.pi
        moved[6] = wrap_angle(moved[6])
        found[f] = Box.of(motion.seen(moved, f), INTERPOLATED)


def _fill(found: dict[int, Box], gone: frozenset[int], a: int, b: int, motion: Motion) -> None:
    """Give frames between a and b that have no box one on the way between their neighbours."""
    there = sorted(f for f in found if min(a, b) <= f <= max(a, b))
    for first, last in pairwise(there):
        for f in range(first + 1, last):
            if f not in gone:
                found[f] = Box.of(motion.seen(_on_the_way(found, first, last, f, motion), f),
                                  INTERPOLATED)


def straightened(boxes: Mapping[int, Box], gone: frozenset[int], frame: int,
                 motion: Motion) -> dict[int, Box] | None:
    """The boxes of a track with that of a frame given back: all between the key boxes on either
    side of it are on the straight way, except in frames in gone. None where there are no two."""
    keys = [f for f, box in boxes.items() if box.kind == KEY and f != frame]
    before = max((f for f in keys if f < frame), default=None)
    after = min((f for f in keys if f > frame), default=None)
    if before is None or after is None:
        return None
    found = {f: box for f, box in boxes.items() if not before < f < after}
    _fill(found, gone, before, after, motion)
    return dict(sorted(found.items()))


def filled(boxes: Mapping[int, Box], motion: Motion) -> dict[int, Box]:
    """Proposed boxes with those of the frames between them that have none."""
    found = dict(boxes)
    if found:
        _fill(found, frozenset(), min(found), max(found), motion)
    return {f: b if f in boxes else Box(b.values, PROPOSED) for f, b in found.items()}
