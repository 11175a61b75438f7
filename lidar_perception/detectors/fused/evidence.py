"""Evidence for each proposal: PointPillars' score, the silhouettes of clusters near its centre, and
the classification of its points by PointNet.

All coordinates are those of a level sensor at SENSOR_HEIGHT. Clusters without a proposal are
ignored: they did not improve the detections on simulated or real scans.
"""

from __future__ import annotations

import numpy as np
from scipy.special import logit

from lidar_perception.candidates.boxes import snap_to_ground
from lidar_perception.candidates.confidence import compute_confidence, compute_shape_features
from lidar_perception.candidates.configurations import BEST
from lidar_perception.clustering.shapes import fit_boxes
from lidar_perception.geometry import centre_distances
from lidar_perception.ground.threshold import fit_plane
from lidar_perception.groups import group_points

# Size of clusters that may be a person or a cyclist.
MIN_HEIGHT_M, MAX_HEIGHT_M, MAX_LENGTH_M = 0.8, 2.6, 2.8
MAX_DISTANCE_M = 0.6  # between the centres of a proposal and of its cluster
MIN_PROBABILITY, MAX_PROBABILITY = 0.001, 0.999  # no source is certain

# By source, the log-odds (K,) float64 that each of K proposals has the proposed class; NaN where
# the source gives no evidence.
Evidence = dict[str, np.ndarray]


def find_silhouette_confidence(boxes: np.ndarray, xyz: np.ndarray, ground: np.ndarray,
                               cluster_ids: np.ndarray) -> np.ndarray:
    """Return the highest confidence that a cluster near each box is a pedestrian.

    Args:
        boxes: (K, 7) proposals.
        xyz: (N, 3) points that are not ground.
        ground: (G, 3) ground points.
        cluster_ids: (N,) cluster ids 1..J, 0 for no cluster; clustered with the parameters for
            people.

    Returns:
        (K,) float64, 0..1; 0 for boxes without a cluster of a suitable size.
    """
    clusters = snap_to_ground(fit_boxes(xyz, cluster_ids, BEST.boxes.shape), fit_plane(ground))
    chosen = np.flatnonzero((clusters[:, 5] >= MIN_HEIGHT_M) & (clusters[:, 5] <= MAX_HEIGHT_M)
                            & (clusters[:, 3:5].max(axis=1, initial=0.0) <= MAX_LENGTH_M))
    is_near = centre_distances(boxes, clusters[chosen]) <= MAX_DISTANCE_M
    has_box = is_near.any(axis=0)
    chosen, is_near = chosen[has_box], is_near[:, has_box]
    points, start = group_points(xyz, cluster_ids, chosen + 1)
    confidences = compute_confidence(compute_shape_features(points, start, clusters[chosen], BEST))
    return (is_near * confidences).max(axis=1, initial=0.0)


def to_log_odds(probabilities: np.ndarray) -> np.ndarray:
    """Return log-odds (K,) float64 of clipped probabilities (K,); NaN remains NaN."""
    return logit(np.clip(np.asarray(probabilities, np.float64), MIN_PROBABILITY, MAX_PROBABILITY))
