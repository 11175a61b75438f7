"""Shared types: point clouds, detections and ground truth; errors and their messages.

Coordinates follow REP-103 (x forward, y left, z up; metres, radians); boxes are [x y z l w h yaw]
with the centre in x y z.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lidar_perception.classes import CLASSES, PEDESTRIAN, find_class_name
from lidar_perception.intensity import to_unit

__all__ = [
    "CLASSES",
    "PEDESTRIAN",
    "Detections",
    "GroundTruth",
    "InputError",
    "InputWarning",
    "PointCloud",
    "are_usable_returns",
]

MAX_RANGE = 1e5  # metres; points beyond this range are invalid returns
MIN_NAME_SIMILARITY = 0.6  # minimum similarity of a misspelt name to the right one, 0..1 as in difflib
MIN_PREFIX = 3  # number of first characters that a misspelt name must share with the right one
MAX_NUMBER = 1e9  # larger numbers in labels are considered corrupt
SENSOR_HEIGHT = 1.73  # height of KITTI's sensor above the road in metres; default of anchors and simulation
EMPTY_CLOUD = "the cloud is empty, has no finite point, or crop.* removes all of its points"


class InputError(ValueError):
    """Invalid input. The message is one line with the problem and the remedy."""


class RunError(InputError):
    """An error that ends a run over many frames; any other InputError skips only its frame."""


class InputWarning(UserWarning):
    """A problem in input that can still be used. The message is one line."""


def find_closest_name(name: object, valid_names: Iterable[str]) -> str | None:
    """Return the valid name that is closest to a misspelt or shortened one, or None.

    Names that begin with `name` are preferred, then names with a similar spelling, then names with
    the same first characters.
    """
    target, by_spelling = _normalise(str(name)), {_normalise(n): n for n in valid_names}
    same_prefix = [n for n in by_spelling if n[:MIN_PREFIX] == target[:MIN_PREFIX]]
    matches = (
        [n for n in same_prefix if n.startswith(target)]
        or get_close_matches(target, by_spelling, 1, MIN_NAME_SIMILARITY)
        or same_prefix
    )
    return by_spelling[matches[0]] if matches else None


def _normalise(name: str) -> str:
    return name.lower().replace("_", "-")


def make_unknown_name_error(noun: str, name: object, valid_names: Iterable[str]) -> InputError:
    """Return an error with the closest match and a list of all valid names.

    Args:
        noun: what the name stands for, such as "sensor".
        name: the unknown name.
        valid_names: all valid names.
    """
    return InputError(f"unknown {noun} {str(name)[:80]!r}{list_valid_names(name, valid_names)}")


def list_valid_names(name: object, valid_names: Iterable[str]) -> str:
    """Return the end of a message about an unknown name, with the closest match and all names."""
    valid_names = list(valid_names)
    suggestion = suggest_name(name, valid_names)
    names_text = ", ".join(valid_names)
    return f"{suggestion} Valid names: {names_text}" if suggestion else f"; valid names: {names_text}"


def suggest_name(name: object, valid_names: Iterable[str]) -> str:
    """Return "; did you mean 'X'?", or "" if no valid name is similar."""
    guess = find_closest_name(name, valid_names)
    return f"; did you mean {guess!r}?" if guess else ""


@dataclass(frozen=True)
class PointCloud:
    """The usable points (see are_usable_returns) of one cloud.

    Attributes:
        xyz: (N, 3) float32, C-contiguous, metres in frame_id.
        intensity: (N,) float32 0..1, or None.
        stamp_ns: time stamp in nanoseconds.
        frame_id: coordinate frame of the points.
    """

    xyz: np.ndarray
    intensity: np.ndarray | None = None
    stamp_ns: int = 0
    frame_id: str = ""

    def __post_init__(self) -> None:
        shape = np.shape(self.xyz)
        if len(shape) != 2 or shape[1] != 3:
            raise InputError(
                f"xyz of a PointCloud has shape {shape}, expected (N, 3); PointCloud.of accepts points (N, 3) or (N, 4)"
            )
        if self.intensity is not None and np.shape(self.intensity) != shape[:1]:
            raise InputError(
                f"intensity has shape {np.shape(self.intensity)} for {shape[0]} points, expected ({shape[0]},)"
            )

    @staticmethod
    def of(
        points: ArrayLike,
        intensity: ArrayLike | None = None,
        stamp_ns: int = 0,
        frame_id: str = "",
        intensity_max: float | None = None,
    ) -> PointCloud:
        """Make a cloud from the usable points (see are_usable_returns) of a sensor.

        Args:
            points: (N, 3) [x y z] or (N, 4) [x y z intensity] of any real type; metres, x forward,
                y left, z up; or an empty sequence.
            intensity: (N,) for points (N, 3). NaN, infinite and negative values become 0.
            intensity_max: intensity of a full reflection, by which all intensities are divided.
                None: 255 for uint8, otherwise 1. Detectors report an implausible scale.

        Raises:
            InputError: an array has a wrong shape or type.
        """
        cloud = as_point_cloud(points, intensity, stamp_ns, frame_id, intensity_max)
        is_usable = are_usable_returns(cloud.xyz)
        return cloud if is_usable.all() else cloud.take(np.flatnonzero(is_usable))

    def __len__(self) -> int:
        return len(self.xyz)

    def take(self, indices: np.ndarray) -> PointCloud:
        """Return a cloud with only the points at indices (M,)."""
        intensity = None if self.intensity is None else self.intensity.take(indices)
        return PointCloud(self.xyz.take(indices, axis=0), intensity, self.stamp_ns, self.frame_id)

    def points(self) -> np.ndarray:
        """Return (N, 4) float32 [x y z intensity]; the intensity is 0 if it is missing."""
        intensity = np.zeros(len(self), np.float32) if self.intensity is None else self.intensity
        return np.column_stack([self.xyz, intensity])


def as_point_cloud(
    cloud: PointCloud | ArrayLike,
    intensity: ArrayLike | None = None,
    stamp_ns: int = 0,
    frame_id: str = "",
    intensity_max: float | None = None,
) -> PointCloud:
    """Make a cloud from all points, including unusable ones; a PointCloud is returned unchanged.

    Arguments and errors are those of PointCloud.of.
    """
    if isinstance(cloud, PointCloud):
        if intensity is not None:
            raise InputError(
                "a PointCloud already has an intensity; pass either a PointCloud, or arrays with an intensity"
            )
        return cloud
    points = _to_numbers(
        cloud,
        "a cloud",
        "a PointCloud (frame.load() of a recorded frame, "
        "to_point_cloud of a PointCloud2) or numbers (N, 3) [x y z] or (N, 4) "
        "[x y z intensity]",
    )
    if points.shape == (0,):
        points = points.reshape(0, 3)
    if points.ndim != 2 or points.shape[1] not in (3, 4):
        shape, remedy = points.shape, ""
        if points.ndim == 2 and shape[0] in (3, 4):
            remedy = "; pass points.T"
        elif points.ndim == 2 and shape[1] > 4:
            remedy = "; pass points[:, :4]"
        raise InputError(f"a cloud has shape {shape}, expected (N, 3) [x y z] or (N, 4) [x y z intensity]{remedy}")
    if points.shape[1] == 4 and intensity is not None:
        raise InputError(
            "the intensity is given both as column 3 of points (N, 4) and as `intensity`; pass points[:, :3]"
        )
    if intensity_max is not None and not 0 < intensity_max < np.inf:
        raise InputError(f"intensity_max is {intensity_max:g}, but must be above 0: 1, 100 or 255 for most drivers")
    values = None if intensity is None else _to_numbers(intensity, "intensity", "(N,) numbers")
    if points.shape[1] == 4:
        values = points[:, 3]
    if values is not None:
        full_scale = intensity_max or (255.0 if values.dtype == np.uint8 else 1.0)
        values = to_unit(values, full_scale)
    with np.errstate(over="ignore"):  # float64 beyond float32 becomes inf, which is not usable
        xyz = np.ascontiguousarray(points[:, :3], np.float32)
    return PointCloud(xyz, values, stamp_ns, frame_id)


def _to_numbers(array: Any, noun: str, expected: str) -> np.ndarray:
    try:
        values = np.asarray(array)
    except (TypeError, ValueError, RuntimeError) as error:  # ragged lists, tensors on a GPU
        raise InputError(
            f"{noun} cannot be converted to an array ({str(error).splitlines()[0]}); expected {expected}"
        ) from None
    if values.dtype.kind not in "fiu":
        dtype_text = f" of {values.dtype.name}" if isinstance(array, np.ndarray) else ""
        raise InputError(f"{noun} has type {type(array).__name__}{dtype_text}; expected {expected}")
    return values


def check_columns(count: int, **columns: ArrayLike | None) -> None:
    """Raise InputError if a column does not have one value for each of `count` points."""
    for name, column in columns.items():
        if column is not None and np.shape(column) != (count,):
            size = np.size(column)
            actual = f"{size} values" if size != count else f"shape {np.shape(column)}"
            raise InputError(f"{name} has {actual} for {count} points, expected one value per point")


def are_usable_returns(xyz: np.ndarray) -> np.ndarray:
    """Return (N,) bool: True for points that are finite, within MAX_RANGE and not at the origin.

    Drivers report missing returns as points at the origin.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        squared_range = np.einsum("ij,ij->i", xyz, xyz)  # keeps NaN and inf
        return (squared_range > 0.0) & (squared_range <= MAX_RANGE * MAX_RANGE)


