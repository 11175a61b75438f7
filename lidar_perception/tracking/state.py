"""State of N tracks as one array per quantity, oldest track first, and the published tracks."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from lidar_perception.types import CLASSES, Detections


@dataclass(frozen=True)
class States:
    """State of N tracks in the fixed frame.

    Attributes:
        ids: (N,) int64.
        means, covariances: (N, 6) and (N, 6, 6), see motion.py.
        heights, height_variances: (N,) z of the centre.
        sizes, size_weights: (N, 3) weighted mean of l w h, and (N,) its weight.
        class_evidence, class_ids: (N, CLASSES) sum of scores per class, and (N,) int32.
        total, observations: (N,) evidence and number of observations, see existence.py.
        present: (N,) log odds of presence.
        hits, tries: (N,) decayed counts.
        moving: (N,) probability of motion.
        ages: (N,) seconds since the first detection.
        unseen: (N,) seconds since the last hit.
        heading_agreement: (N,) decayed sum of the scores of measured headings that agree with the
            state's, less those of opposite ones.
    """

    ids: np.ndarray
    means: np.ndarray
    covariances: np.ndarray
    heights: np.ndarray
    height_variances: np.ndarray
    sizes: np.ndarray
    size_weights: np.ndarray
    class_evidence: np.ndarray
    class_ids: np.ndarray
    total: np.ndarray
    observations: np.ndarray
    present: np.ndarray
    hits: np.ndarray
    tries: np.ndarray
    moving: np.ndarray
    ages: np.ndarray
    unseen: np.ndarray
    heading_agreement: np.ndarray

    def __len__(self) -> int:
        return len(self.ids)

    def take(self, indices: np.ndarray) -> States:
        """Return the tracks at indices (M,)."""
        return States(*(getattr(self, f.name)[indices] for f in fields(self)))

    def copy(self) -> States:
        """Return a copy with its own arrays."""
        return States(*(getattr(self, f.name).copy() for f in fields(self)))

    def append(self, others: States) -> States:
        """Return these tracks followed by the others."""
        return States(*(np.concatenate([getattr(self, f.name), getattr(others, f.name)]) for f in fields(self)))

    @staticmethod
    def none() -> States:
        """Return the state without tracks."""
        shapes = {"means": (6,), "covariances": (6, 6), "sizes": (3,), "class_evidence": (len(CLASSES),)}
        kinds = {"ids": np.int64, "class_ids": np.int32}
        return States(*(np.zeros((0, *shapes.get(f.name, ())), kinds.get(f.name, np.float64)) for f in fields(States)))

    def to_boxes(self) -> np.ndarray:
        """Return the boxes (N, 7) float64 [x y z l w h yaw]."""
        return np.column_stack([self.means[:, :2], self.heights, self.sizes, self.means[:, 4]])


@dataclass(frozen=True)
class Tracks:
    """K tracks of one frame in the sensor's frame; K may be 0.

    Attributes:
        ids: (K,) int64 from 1, never reused.
        detections: boxes and classes; the score is the probability that the object is real, of its
            class, and present.
        velocities: (K, 2) m/s over ground along the sensor's x and y axes, or relative to the
            sensor if there are no poses.
        moving: (K,) probability of motion, 0..1.
        covariances: (K, 6, 6) of [x y vx vy heading turn].
        turn_rates: (K,) rad/s.
        height_variances: (K,) variance of z, m^2.
        seen: (K,) bool, False for tracks that are only predicted in this frame.
        ages: (K,) seconds since the first detection.
    """

    ids: np.ndarray
    detections: Detections
    velocities: np.ndarray
    moving: np.ndarray
    covariances: np.ndarray
    turn_rates: np.ndarray
    height_variances: np.ndarray
    seen: np.ndarray
    ages: np.ndarray

    def __len__(self) -> int:
        return len(self.ids)

    def to_pose_covariances(self) -> np.ndarray:
        """Return the covariances (K, 6, 6) float64 of x y z and the rotations about these axes.

        The layout is that of geometry_msgs/PoseWithCovariance; roll and pitch have none.
        """
        result = np.zeros((len(self), 6, 6))
        rows, source = np.array([0, 1, 5]), np.array([0, 1, 4])  # rows of x, y and yaw
        result[:, rows[:, None], rows] = self.covariances[:, source[:, None], source]
        result[:, 2, 2] = self.height_variances
        return result
