"""From objects that were followed to labels of every frame: boxes put right over time, and regions
of which nothing is learned."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lidar_perception.adapting.judging import IGNORED, KEPT, STATES, Verdict
from lidar_perception.adapting.tracks import Followed
from lidar_perception.geometry import bev_iou, wrap_angle
from lidar_perception.robot.poses import inverse, moved_boxes

BESIDE = 2.0     # seconds that a standing object is there before and after it is detected
STANDS = 0.5     # metres over the ground, scatter and way, up to which it stands
OVERLAP = 0.05   # of two kept boxes, seen from above: more, and one of them is wrong


@dataclass(frozen=True)
class ConcludedLabels:
    """K boxes (K, 7) float64 in a frame's own coordinates, with class_ids (K,) int, states (K,) int
    into STATES, numbers (K,) int of the objects in their drive, scores (K,), seen (K,) bool: not
    concluded from other frames."""

    boxes: np.ndarray
    class_ids: np.ndarray
    states: np.ndarray
    numbers: np.ndarray
    scores: np.ndarray
    seen: np.ndarray

    def __len__(self) -> int:
        return len(self.boxes)

    def of(self, state: str) -> np.ndarray:
        """(K,) bool: those in a state."""
        return self.states == STATES.index(state)


def labels_of(tracks: Sequence[Followed], verdicts: Sequence[Verdict], poses: Sequence[np.ndarray],
              seconds: np.ndarray) -> list[ConcludedLabels]:
    """The labels of all frames of a drive, with poses (4, 4) in the frame of the tracks and times
    seconds (F,). Of kept boxes that overlap the best stays and the others are ignored."""
    rows: list[list[tuple[Any, ...]]] = [[] for _ in poses]
    for number, (track, verdict) in enumerate(zip(tracks, verdicts)):
        frames, boxes = placed(track, seconds)
        state = STATES.index(verdict.state)
        for frame, box in zip(frames.tolist(), boxes):
            rows[frame].append((moved_boxes(box, inverse(poses[frame]))[0], track.class_id, state,
                                number, track.score, frame in track.frames))
    return [_apart(_frame(each)) for each in rows]


def _frame(rows: list[tuple[Any, ...]]) -> ConcludedLabels:
    columns: list[Any] = [*zip(*rows)] or [[]] * 6
    boxes, class_ids, states, numbers, scores, seen = columns
    return ConcludedLabels(np.array(boxes, float).reshape(-1, 7), np.array(class_ids, int),
                           np.array(states, int), np.array(numbers, int),
                           np.array(scores, float), np.array(seen, bool))


def _apart(labels: ConcludedLabels) -> ConcludedLabels:
    kept = np.flatnonzero(labels.of(KEPT))
    order = kept[np.argsort(-labels.scores[kept], kind="stable")]
    states, taken = labels.states.copy(), list[int]()
    for k in order.tolist():
        if taken and bev_iou(labels.boxes[[k]], labels.boxes[taken]).max() > OVERLAP:
            states[k] = STATES.index(IGNORED)
        else:
            taken.append(k)
    return replace(labels, states=states)


def placed(track: Followed, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """frames (m,) int, rising, and boxes (m, 7) of an object there, in the fixed frame: in the
    frames of its detections and those between, of one size, as its best views have it. What stands
    has one box, the median of all, also in frames up to BESIDE seconds before and after."""
    weights = track.scores * np.sqrt(track.counts + 1.0)
    boxes = track.boxes.copy()
    boxes[:, 3:6] = [_median(boxes[:, axis], weights) for axis in (3, 4, 5)]
    stands = track.way < STANDS and track.scatter < STANDS
    first, last = track.frames[0], track.frames[-1]
    if stands:
        boxes[:, :3] = [_median(boxes[:, axis], weights) for axis in range(3)]
        boxes[:, 6] = _axis(boxes[:, 6], weights)
        first = int(np.searchsorted(seconds, seconds[first] - BESIDE))
        last = int(np.searchsorted(seconds, seconds[last] + BESIDE, "right")) - 1
        frames = np.arange(first, last + 1)
        return frames, np.tile(boxes[0], (len(frames), 1))
    frames = np.arange(first, last + 1)
    boxes[:, 6] = _turning(boxes[:, 6], weights)
    between = np.column_stack([np.interp(seconds[frames], seconds[track.frames], column)
                               for column in boxes.T])
    between[:, 6] = wrap_angle(between[:, 6])
    return frames, between


def _median(values: np.ndarray, weights: np.ndarray) -> float:
    order = np.argsort(values, kind="stable")
    sums = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(sums, sums[-1] / 2)])


def _turning(yaws: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Yaws (n,) that turn steadily, where front and rear were confused, the side that of most."""
    steady = np.unwrap(yaws, period=np.pi)
    ahead = weights @ np.cos(yaws - steady) >= 0
    return steady if ahead else steady + np.pi


def _axis(yaws: np.ndarray, weights: np.ndarray) -> float:
    """The mean direction of an axis, its side that of most."""
    double = np.arctan2(weights @ np.sin(2 * yaws), weights @ np.cos(2 * yaws)) / 2
    ahead = weights @ np.cos(yaws - double) >= 0
    return float(wrap_angle(double if ahead else double + np.pi))
