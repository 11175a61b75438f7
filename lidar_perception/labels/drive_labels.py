"""Labels of drives and frames, independent of the file format."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lidar_perception.data.frame import Frame
from lidar_perception.geometry import wrap_angle
from lidar_perception.types import CLASSES, MAX_RANGE, GroundTruth, InputError, find_class_ids

NO_TRACK = -1
OTHER_CLASS = "Misc"  # one of CLASSES, used for unknown classes
MAX_DIFFERENCE = 1e-4  # boxes that differ less from the box in the file (in metres and radians) are unchanged


@dataclass(frozen=True, eq=False)
class FrameLabels:
    """K labelled boxes of one frame, in its LiDAR frame; K may be 0.

    Attributes:
        name: Name of the frame.
        stamp_ns: Stamp of the frame.
        boxes: (K, 7) float64 [x y z l w h yaw], metres and radians.
        class_names: K class names, which may be any text.
        track_ids: (K,) int64, -1 for boxes without a track.
        scores: (K,) float64, NaN for boxes without a score.
        extra: K JSON objects with additional fields of the format.
        notes: (class name, JSON object) of each object without a 3D box, such as KITTI's DontCare
            regions.
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
    def of(
        name: str,
        stamp_ns: int,
        boxes: ArrayLike = (),
        class_names: Iterable[str] = (),
        track_ids: ArrayLike | None = None,
        scores: ArrayLike | None = None,
        extra: Iterable[dict[str, Any]] | None = None,
        notes: Iterable[tuple[str, dict[str, Any]]] = (),
        source: object = None,
    ) -> FrameLabels:
        """Make labels from lists or arrays.

        Args:
            source: Name of the file or frame, with which error messages start.

        Raises:
            InputError: A box is not finite, is beyond MAX_RANGE or has a side that is not positive;
                a track id is not an integer; or the columns differ in length.
        """
        source = source or f"the labels of frame {name}"
        try:
            boxes = np.array(boxes, np.float64).reshape(-1, 7)
            count = len(boxes)
            raw_ids = np.full(count, NO_TRACK) if track_ids is None else np.array(track_ids)
            score_values = np.array(np.full(count, np.nan) if scores is None else scores, np.float64)
            labels = FrameLabels(
                name,
                int(stamp_ns),
                boxes,
                [str(c) for c in class_names],
                _to_integers(raw_ids).reshape(count),
                score_values.reshape(count),
                [{} for _ in boxes] if extra is None else list(extra),
                list(notes),
            )
        except (ValueError, TypeError, OverflowError) as error:
            raise InputError(
                f"{source}: a box is malformed ({error}); expected seven numbers, a "
                "class and, optionally, an integer track id"
            ) from None
        if not len(labels.class_names) == len(labels.extra) == count:
            raise InputError(
                f"{source}: {count} boxes, but {len(labels.class_names)} classes and "
                f"{len(labels.extra)} extras; each box needs one of each"
            )
        is_invalid = ~(
            (np.abs(boxes[:, :6]) <= MAX_RANGE).all(axis=1) & np.isfinite(boxes[:, 6]) & (boxes[:, 3:6] > 0).all(axis=1)
        )
        if is_invalid.any():
            raise InputError(
                f"{source}, box {np.flatnonzero(is_invalid)[0] + 1} of {count}: its "
                f"numbers must be finite and within {MAX_RANGE:g} m, and its sides positive; "
                "correct or remove it"
            )
        if np.isinf(labels.scores).any():
            raise InputError(f"{source}: a score is not finite; correct or remove it")
        return labels

    def __len__(self) -> int:
        return len(self.boxes)


@dataclass(frozen=True, eq=False)
class DriveLabels:
    """Labels of a drive.

    Attributes:
        frames: Labels of each frame, in the order of the frames.
        extra: Other content of a label file that belongs to the whole drive, by format.
    """

    frames: list[FrameLabels]
    extra: dict[str, Any] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.frames)

    def take_first(self, count: int) -> DriveLabels:
        """Return the labels of the first `count` frames."""
        return DriveLabels(self.frames[:count], self.extra)

    @property
    def box_count(self) -> int:
        """Number of boxes in all frames."""
        return sum(len(frame) for frame in self.frames)


Row = tuple[Sequence[float], str, int, float, dict[str, Any]]  # (box, class, track id, score, extra)


def make_frame_labels(
    frame: Frame, rows: Iterable[Row], notes: Iterable[tuple[str, dict[str, Any]]] = (), source: object = None
) -> FrameLabels:
    """Make the labels of a frame from one row per box; for the other arguments see FrameLabels.of."""
    columns: list[Any] = [*zip(*rows)] or [[]] * 5
    boxes, names, ids, scores, extra = columns
    return FrameLabels.of(frame.name, frame.stamp_ns, boxes, names, ids, scores, extra, notes, source)


def read_frame_labels(frame: Frame) -> FrameLabels:
    """Read the labels of a frame of a recording, with their original class names."""
    truth = frame.truth()
    if truth is None:
        return FrameLabels.of(frame.name, frame.stamp_ns)
    extra = [dict(e) for e in truth.extras]
    ids = [e.pop("track_id", NO_TRACK) for e in extra]
    scores = [e.pop("score", np.nan) for e in extra]
    classes = [
        str(
            e.pop("class_name", None)
            or (label == OTHER_CLASS and (e.get("detection_name") or e.get("category")))
            or label
        )
        for e, label in zip(extra, truth.labels)
    ]
    return FrameLabels.of(frame.name, frame.stamp_ns, truth.boxes, classes, ids, scores, extra, truth.notes)


def _to_integers(ids: np.ndarray) -> np.ndarray:
    with np.errstate(invalid="ignore"):
        integers = ids.astype(np.int64)
    if (integers != ids).any():
        raise ValueError("a track id is not an integer, or too large")
    return integers


def to_ground_truth(labels: FrameLabels) -> GroundTruth:
    """Convert labels to GroundTruth. Unknown classes become Misc, with their name in extras."""
    extras = []
    for k, (name, extra) in enumerate(zip(labels.class_names, labels.extra)):
        class_name = {} if name in CLASSES else {"class_name": name}
        extras.append({**extra, **class_name, **get_id_and_score(labels, k)})
    return GroundTruth.of(labels.boxes, find_class_ids(labels.class_names), extras, labels.notes)


def get_id_and_score(labels: FrameLabels, k: int) -> dict[str, Any]:
    """Return a dict with the track_id and score of box k, without missing values."""
    fields: dict[str, Any] = {}
    if labels.track_ids[k] != NO_TRACK:
        fields["track_id"] = int(labels.track_ids[k])
    if np.isfinite(labels.scores[k]):
        fields["score"] = float(labels.scores[k])
    return fields


def is_unchanged(box: Sequence[float] | np.ndarray, original: Sequence[float] | np.ndarray) -> bool:
    """Return True if a box (7,) equals the box in the file, so that its other fields are still valid."""
    difference = np.subtract(box, original)
    difference[6] = wrap_angle(difference[6])
    return bool(np.abs(difference).max() < MAX_DIFFERENCE)
