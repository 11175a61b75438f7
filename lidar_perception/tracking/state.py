"""State of the tracks, with one array per quantity, and the tracks as they are published."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from lidar_perception.types import CLASSES, Detections


@dataclass(frozen=True)
class States:
    """State of N tracks in the fixed frame, oldest track first.

    Attributes:
        ids: (N,) int64 track ids.
        means: (N, 6) filter state, see motion.py.
        covariances: (N, 6, 6) covariance of the filter state.
        heights: (N,) z of the centre, metres.
        height_variances: (N,) variance of z, m^2.
        sizes: (N, 3) weighted mean of length, width and height, metres.
        size_weights: (N,) weight of that mean.
        class_evidence: (N, len(CLASSES)) sum of the scores by class.
        class_ids: (N,) int32 indices into CLASSES.
        evidence: (N,) sum of the evidence, see existence.py.
        observations: (N,) number of observations, see existence.py.
        presence: (N,) log odds of presence.
        hits: (N,) number of hits, with exponential decay.
        tries: (N,) number of frames, with exponential decay.
        moving: (N,) probability of motion.
        ages: (N,) seconds since the first detection.
        unseen_s: (N,) seconds since the last hit.
        heading_agreement: (N,) sum of the scores of measured headings that agree with the state,
            minus the sum of those that oppose it, with exponential decay.
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
    evidence: np.ndarray
    observations: np.ndarray
    presence: np.ndarray
    hits: np.ndarray
    tries: np.ndarray
    moving: np.ndarray
    ages: np.ndarray
    unseen_s: np.ndarray
    heading_agreement: np.ndarray

    def __len__(self) -> int:
        return len(self.ids)

    def take(self, indices: np.ndarray) -> States:
        """Return the states at indices (M,)."""
        return States(*(getattr(self, f.name)[indices] for f in fields(self)))

    def copy(self) -> States:
        """Return a copy with its own arrays."""
        return States(*(getattr(self, f.name).copy() for f in fields(self)))

    def concatenate(self, others: States) -> States:
        """Return these states followed by `others`."""
        return States(*(np.concatenate([getattr(self, f.name), getattr(others, f.name)]) for f in fields(self)))

    @staticmethod
    def none() -> States:
        """Return the states of no tracks, with empty arrays."""
        shapes = {"means": (6,), "covariances": (6, 6), "sizes": (3,), "class_evidence": (len(CLASSES),)}
        dtypes = {"ids": np.int64, "class_ids": np.int32}
        return States(*(np.zeros((0, *shapes.get(f.name, ())), dtypes.get(f.name, np.float64)) for f in fields(States)))

    def to_boxes(self) -> np.ndarray:
        """Return the boxes (N, 7) float64 [x y z l w h yaw]."""
        return np.column_stack([self.means[:, :2], self.heights, self.sizes, self.means[:, 4]])


@dataclass(frozen=True)
class Tracks:
    """K tracks of one frame in the sensor's frame; K may be 0.

    Attributes:
        ids: (K,) int64, starting at 1 and never reused.
        detections: Boxes and classes; a score is the probability that the object is real, of its
            class, and present.
        velocities: (K, 2) m/s over ground along the sensor's x and y axes; without poses, relative
            to the sensor.
        moving: (K,) probability of motion, 0..1.
        covariances: (K, 6, 6) of [x y vx vy heading turn_rate]. The heading of pedestrians that do not
            walk, or of all pedestrians without poses, is unknown: its variance is pi^2 / 3.
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
        """Return the pose covariances (K, 6, 6) float64 as in geometry_msgs/PoseWithCovariance.

        The order is x, y, z, roll, pitch, yaw; the entries of roll and pitch are 0.
        """
        result = np.zeros((len(self), 6, 6))
        rows, columns = np.array([0, 1, 5]), np.array([0, 1, 4])  # rows of x, y and yaw
        result[:, rows[:, None], rows] = self.covariances[:, columns[:, None], columns]
        result[:, 2, 2] = self.height_variances
        return result
