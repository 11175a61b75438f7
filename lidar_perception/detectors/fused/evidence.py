"""What each source says of every proposal: PointPillars itself, the silhouettes of the clusters
there, and the cluster network, which judges the points in the box.

Everything is in the frame of a level sensor at SENSOR_HEIGHT. Clusters where PointPillars proposes
nothing, even at the least score, are not looked at: they added nothing to what is found, on
simulated scans or real ones.
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

HEIGHTS, LENGTH = (0.8, 2.6), 2.8  # metres, of clusters that may be a person or a cyclist
SAME_PLACE = 0.6            # metres from the centre of a proposal to that of a cluster, at most
LEAST, MOST = 0.001, 0.999  # probabilities: no source is certain

# By source, the log-odds (K,) float64 that each of K proposals is what it is proposed as; NaN where
# the source is silent.
Evidence = dict[str, np.ndarray]


def silhouette_at(boxes: np.ndarray, xyz: np.ndarray, ground: np.ndarray,
                  cluster_ids: np.ndarray) -> np.ndarray:
    """(K,) float64: the greatest confidence that a cluster at boxes (K, 7) is a pedestrian, 0 where
    there is none that may be. xyz (N, 3): what is not ground, with cluster_ids (N,), 1..J for
    people; ground (G, 3): the rest."""
    found = snap_to_ground(fit_boxes(xyz, cluster_ids, BEST.boxes.shape), fit_plane(ground))
    chosen = np.flatnonzero((found[:, 5] >= HEIGHTS[0]) & (found[:, 5] <= HEIGHTS[1])
                            & (found[:, 3:5].max(axis=1, initial=0.0) <= LENGTH))
    near = centre_distances(boxes, found[chosen]) <= SAME_PLACE
    asked = near.any(axis=0)
    chosen, near = chosen[asked], near[:, asked]
    own, start = group_points(xyz, cluster_ids, chosen + 1)
    confidences = compute_confidence(compute_shape_features(own, start, found[chosen], BEST))
    return (near * confidences).max(axis=1, initial=0.0)


def clipped_logit(probabilities: np.ndarray) -> np.ndarray:
    """(K,) float64; NaN stays."""
    return logit(np.clip(np.asarray(probabilities, np.float64), LEAST, MOST))
