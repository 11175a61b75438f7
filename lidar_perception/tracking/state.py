"""What is known of N tracks: one array for each quantity, in the order of birth."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from lidar_perception.types import CLASSES, Detections


@dataclass(frozen=True)
class States:
    """Of N tracks, in the fixed frame.

    ids (N,) int64; means (N, 6), covariances (N, 6, 6) as in motion.py; heights (N,) z of the
    centre and height_variances (N,); sizes (N, 3) l w h, means with size_weights (N,);
    class_evidence (N, CLASSES) and class_ids (N,) int32; total, looks (N,) as in
    existence.py; present (N,) log odds of being there; hits, tries (N,); moving (N,) probability;
    ages (N,) seconds since birth; unseen (N,) seconds since the last hit; facing (N,) scores of
    measured headings that agree with that of means less those opposite to it, faded by each.
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
    looks: np.ndarray
    present: np.ndarray
    hits: np.ndarray
    tries: np.ndarray
    moving: np.ndarray
    ages: np.ndarray
    unseen: np.ndarray
    facing: np.ndarray

    def __len__(self) -> int:
        return len(self.ids)

    def take(self, indices: np.ndarray) -> States:
        """The tracks at indices (M,)."""
        return States(*(getattr(self, f.name)[indices] for f in fields(self)))

    def copy(self) -> States:
        """With arrays of its own."""
        return States(*(getattr(self, f.name).copy() for f in fields(self)))

    def followed_by(self, others: States) -> States:
        """These and then the others."""
        return States(*(np.concatenate([getattr(self, f.name), getattr(others, f.name)])
                        for f in fields(self)))

    @staticmethod
    def none() -> States:
        """No track."""
        shapes = {"means": (6,), "covariances": (6, 6), "sizes": (3,),
                  "class_evidence": (len(CLASSES),)}
        kinds = {"ids": np.int64, "class_ids": np.int32}
        return States(*(np.zeros((0, *shapes.get(f.name, ())), kinds.get(f.name, np.float64))
                        for f in fields(States)))

    def boxes(self) -> np.ndarray:
        """(N, 7) float64 [x y z l w h yaw]."""
        return np.column_stack([self.means[:, :2], self.heights, self.sizes, self.means[:, 4]])


@dataclass(frozen=True)
class Tracks:
    """K tracks of one frame, in the sensor's frame; none is K = 0.

    ids (K,) int64 from 1, never given twice; detections: their boxes, classes, and as scores the
    probability that they are what they are said to be, and there. velocities (K, 2) m/s over the
    ground along the sensor's x and y (relative to the sensor where there were no poses), moving
    (K,) 0..1 the probability of motion. covariances (K, 6, 6) of [x y vx vy heading turn],
    turn_rates (K,) rad/s, height_variances (K,) m^2 of z. seen (K,) bool: hit in this frame, else
    predicted; ages (K,) seconds.
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

    def pose_covariances(self) -> np.ndarray:
        """(K, 6, 6) float64 of x y z and the turns about them, as geometry_msgs has it; a box
        turns about z alone."""
        found = np.zeros((len(self), 6, 6))
        flat, heading = [0, 1, 5], [0, 1, 4]  # x y and the turn about z; there, and in covariances
        found[:, np.array(flat)[:, None], flat] = self.covariances[:, np.array(heading)[:, None],
                                                                   heading]
        found[:, 2, 2] = self.height_variances
        return found
