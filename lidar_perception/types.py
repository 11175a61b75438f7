"""The shared types: one LiDAR frame in, detections out.

Frames follow REP-103 (x forward, y left, z up; metres, radians); boxes are
[x y z l w h yaw] with the centre in x y z.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lidar_perception.classes import CLASSES, PEDESTRIAN

__all__ = ["CLASSES", "PEDESTRIAN", "Detections", "GroundTruth", "InputError", "LidarFrame",
           "usable_returns"]

MAX_RANGE = 1e5  # metres; what is farther is a broken return, not a point
LARGEST = 1e9  # of the numbers of a label; what is larger is damaged
SENSOR_HEIGHT = 1.73  # metres: KITTI's sensor above the road. Defaults, anchors and simulation


class InputError(ValueError):
    """Input that cannot be used. The message is one line: what is wrong, and the remedy."""


@dataclass(frozen=True)
class LidarFrame:
    """One cloud, with only the returns that can be used.

    xyz (N, 3) float32 metres in frame_id, C-contiguous; intensity (N,) float32 0..1 or None;
    stamp_ns int. All columns went through one mask, see usable_returns.
    """

    xyz: np.ndarray
    intensity: np.ndarray | None = None
    stamp_ns: int = 0
    frame_id: str = ""

    @staticmethod
    def of(xyz: np.ndarray, intensity: np.ndarray | None = None, stamp_ns: int = 0,
           frame_id: str = "") -> LidarFrame:
        """The frame of the usable ones among returns (N, 3) as a sensor gives them."""
        frame = LidarFrame(np.ascontiguousarray(xyz, np.float32), intensity, stamp_ns, frame_id)
        usable = usable_returns(frame.xyz)
        return frame if usable.all() else frame.take(np.flatnonzero(usable))

    def __len__(self) -> int:
        return len(self.xyz)

    def take(self, indices: np.ndarray) -> LidarFrame:
        """The frame of the points at indices (M,)."""
        intensity = None if self.intensity is None else self.intensity.take(indices)
        return LidarFrame(self.xyz.take(indices, axis=0), intensity, self.stamp_ns, self.frame_id)

    def points(self) -> np.ndarray:
        """(N, 4) float32 [x y z intensity]; 0 without intensity."""
        intensity = np.zeros(len(self), np.float32) if self.intensity is None else self.intensity
        return np.column_stack([self.xyz, intensity])


def usable_returns(xyz: np.ndarray) -> np.ndarray:
    """(N,) bool: finite, within 100 km, and not the origin, where drivers put missing returns."""
    with np.errstate(invalid="ignore", over="ignore"):
        square = np.einsum("ij,ij->i", xyz, xyz)  # NaN and inf survive
        return (square > 0.0) & (square <= MAX_RANGE * MAX_RANGE)


@dataclass(frozen=True)
class Detections:
    """K boxes: boxes (K, 7) float32 [x y z l w h yaw], class_ids (K,) int32 into CLASSES,
    scores (K,) float32. No detections is K = 0, never None. sources: by the name of what judged
    them its own probability (K,) float32, NaN where it says nothing; empty where one thing alone
    did."""

    boxes: np.ndarray
    class_ids: np.ndarray
    scores: np.ndarray
    sources: Mapping[str, np.ndarray] = field(default_factory=dict)

    @staticmethod
    def of(boxes: ArrayLike, class_ids: ArrayLike = PEDESTRIAN,
           scores: ArrayLike = 1.0) -> Detections:
        """Detections with dtypes and shapes put right; class_ids and scores may be scalars."""
        boxes = np.ascontiguousarray(boxes, np.float32).reshape(-1, 7)
        count = len(boxes)
        return Detections(boxes, np.broadcast_to(np.asarray(class_ids, np.int32), count).copy(),
                          np.broadcast_to(np.asarray(scores, np.float32), count).copy())

    @staticmethod
    def none() -> Detections:
        return Detections.of(np.zeros((0, 7)))

    def __len__(self) -> int:
        return len(self.boxes)

    def __getitem__(self, index: np.ndarray | slice) -> Detections:
        """The detections under a mask, slice or index array."""
        return Detections(self.boxes[index], self.class_ids[index], self.scores[index],
                          {name: said[index] for name, said in self.sources.items()})

    def followed_by(self, others: Detections) -> Detections:
        """These and then the others, without sources."""
        return Detections(np.concatenate([self.boxes, others.boxes]),
                          np.concatenate([self.class_ids, others.class_ids]),
                          np.concatenate([self.scores, others.scores]))


def class_ids(names: Iterable[str]) -> list[int]:
    """Into CLASSES; a name that is not there is Misc."""
    return [CLASSES.index(name if name in CLASSES else "Misc") for name in names]


@dataclass(frozen=True)
class GroundTruth:
    """The labelled objects of one frame, in the LiDAR frame.

    boxes (K, 7) float64 [x y z l w h yaw], class_ids (K,) int into CLASSES, extras K dicts with
    what else is known: track_id, truncated, occluded, alpha, bbox [left top right bottom] pixels.
    notes: (class, extras) of objects without a 3D box, such as KITTI's DontCare regions.
    """

    boxes: np.ndarray
    class_ids: np.ndarray
    extras: tuple[dict[str, Any], ...]
    notes: tuple[tuple[str, dict[str, Any]], ...] = ()

    @staticmethod
    def of(boxes: ArrayLike, class_ids: ArrayLike, extras: Iterable[dict[str, Any]] | None = None,
           notes: Iterable[tuple[str, dict[str, Any]]] = ()) -> GroundTruth:
        boxes = np.asarray(boxes, np.float64).reshape(-1, 7)
        extras = tuple({} for _ in boxes) if extras is None else tuple(extras)
        return GroundTruth(boxes, np.asarray(class_ids, np.int32).reshape(len(boxes)), extras,
                           tuple(notes))

    def __len__(self) -> int:
        return len(self.boxes)

    @property
    def labels(self) -> list[str]:
        return [CLASSES[i] for i in self.class_ids]

    def of_class(self, class_id: int) -> np.ndarray:
        """(M, 7) boxes of one class."""
        return self.boxes[self.class_ids == class_id]
