"""Whole drives: which detections of which frames are of one object, looked at forwards and back."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from lidar_perception.geometry import centre_distances
from lidar_perception.tracking.params import TrackingParams
from lidar_perception.tracking.state import Tracks
from lidar_perception.tracking.tracker import Tracker
from lidar_perception.types import Detections

NEAR = 1.0  # metres between a track and the detection that it was hit by
NONE = -1
# All that is followed is reported; what is sure is chosen among whole tracks.
WHOLE = TrackingParams(report=0.0, report_unseen=0.0)
Hit = tuple[int, int]  # a frame, and a detection there


def hits(tracks: Tracks, found: Detections) -> np.ndarray:
    """(K,) int64: of K tracks the detection of the frame that each was hit by, the nearest within
    NEAR; NONE for a track that was not."""
    if len(found) == 0:
        return np.full(len(tracks), NONE)
    apart = centre_distances(tracks.detections.boxes, found.boxes)
    nearest = apart.argmin(axis=1)
    return np.where(tracks.seen & (apart.min(axis=1) <= NEAR), nearest, NONE)


def followed(found: Sequence[Detections], stamps_ns: Sequence[int], poses: Sequence[np.ndarray],
             params: TrackingParams = WHOLE) -> list[list[Hit]]:
    """The objects of a drive, each with its detections in the order of time. found: of its frames,
    with stamps, rising and not 0, and poses (4, 4) in a fixed frame.

    The drive is followed forwards and, time turned round, backwards, where an object is known
    before the frames in which it is only guessed; a detection is of one object.
    """
    ahead = _followed(found, stamps_ns, poses, params)
    last = len(found) - 1
    turned = [int(stamps_ns[0] + stamps_ns[-1] - s) for s in reversed(stamps_ns)]
    back = [[(last - frame, k) for frame, k in reversed(one)] for one in
            _followed(found[::-1], turned, poses[::-1], params)]
    owner = {hit: number for number, one in enumerate(ahead) for hit in one}
    objects = {number: set(one) for number, one in enumerate(ahead)}
    for one in back:
        votes = Counter(owner[hit] for hit in one if hit in owner)
        free = [hit for hit in one if hit not in owner]
        number = votes.most_common(1)[0][0] if votes else len(objects)
        mine = objects.setdefault(number, set())
        seen = {frame for frame, _ in mine}
        new = [hit for hit in free if hit[0] not in seen]
        mine.update(new)
        owner.update(dict.fromkeys(new, number))
    return [sorted(one) for one in objects.values() if one]


def _followed(found: Sequence[Detections], stamps_ns: Sequence[int], poses: Sequence[np.ndarray],
              params: TrackingParams) -> list[list[Hit]]:
    tracker, objects = Tracker(params), dict[int, list[Hit]]()
    for frame, each in enumerate(found):
        tracks = tracker(each, stamps_ns[frame], poses[frame])
        taken = set[int]()
        for number, k in zip(tracks.ids.tolist(), hits(tracks, each).tolist()):
            if k != NONE and k not in taken:
                taken.add(k)
                objects.setdefault(number, []).append((frame, k))
    return list(objects.values())
