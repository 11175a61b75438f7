"""Labels and detections in the form that KITTI's benchmark uses."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from lidar_perception.camera import Calibration
from lidar_perception.data.kitti.labels import to_labels
from lidar_perception.data.kitti.write import project_boxes
from lidar_perception.geometry import wrap_angle
from lidar_perception.types import Detections, GroundTruth, InputError, find_class_ids

NO_ANGLE = -10.0  # KITTI's value for an unknown alpha
# Minimum truncation level of ignored objects. Levels of the tracking layout: 0 inside the image, 1 at its
# border, 2 at the ends of tracks; of the raw layout: 2 outside the image, 99 behind the camera.
IGNORED_LEVEL = 2


@dataclass(frozen=True)
class CameraObjects:
    """K objects of one frame, upright in the camera's frame.

    Attributes:
        class_ids: (K,) int32, indices into CLASSES.
        boxes: (K, 7) float64 [x y z l w h yaw], metres and radians, in the camera's frame rotated
            to x forward, y left, z up, or in the LiDAR frame without a calibration. Sizes are 0 for
            objects with a 2D box only.
        image_boxes: (K, 4) float64 [left top right bottom] pixels; 0 for objects outside the image,
            infinite without a calibration.
        alpha: (K,) observation angle, radians, NaN if unknown.
        truncated: (K,) truncated fraction 0..1.
        occluded: (K,) int, KITTI's occlusion level 0..3.
        scores: (K,) float64, 1 for labels.
        regions: (R, 4) 2D boxes of DontCare regions.
    """

    class_ids: np.ndarray
    boxes: np.ndarray
    image_boxes: np.ndarray
    alpha: np.ndarray
    truncated: np.ndarray
    occluded: np.ndarray
    scores: np.ndarray
    regions: np.ndarray

    def __len__(self) -> int:
        return len(self.class_ids)

    @property
    def pixels_high(self) -> np.ndarray:
        """Height (K,) float64 of the 2D boxes, pixels."""
        return self.image_boxes[:, 3] - self.image_boxes[:, 1]

    def take(self, indices: np.ndarray) -> CameraObjects:
        """Return the objects at indices (M,), with all regions."""
        return CameraObjects(
            **{f.name: getattr(self, f.name).take(indices, axis=0) for f in fields(self) if f.name != "regions"},
            regions=self.regions,
        )

    @staticmethod
    def concatenate(parts: list[CameraObjects]) -> CameraObjects:
        """Concatenate the objects of several frames."""
        return CameraObjects(
            *(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(CameraObjects))
        )


def to_scored_labels(detections: Detections) -> GroundTruth:
    """Convert detections to labels with a score."""
    return GroundTruth.of(
        detections.boxes, detections.class_ids, [{"score": float(score)} for score in detections.scores]
    )


def to_camera_objects(objects: GroundTruth, calibration: Calibration | None) -> CameraObjects:
    """Convert labels, or detections with a score in extras, to CameraObjects.

    Values of the label file are kept. A missing 2D box or alpha is computed from the 3D box. If the
    file has a truncation level instead of a fraction (tracking and raw layouts), truncation is the
    fraction of the projected box outside the image. Labels with a 2D box only (notes) come last.

    Raises:
        InputError: A box or score is not finite.
    """
    scores = np.array([extra.get("score", 1.0) for extra in _list_extras(objects)])
    not_finite = ~np.isfinite(scores)
    not_finite[: len(objects)] |= ~np.isfinite(objects.boxes).all(axis=1)
    if not_finite.any():
        raise InputError(
            f"box {np.argmax(not_finite) + 1} of {len(not_finite)} has a value or score that is not finite; "
            "fix the detector or the result file"
        )
    if calibration is None:
        return _make_objects_without_camera(objects, scores[: len(objects)])
    labels = to_labels(objects, calibration.lidar_to_camera)
    projected_boxes, outside_fractions = np.zeros((len(labels), 4)), np.zeros(len(labels))
    pixels, outside_fractions[: len(objects)] = project_boxes(objects.boxes, calibration)
    projected_boxes[: len(objects)] = np.nan_to_num(pixels)

    label_boxes = _read_columns(labels, "bbox", 4)
    has_pixels = (label_boxes[:, 2:] > label_boxes[:, :2]).all(axis=1, keepdims=True)
    sizes = np.maximum(_read_columns(labels, "dimensions", 3), 0)
    location, rotation_y = _read_columns(labels, "location", 3), _read_columns(labels, "rotation_y")
    alpha = _read_columns(labels, "alpha")
    is_3d = sizes.all(axis=1)  # True for labels with a 3D box
    bearing = np.arctan2(location[:, 0], location[:, 2])
    computed_alpha = np.where(is_3d, wrap_angle(rotation_y - bearing), np.nan)
    return CameraObjects(
        class_ids=np.array(find_class_ids(label["class"] for label in labels), np.int32),
        boxes=np.column_stack(
            [
                location[:, 2],
                -location[:, 0],
                sizes[:, 0] / 2 - location[:, 1],
                sizes[:, [2, 1, 0]],
                -rotation_y - np.pi / 2,
            ]
        ),
        image_boxes=np.where(has_pixels, label_boxes, projected_boxes),
        alpha=np.where(alpha > NO_ANGLE, alpha, computed_alpha),
        truncated=np.array([_compute_truncation(e, o) for e, o in zip(_list_extras(objects), outside_fractions)]),
        occluded=_read_columns(labels, "occluded").astype(int),
        scores=scores,
        regions=label_boxes[np.array([label["class"] == "DontCare" for label in labels], bool)],
    )


def select_in_image(truth: GroundTruth, calibration: Calibration | None) -> GroundTruth:
    """Return the labels that are at least partly in the image, or all labels without a calibration."""
    return truth.take(to_camera_objects(truth, calibration).pixels_high[: len(truth)] > 0)


def _make_objects_without_camera(objects: GroundTruth, scores: np.ndarray) -> CameraObjects:
    count = len(objects)
    return CameraObjects(
        objects.class_ids,
        objects.boxes,
        np.tile([-np.inf, -np.inf, np.inf, np.inf], (count, 1)),
        np.full(count, np.nan),
        np.zeros(count),
        np.array([extra.get("occluded", 0) for extra in objects.extras], int),
        scores,
        np.zeros((0, 4)),
    )


def _list_extras(objects: GroundTruth) -> list[dict]:
    return [*objects.extras, *(extra for _, extra in objects.notes)]


def _compute_truncation(extra: dict, outside_fraction: float) -> float:
    if "track_id" not in extra and "truncated" in extra:
        return extra["truncated"]
    return 1.0 if extra.get("truncated", 0) >= IGNORED_LEVEL else outside_fraction


def _read_columns(labels: list[dict], name: str, count: int = 0) -> np.ndarray:
    values = np.array([label[name] for label in labels])
    return values.reshape(-1, count) if count else values