@dataclass(frozen=True)
class Detections:
    """K detected boxes; K = 0 without detections.

    Attributes:
        boxes: (K, 7) float32 [x y z l w h yaw].
        class_ids: (K,) int32 indices into CLASSES.
        scores: (K,) float32.
        sources: probabilities (K,) float32 from each part of the fused detector, by the name of the
            part; NaN for boxes that the part did not score. Empty for other detectors.
    """

    boxes: np.ndarray
    class_ids: np.ndarray
    scores: np.ndarray
    sources: Mapping[str, np.ndarray] = field(default_factory=dict)

    @staticmethod
    def of(boxes: ArrayLike, class_ids: ArrayLike = PEDESTRIAN, scores: ArrayLike = 1.0) -> Detections:
        """Make detections.

        Args:
            boxes: (K, 7) [x y z l w h yaw] of any real type, or (7,) for one box.
            class_ids: (K,) indices into CLASSES or names such as "Pedestrian", or one for all boxes.
            scores: (K,), or one for all boxes.

        Raises:
            InputError: an array has a wrong shape, or a class name is unknown.
        """
        rows = _to_numbers(boxes, "boxes", "numbers (K, 7) [x y z l w h yaw]")
        if rows.ndim > 2 or (rows.size and rows.shape[-1:] != (7,)):
            raise InputError(f"boxes have shape {rows.shape}, expected (K, 7) [x y z l w h yaw]")
        boxes = np.ascontiguousarray(rows, np.float32).reshape(-1, 7)
        count, columns = len(boxes), []
        for name, column in (("class_ids", _to_class_ids(class_ids)), ("scores", np.asarray(scores, np.float32))):
            if column.shape not in ((), (1,), (count,)):
                raise InputError(
                    f"{name} have shape {column.shape} for {count} boxes, expected ({count},) or one number"
                )
            columns.append(np.broadcast_to(column, count).copy())
        return Detections(boxes, columns[0], columns[1])

    @staticmethod
    def none() -> Detections:
        return Detections.of(np.zeros((0, 7)))

    def __len__(self) -> int:
        return len(self.boxes)

    @property
    def labels(self) -> list[str]:
        """Class names of the boxes."""
        return [CLASSES[i] for i in self.class_ids]

    def __getitem__(self, index: np.ndarray | slice) -> Detections:
        """Return the detections selected by a mask, slice or index array."""
        return Detections(
            self.boxes[index],
            self.class_ids[index],
            self.scores[index],
            {name: scores[index] for name, scores in self.sources.items()},
        )

    def concatenate(self, others: Detections) -> Detections:
        """Return these detections followed by the others, without sources."""
        return Detections(
            np.concatenate([self.boxes, others.boxes]),
            np.concatenate([self.class_ids, others.class_ids]),
            np.concatenate([self.scores, others.scores]),
        )


