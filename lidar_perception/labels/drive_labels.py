"""The labels of a drive, frame by frame, whatever format they came from and go to."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lidar_perception.data.frame import Frame
from lidar_perception.geometry import wrap_angle
from lidar_perception.types import CLASSES, MAX_RANGE, GroundTruth, InputError, class_ids

NO_TRACK = -1
OTHER = "Misc"  # of CLASSES, for those that it does not have
SAME = 1e-4  # metres, radians: a box that moved by less is as it was read


@dataclass(frozen=True, eq=False)
class FrameLabels:
    """K labelled boxes of one frame, in its LiDAR frame.

    name, stamp_ns: of the frame. boxes (K, 7) float64 [x y z l w h yaw], metres and radians;
    class_names K strings, any text; track_ids (K,) int64, -1 = none; scores (K,) float64, NaN =
    none; extra K JSON objects with what else the format said. notes: (class, JSON object) of
    objects without a 3D box, such as KITTI's DontCare regions. No labels is K = 0.
    """

    name: str
    stamp_ns: int
    boxes: np.ndarray
    class_names: list[str]
    track_ids: np.ndarray
    scores: np.ndarray
    extra: list[dict[str, Any]]
    notes: list[tuple[str, dict[str, Any]]] = field(default_factory=list)

    @staticmethod
    def of(name: str, stamp_ns: int, boxes: ArrayLike = (), class_names: Iterable[str] = (),
           track_ids: ArrayLike | None = None, scores: ArrayLike | None = None,
           extra: Iterable[dict[str, Any]] | None = None,
           notes: Iterable[tuple[str, dict[str, Any]]] = (), where: object = None) -> FrameLabels:
        """Labels with dtypes and shapes put right. InputError, naming `where`, for a box that is
        not finite, lies beyond MAX_RANGE or has a side that is not above 0, for a track id that is
        no whole number, and for numbers of columns that differ."""
        where = where or f"the labels of frame {name}"
        try:
            boxes = np.array(boxes, np.float64).reshape(-1, 7)
            count = len(boxes)
            ids = np.full(count, NO_TRACK) if track_ids is None else np.array(track_ids)
            given = np.full(count, np.nan) if scores is None else np.array(scores, np.float64)
            labels = FrameLabels(name, int(stamp_ns), boxes, [str(c) for c in class_names],
                                 _whole(ids).reshape(count), given.reshape(count),
                                 [{} for _ in boxes] if extra is None else list(extra),
                                 list(notes))
        except (ValueError, TypeError, OverflowError) as error:
            raise InputError(f"{where}: a box that cannot be read ({error}); it needs seven "
                             "numbers, a class and, if any, a whole number as track id") from None
        if not len(labels.class_names) == len(labels.extra) == count:
            raise InputError(f"{where}: {count} boxes, {len(labels.class_names)} classes and "
                             f"{len(labels.extra)} notes; each box needs one")
        wrong = ~((np.abs(boxes[:, :6]) <= MAX_RANGE).all(axis=1) & np.isfinite(boxes[:, 6])
                  & (boxes[:, 3:6] > 0).all(axis=1))
        if wrong.any():
            raise InputError(f"{where}, box {np.flatnonzero(wrong)[0] + 1} of {count}: its numbers "
                             f"must be finite and within {MAX_RANGE:g} m, its sides above 0; "
                             "correct or remove it")
        if np.isinf(labels.scores).any():
            raise InputError(f"{where}: a score is not finite; correct or remove it")
        return labels

    def __len__(self) -> int:
        return len(self.boxes)


@dataclass(frozen=True, eq=False)
class DriveLabels:
    """The labels of a drive: of each of its frames one FrameLabels, in the same order. extra: a
    JSON object with what a format says of the whole drive, under the name of the format."""

    frames: list[FrameLabels]
    extra: dict[str, Any] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.frames)

    def first(self, count: int) -> DriveLabels:
        """Those of the first frames."""
        return DriveLabels(self.frames[:count], self.extra)

    @property
    def boxes(self) -> int:
        """How many there are in all frames."""
        return sum(len(frame) for frame in self.frames)


Row = tuple[Sequence[float], str, int, float, dict[str, Any]]  # box, class, track id, score, extra


def of_rows(frame: Frame, rows: Iterable[Row], notes: Iterable[tuple[str, dict[str, Any]]] = (),
            where: object = None) -> FrameLabels:
    """The labels of a frame from the boxes one by one; otherwise as FrameLabels.of."""
    columns: list[Any] = [*zip(*rows)] or [[]] * 5
    boxes, names, ids, scores, extra = columns
    return FrameLabels.of(frame.name, frame.stamp_ns, boxes, names, ids, scores, extra, notes,
                          where)


def of_truth(frame: Frame) -> FrameLabels:
    """The labels that a recording gives for a frame; none where it gives none. A class that
    CLASSES does not have has the name that the recording gave it."""
    truth = frame.truth()
    if truth is None:
        return FrameLabels.of(frame.name, frame.stamp_ns)
    extra = [dict(e) for e in truth.extras]
    ids = [e.pop("track_id", NO_TRACK) for e in extra]
    scores = [e.pop("score", np.nan) for e in extra]
    classes = [str(e.pop("class_name", None) or (label == OTHER and (
        e.get("detection_name") or e.get("category"))) or label)
        for e, label in zip(extra, truth.labels)]
    return FrameLabels.of(frame.name, frame.stamp_ns, truth.boxes, classes, ids, scores, extra,
                          truth.notes)


def _whole(ids: np.ndarray) -> np.ndarray:
    """ids as int64. ValueError where one is something else."""
    with np.errstate(invalid="ignore"):
        whole = ids.astype(np.int64)
    if (whole != ids).any():
        raise ValueError("a track id is no whole number, or too large")
    return whole


def to_truth(labels: FrameLabels) -> GroundTruth:
    """As a recording gives it; a class that is not known is Misc, with its name in extras."""
    extras = []
    for k, (name, extra) in enumerate(zip(labels.class_names, labels.extra)):
        known = {} if name in CLASSES else {"class_name": name}
        extras.append({**extra, **known, **ids_and_score(labels, k)})
    return GroundTruth.of(labels.boxes, class_ids(labels.class_names), extras, labels.notes)


def ids_and_score(labels: FrameLabels, k: int) -> dict[str, Any]:
    """track_id and score of box k, where it has them."""
    known: dict[str, Any] = {}
    if labels.track_ids[k] != NO_TRACK:
        known["track_id"] = int(labels.track_ids[k])
    if np.isfinite(labels.scores[k]):
        known["score"] = float(labels.scores[k])
    return known


def unchanged(box: Sequence[float] | np.ndarray, kept: Sequence[float] | np.ndarray) -> bool:
    """Whether a box (7,) is the one that was read, so that what was read with it holds."""
    difference = np.subtract(box, kept)
    difference[6] = wrap_angle(difference[6])
    return bool(np.abs(difference).max() < SAME)
