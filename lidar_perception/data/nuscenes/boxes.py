"""Boxes in nuScenes' global frame, with velocity and attribute.

Caesar et al., CVPR 2020. The global frame is that of a city's map: x east, y north, z up, metres.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from lidar_perception.types import MAX_NUMBER

# The ten classes of the detection task.
NAMES = (
    "car",
    "truck",
    "bus",
    "trailer",
    "construction_vehicle",
    "pedestrian",
    "motorcycle",
    "bicycle",
    "traffic_cone",
    "barrier",
)
# Category of a label -> class; other categories, such as animals, have no class.
CATEGORIES = {
    "vehicle.car": "car",
    "vehicle.truck": "truck",
    "vehicle.bus.bendy": "bus",
    "vehicle.bus.rigid": "bus",
    "vehicle.trailer": "trailer",
    "vehicle.construction": "construction_vehicle",
    "human.pedestrian.adult": "pedestrian",
    "human.pedestrian.child": "pedestrian",
    "human.pedestrian.construction_worker": "pedestrian",
    "human.pedestrian.police_officer": "pedestrian",
    "vehicle.motorcycle": "motorcycle",
    "vehicle.bicycle": "bicycle",
    "movable_object.trafficcone": "traffic_cone",
    "movable_object.barrier": "barrier",
}
ATTRIBUTES = (
    "pedestrian.moving",
    "pedestrian.sitting_lying_down",
    "pedestrian.standing",
    "cycle.with_rider",
    "cycle.without_rider",
    "vehicle.moving",
    "vehicle.parked",
    "vehicle.stopped",
)
WITH_RIDER = ATTRIBUTES.index("cycle.with_rider")


@dataclass(frozen=True)
class GlobalBoxes:
    """K boxes in the global frame; float64 unless stated otherwise.

    Attributes:
        centres: (K, 3) metres.
        sizes: (K, 3) [l w h] metres.
        rotations: (K, 4) quaternions [w x y z].
        class_ids: (K,) int indices into NAMES, -1 = another class.
        attributes: (K,) int indices into ATTRIBUTES, -1 = none.
        velocities: (K, 2) m/s, NaN = unknown.
        scores: (K,), 0 for labels.
        points: (K,) int, number of LiDAR and radar returns in the box, -1 = not counted, as for
            detections.
    """

    centres: np.ndarray
    sizes: np.ndarray
    rotations: np.ndarray
    class_ids: np.ndarray
    attributes: np.ndarray
    velocities: np.ndarray
    scores: np.ndarray
    points: np.ndarray

    @staticmethod
    def of(
        centres, sizes, rotations, class_ids, attributes=-1, velocities=np.nan, scores=0.0, points=-1
    ) -> GlobalBoxes:
        """Make boxes and convert dtypes and shapes; columns with a default may be scalars."""
        centres = np.asarray(centres, np.float64).reshape(-1, 3)
        count = len(centres)

        def make_column(values, dtype, *shape):
            return np.broadcast_to(np.asarray(values, dtype), (count, *shape)).copy()

        return GlobalBoxes(
            centres,
            np.asarray(sizes, np.float64).reshape(count, 3),
            np.asarray(rotations, np.float64).reshape(count, 4),
            make_column(class_ids, np.int32),
            make_column(attributes, np.int32),
            make_column(velocities, np.float64, 2),
            make_column(scores, np.float64),
            make_column(points, np.int32),
        )

    @staticmethod
    def none() -> GlobalBoxes:
        return GlobalBoxes.of((), (), (), ())

    @staticmethod
    def concatenate(parts: list[GlobalBoxes]) -> GlobalBoxes:
        parts = parts or [GlobalBoxes.none()]
        return GlobalBoxes(
            *(
                np.concatenate([getattr(part, field.name) for part in parts])
                for field in dataclasses.fields(GlobalBoxes)
            )
        )

    def __len__(self) -> int:
        return len(self.centres)

    def __getitem__(self, index) -> GlobalBoxes:
        """Return the boxes selected by a mask, slice or index array."""
        return GlobalBoxes(*(getattr(self, field.name)[index] for field in dataclasses.fields(self)))

    @property
    def yaws(self) -> np.ndarray:
        """Yaw angles (K,) of the boxes in the x-y plane, in radians."""
        forward = to_matrices(self.rotations)[:, :, 0]
        return np.arctan2(forward[:, 1], forward[:, 0])


def are_valid_rotations(rotations: np.ndarray) -> np.ndarray:
    """Return (K,) bool: True for quaternions (K, 4) that to_matrices accepts."""
    with np.errstate(over="ignore"):
        length = np.linalg.norm(rotations, axis=1)
    return (length > 0) & (length <= MAX_NUMBER)


def to_matrices(rotations: np.ndarray) -> np.ndarray:
    """Convert quaternions (K, 4) [w x y z] of any length above 0 to matrices (K, 3, 3)."""
    if len(rotations) == 0:
        return np.zeros((0, 3, 3))
    return Rotation.from_quat(np.roll(rotations, -1, axis=-1)).as_matrix()


def to_quaternions(rotations: np.ndarray) -> np.ndarray:
    """Convert rotation matrices (K, 3, 3) to quaternions (K, 4) [w x y z]."""
    if len(rotations) == 0:
        return np.zeros((0, 4))
    return np.roll(Rotation.from_matrix(rotations).as_quat(), 1, axis=-1)


def to_local_boxes(boxes: GlobalBoxes, pose: np.ndarray) -> np.ndarray:
    """Transform boxes to the frame with this pose (4, 4) in the global frame.

    Boxes that are tilted in that frame, for example on a slope, become upright.

    Returns:
        (K, 7) float64 [x y z l w h yaw].
    """
    rotation, origin = pose[:3, :3], pose[:3, 3]
    forward = to_matrices(boxes.rotations)[:, :, 0] @ rotation
    yaws = np.arctan2(forward[:, 1], forward[:, 0])
    return np.column_stack([(boxes.centres - origin) @ rotation, boxes.sizes, yaws])


def are_tilted(boxes: GlobalBoxes, pose: np.ndarray) -> np.ndarray:
    """Return (K,) bool: True for boxes that are tilted, which to_local_boxes makes upright."""
    upright_rotations = to_global_boxes(to_local_boxes(boxes, pose), pose)[2]
    alignment = np.abs((upright_rotations * boxes.rotations).sum(axis=1))
    return alignment < (1 - 1e-12) * np.linalg.norm(boxes.rotations, axis=1)


def to_global_boxes(boxes: np.ndarray, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Transform boxes (K, 7) to the global frame, the inverse of to_local_boxes.

    Returns:
        Centres (K, 3), sizes (K, 3) and rotations (K, 4).
    """
    boxes = np.asarray(boxes, np.float64).reshape(-1, 7)
    yaw, zero = boxes[:, 6], np.zeros(len(boxes))
    cos, sin = np.cos(yaw), np.sin(yaw)
    yaw_rotations = np.stack([cos, -sin, zero, sin, cos, zero, zero, zero, zero + 1], axis=1)
    return (
        boxes[:, :3] @ pose[:3, :3].T + pose[:3, 3],
        boxes[:, 3:6].copy(),
        to_quaternions(pose[:3, :3] @ yaw_rotations.reshape(-1, 3, 3)),
    )