def _to_class_ids(ids_or_names: ArrayLike) -> np.ndarray:
    values = np.asarray(ids_or_names)
    if values.dtype.kind != "U":
        return np.asarray(ids_or_names, np.int32)
    for name in values.flat:
        if find_class_name(name) not in CLASSES:
            raise make_unknown_name_error("class", name, CLASSES)
    return np.array(find_class_ids(values.flat), np.int32).reshape(values.shape)


def find_class_ids(names: Iterable[str]) -> list[int]:
    """Return the indices into CLASSES of names in any spelling; unknown names become Misc."""
    class_names = map(find_class_name, names)
    return [CLASSES.index(name if name in CLASSES else "Misc") for name in class_names]


@dataclass(frozen=True)
class GroundTruth:
    """The K labelled objects of one frame, in the LiDAR frame.

    Attributes:
        boxes: (K, 7) float64 [x y z l w h yaw].
        class_ids: (K,) int indices into CLASSES.
        extras: K dicts of optional fields: track_id, truncated, occluded, alpha, bbox [left top
            right bottom] in pixels.
        notes: (class name, optional fields) of each object without a 3D box, such as KITTI's
            DontCare regions.
    """

    boxes: np.ndarray
    class_ids: np.ndarray
    extras: tuple[dict[str, Any], ...]
    notes: tuple[tuple[str, dict[str, Any]], ...] = ()

    @staticmethod
    def of(
        boxes: ArrayLike,
        class_ids: ArrayLike,
        extras: Iterable[dict[str, Any]] | None = None,
        notes: Iterable[tuple[str, dict[str, Any]]] = (),
    ) -> GroundTruth:
        boxes = np.asarray(boxes, np.float64).reshape(-1, 7)
        extras = tuple({} for _ in boxes) if extras is None else tuple(extras)
        return GroundTruth(boxes, np.asarray(class_ids, np.int32).reshape(len(boxes)), extras, tuple(notes))

    def __len__(self) -> int:
        return len(self.boxes)

    @property
    def labels(self) -> list[str]:
        return [CLASSES[i] for i in self.class_ids]

    def select_class(self, class_id: int) -> np.ndarray:
        """Return the boxes (M, 7) of one class."""
        return self.boxes[self.class_ids == class_id]

    def take(self, indices: np.ndarray) -> GroundTruth:
        """Return the objects with these indices or in this mask (K,) bool, and all notes."""
        indices = np.arange(len(self))[indices]
        extras = tuple(self.extras[i] for i in indices)
        return GroundTruth(self.boxes[indices], self.class_ids[indices], extras, self.notes)
