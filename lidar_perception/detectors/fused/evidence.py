"""Evidence for proposals, and its combination into a probability.

There are three sources: PointPillars' score, the silhouettes of clusters near the proposal's
centre, and PointNet's classification of its points. Coordinates are those of a level sensor at
SENSOR_HEIGHT. Clusters without a proposal are ignored because using them did not improve the
detections.

The log-odds of a class are the sum of one curve per source. The sources are not independent, so
simply adding their log-odds would be overconfident. The curves are therefore fitted jointly, on
simulated scans outside the training sets, which makes the result a calibrated probability.
"""

from __future__ import annotations

import numpy as np
from scipy.special import expit, logit

from lidar_perception.candidates.confidence import compute_confidence, compute_log_odds, compute_shape_features
from lidar_perception.candidates.configurations import BEST
from lidar_perception.candidates.segmented_cloud import is_person_sized, snap_to_ground
from lidar_perception.clustering.shapes import fit_boxes
from lidar_perception.detectors.fused.fusion import Models
from lidar_perception.geometry import centre_distances
from lidar_perception.ground.threshold import fit_plane
from lidar_perception.groups import group_points
from lidar_perception.types import CLASSES

MAX_DISTANCE_M = 0.6  # maximum distance between the centres of a proposal and its cluster
MIN_PROBABILITY, MAX_PROBABILITY = 0.001, 0.999  # each source's probability is clipped to this interval

# Source -> log-odds (K,) float64 that each of K proposals is an object of the proposed class; NaN
# where the source provides no evidence.
Evidence = dict[str, np.ndarray]


def fit_people(xyz: np.ndarray, ground: np.ndarray, cluster_ids: np.ndarray) -> np.ndarray:
    """Fit boxes (J, 7) to clusters of people and extend them down to the ground.

    Args:
        xyz: (N, 3) points that are not ground.
        ground: (G, 3) ground points.
        cluster_ids: (N,) 1..J, 0 for no cluster, computed with the parameters for people.
    """
    return snap_to_ground(fit_boxes(xyz, cluster_ids, BEST.boxes.shape), fit_plane(ground))


def find_silhouette_confidence(
    boxes: np.ndarray, xyz: np.ndarray, cluster_ids: np.ndarray, clusters: np.ndarray
) -> np.ndarray:
    """Return, for each box, the highest confidence that a nearby cluster is a pedestrian.

    Args:
        boxes: (K, 7) proposals.
        xyz, cluster_ids: as in fit_people().
        clusters: (J, 7) its result.

    Returns:
        (K,) float64, 0..1; 0 for boxes without a cluster of a suitable size.
    """
    indices = np.flatnonzero(is_person_sized(clusters))
    is_near = centre_distances(boxes, clusters[indices]) <= MAX_DISTANCE_M
    has_box = is_near.any(axis=0)
    indices, is_near = indices[has_box], is_near[:, has_box]
    points, start = group_points(xyz, cluster_ids, indices + 1)
    confidences = compute_confidence(compute_shape_features(points, start, clusters[indices], BEST))
    return (is_near * confidences).max(axis=1, initial=0.0)


def to_log_odds(probabilities: np.ndarray) -> np.ndarray:
    """Clip probabilities (K,) and convert them to log-odds (K,) float64; NaN remains NaN."""
    return logit(np.clip(np.asarray(probabilities, np.float64), MIN_PROBABILITY, MAX_PROBABILITY))


def compute_probabilities(models: Models, class_ids: np.ndarray, evidence: Evidence) -> np.ndarray:
    """Return the probability (K,) float32 that each proposal is an object of the proposed class.

    Args:
        class_ids: (K,) indices into CLASSES; a class without a model gets 0.
    """
    result = np.zeros(len(class_ids), np.float32)
    for class_id in np.unique(class_ids):
        is_in_class = class_ids == class_id
        if CLASSES[class_id] in models:
            result[is_in_class] = expit(
                compute_log_odds(
                    models[CLASSES[class_id]], {source: odds[is_in_class] for source, odds in evidence.items()}
                )
            )
    return result


def compute_max_probabilities(models: Models, class_ids: np.ndarray, evidence: Evidence, source: str) -> np.ndarray:
    """Return upper bounds (K,) float32 of the probabilities over all possible evidence of `source`.

    A curve is piecewise linear and constant beyond its knots, so its maximum is at a knot or is the
    value for missing evidence.
    """
    best_evidence = np.full(len(class_ids), np.nan)
    for class_id in np.unique(class_ids):
        curve = models.get(CLASSES[class_id], {"curves": {}})["curves"].get(source)
        if curve is not None and max(curve["values"]) > curve.get("unknown", 0.0):
            best_evidence[class_ids == class_id] = curve["knots"][int(np.argmax(curve["values"]))]
    return compute_probabilities(models, class_ids, {**evidence, source: best_evidence})


def compute_source_probabilities(models: Models, class_ids: np.ndarray, evidence: Evidence) -> dict[str, np.ndarray]:
    """Return, by source, the probability (K,) float32 of each proposal according to this source alone.

    It is NaN where the source provides no evidence or the model of the class does not use it.
    """
    class_ids_by_source = {
        source: [i for i, name in enumerate(CLASSES) if source in models.get(name, {"curves": {}})["curves"]]
        for source in evidence
    }
    return {
        source: np.where(np.isin(class_ids, class_ids_by_source[source]), expit(odds), np.nan).astype(np.float32)
        for source, odds in evidence.items()
    }
