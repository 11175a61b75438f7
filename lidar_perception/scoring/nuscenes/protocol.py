"""Scores of nuScenes' detection task: average precision by centre distance, and errors of true positives.

The rules follow Caesar et al., CVPR 2020, Section 3.1, and the configuration detection_cvpr_2019 of
nuscenes-devkit. In descending order of score, each detection is matched with the nearest unmatched
object of its class and frame, if their distance in the ground plane is small enough. Average
precision is the area under the precision-recall curve above a recall and a precision of 0.1,
averaged over four distances. Errors are computed for hits within 2 m: the error at a recall is the
mean over all hits up to this recall, and the result is the mean over recalls above 0.1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from lidar_perception.data.nuscenes.boxes import NAMES, GlobalBoxes
from lidar_perception.geometry import points_in_box

# Maximum distance of scored boxes from the vehicle, metres.
RANGES = {
    "car": 50.0,
    "truck": 50.0,
    "bus": 50.0,
    "trailer": 50.0,
    "construction_vehicle": 50.0,
    "pedestrian": 40.0,
    "motorcycle": 40.0,
    "bicycle": 40.0,
    "traffic_cone": 30.0,
    "barrier": 30.0,
}
DISTANCES = (0.5, 1.0, 2.0, 4.0)  # maximum centre distances of a match, metres
ERROR_DISTANCE = 2.0  # centre distance of the matches used for the errors
RECALLS = np.linspace(0.0, 1.0, 101)
FIRST_RECALL_INDEX = 11  # index of the first recall above 0.1 in RECALLS
MIN_PRECISION = 0.1  # precision above which AP is computed
MAP_WEIGHT = 5  # weight of mAP in NDS; each of ERRORS has weight 1
RACK_CLASSES = ("bicycle", "motorcycle")  # classes that are ignored inside a bicycle rack

# Translation (m), scale (1 - IoU of the aligned boxes), orientation (rad), velocity (m/s), and attribute
# (1 - accuracy).
ERRORS = ("ate", "ase", "aoe", "ave", "aae")
UNDEFINED_ERRORS = {"traffic_cone": ("aoe", "ave", "aae"), "barrier": ("ave", "aae")}
SYMMETRIC_CLASSES = ("barrier",)  # classes whose front and rear are equivalent


def select_scored_boxes(boxes: GlobalBoxes, ego: np.ndarray, racks: GlobalBoxes) -> np.ndarray:
    """Return a mask (K,) of the labels or detections of one frame that are scored.

    A box is scored if its class is known, its distance from the vehicle is below the range of the
    class, it is not a label without points, and it is not a bicycle or motorcycle in a rack.

    Args:
        boxes: K labels or detections.
        ego: Position of the vehicle, (>=2,).
        racks: Bicycle racks.
    """
    ranges = np.array([RANGES[name] for name in NAMES] + [0.0])[boxes.class_ids]  # -1 selects the last entry
    distance = np.sqrt(((boxes.centres[:, :2] - ego[:2]) ** 2).sum(axis=1))
    is_counted = (distance < ranges) & (boxes.points != 0)
    is_cycle = np.isin(boxes.class_ids, [NAMES.index(name) for name in RACK_CLASSES])
    for rack in np.column_stack([racks.centres, racks.sizes, racks.yaws]):
        is_counted &= ~(is_cycle & points_in_box(boxes.centres, rack))
    return is_counted


@dataclass(frozen=True)
class ClassScores:
    """Scores of one class.

    Without labels or hits, AP is 0 and the errors are 1.

    Attributes:
        objects: Number of labels.
        detections: Number of detections.
        ap: Average precision 0..1 at each of DISTANCES.
        errors: Value of each of ERRORS, NaN if it is not defined for the class.
    """

    objects: int
    detections: int
    ap: dict[float, float]
    errors: dict[str, float]

    @property
    def mean_ap(self) -> float:
        return float(np.mean([*self.ap.values()]))


def score_class(
    name: str, truth: GlobalBoxes, true_frames: np.ndarray, detections: GlobalBoxes, detection_frames: np.ndarray
) -> ClassScores:
    """Score a class over all frames. The boxes are those of select_scored_boxes.

    Args:
        name: Name of the class.
        truth: M labels.
        true_frames: (M,) int, ascending, frame of each label.
        detections: K detections.
        detection_frames: (K,) int, frame of each detection.
    """
    is_class, is_class_detection = (boxes.class_ids == NAMES.index(name) for boxes in (truth, detections))
    truth, true_frames = truth[is_class], true_frames[is_class]
    detections, detection_frames = detections[is_class_detection], detection_frames[is_class_detection]
    order = np.argsort(detections.scores, kind="stable")[::-1]
    detections, detection_frames = detections[order], detection_frames[order]
    frames = max(true_frames.max(initial=-1), detection_frames.max(initial=-1)) + 1
    first_label = np.searchsorted(true_frames, np.arange(frames + 1))
    ap, errors = {}, {}
    for distance in DISTANCES:
        indices = _match(detections.centres, detection_frames, truth.centres, first_label, distance)
        precision, confidence = _interpolate_curves(indices >= 0, detections.scores, len(truth))
        precision_gain = np.maximum(precision[FIRST_RECALL_INDEX:] - MIN_PRECISION, 0)
        ap[distance] = float(precision_gain.mean()) / (1 - MIN_PRECISION)
        if distance == ERROR_DISTANCE:
            hits = detections[indices >= 0]
            errors = {
                error: _average_error(values, hits.scores, confidence)
                for error, values in compute_errors(
                    truth[indices[indices >= 0]], hits, name in SYMMETRIC_CLASSES
                ).items()
            }
    errors |= dict.fromkeys(UNDEFINED_ERRORS.get(name, ()), math.nan)
    return ClassScores(len(truth), len(detections), ap, errors)


@njit(cache=True, nogil=True)
def _match(centres, frames, true_centres, first, max_distance):
    """Return the index (K,) int64 of the object that each detection hits, -1 for none.

    Detections are in descending order of score. Frame f has the objects from first[f] to
    first[f + 1] - 1.
    """
    indices, is_matched = np.full(len(centres), -1), np.zeros(len(true_centres), np.bool_)
    for i in range(len(centres)):
        best, nearest = -1, np.inf
        for j in range(first[frames[i]], first[frames[i] + 1]):
            distance = np.sqrt((centres[i, 0] - true_centres[j, 0]) ** 2 + (centres[i, 1] - true_centres[j, 1]) ** 2)
            if not is_matched[j] and distance < nearest:
                best, nearest = j, distance
        if nearest < max_distance:
            indices[i], is_matched[best] = best, True
    return indices


def _interpolate_curves(is_hit: np.ndarray, scores: np.ndarray, objects: int) -> tuple[np.ndarray, np.ndarray]:
    """Interpolate precision and score at RECALLS, (101,) each. They are 0 at recalls that are not reached.

    The detections (K,) are in descending order of score.
    """
    if not is_hit.any():
        return np.zeros(len(RECALLS)), np.zeros(len(RECALLS))
    hits = np.cumsum(is_hit)
    recall = hits / objects
    precision = hits / np.arange(1, len(is_hit) + 1)
    return (np.interp(RECALLS, recall, precision, right=0), np.interp(RECALLS, recall, scores, right=0))


def _average_error(values: np.ndarray, scores: np.ndarray, confidence: np.ndarray) -> float:
    """Average an error over the recalls that are reached, starting at FIRST_RECALL_INDEX.

    The error at a recall is the mean over the hits (H,) with at least the score of that recall.
    NaN values are ignored. The result is 1 if all values are NaN.
    """
    reached_indices = np.flatnonzero(confidence)
    last_index = reached_indices[-1] if len(reached_indices) else 0
    if last_index < FIRST_RECALL_INDEX or np.isnan(values).all():
        return 1.0
    known_counts = np.cumsum(~np.isnan(values))
    running_means = np.nancumsum(values) / np.maximum(known_counts, 1)
    curve = np.interp(confidence[::-1], scores[::-1], running_means[::-1])[::-1]
    return float(curve[FIRST_RECALL_INDEX : last_index + 1].mean())


def compute_errors(truth: GlobalBoxes, detections: GlobalBoxes, symmetric: bool) -> dict[str, np.ndarray]:
    """Compute each of ERRORS, (H,) float64, for H pairs of boxes.

    An error is NaN if a velocity or the labelled attribute is unknown. With `symmetric`, yaw errors
    are modulo pi.
    """
    intersection = np.minimum(truth.sizes, detections.sizes).prod(axis=1)
    union = truth.sizes.prod(axis=1) + detections.sizes.prod(axis=1) - intersection
    period = np.pi if symmetric else 2 * np.pi
    rotation = (truth.yaws - detections.yaws + period / 2) % period - period / 2
    attribute_errors = (truth.attributes != detections.attributes).astype(float)
    return {
        "ate": np.hypot(*(truth.centres - detections.centres)[:, :2].T),
        "ase": 1 - intersection / union,
        "aoe": np.abs(rotation),
        "ave": np.hypot(*(truth.velocities - detections.velocities).T),
        "aae": np.where(truth.attributes < 0, np.nan, attribute_errors),
    }


def summarize(scores: dict[str, ClassScores]) -> dict[str, float]:
    """Return "map", the mean of each of ERRORS over the classes, and "nds".

    nds is the nuScenes detection score: the weighted mean of mAP (weight MAP_WEIGHT) and of
    max(0, 1 - error) for each error (weight 1).
    """
    result = {
        "map": float(np.mean([s.mean_ap for s in scores.values()])),
        **{error: float(np.nanmean([s.errors[error] for s in scores.values()])) for error in ERRORS},
    }
    error_scores = [max(0.0, 1.0 - result[error]) for error in ERRORS]
    result["nds"] = (MAP_WEIGHT * result["map"] + sum(error_scores)) / (MAP_WEIGHT + len(error_scores))
    return result
