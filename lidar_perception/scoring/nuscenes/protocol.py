"""The detection task of nuScenes: average precision by centre distance, and errors of the hits.

Caesar et al., CVPR 2020, Section 3.1, with the configuration detection_cvpr_2019 of
nuscenes-devkit. Detections of a class take, best score first, the nearest unmatched object of their
frame if it is near enough in the ground plane. Average precision is the area under the curve above
a recall and a precision of 0.1, averaged over four distances. The errors are those of hits at 2 m:
at each recall the mean over all hits of at least that score, averaged over recalls above 0.1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from lidar_perception.data.nuscenes.boxes import NAMES, GlobalBoxes
from lidar_perception.geometry import points_in_box

# maximum distance from the vehicle, metres
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
FIRST_RECALL_INDEX = 11  # index of the first of RECALLS above 0.1
MIN_PRECISION = 0.1
MAP_WEIGHT = 5  # weight of mAP in NDS; each of ERRORS has weight 1
RACK_CLASSES = ("bicycle", "motorcycle")  # ignored inside a bicycle rack

# translation m, scale 1 - IoU of the aligned boxes, orientation rad, velocity m/s, attribute
# 1 - accuracy
ERRORS = ("ate", "ase", "aoe", "ave", "aae")
UNDEFINED = {"traffic_cone": ("aoe", "ave", "aae"), "barrier": ("ave", "aae")}
SYMMETRIC_CLASSES = ("barrier",)  # classes whose front and rear are equivalent


def select_counted(boxes: GlobalBoxes, ego: np.ndarray, racks: GlobalBoxes) -> np.ndarray:
    """Return a mask (K,) of the labels or detections of one frame that count.

    They are of a known class, within its range of the vehicle at ego (>=2,), not known to be
    without points, and not a bicycle or motorcycle in a rack.
    """
    ranges = np.array([RANGES[name] for name in NAMES] + [0.0])[boxes.class_ids]  # -1 selects the last entry
    away = np.sqrt(((boxes.centres[:, :2] - ego[:2]) ** 2).sum(axis=1))
    kept = (away < ranges) & (boxes.points != 0)
    cycles = np.isin(boxes.class_ids, [NAMES.index(name) for name in RACK_CLASSES])
    for rack in np.column_stack([racks.centres, racks.sizes, racks.yaws]):
        kept &= ~(cycles & points_in_box(boxes.centres, rack))
    return kept


@dataclass(frozen=True)
class ClassScores:
    """Scores of one class.

    Attributes:
        objects, detections: counts.
        ap: average precision 0..1 at each of DISTANCES.
        errors: by ERRORS, NaN for errors that the class does not have.

    Without a hit, or without an object, AP is 0 and the errors are 1.
    """

    objects: int
    detections: int
    ap: dict[float, float]
    errors: dict[str, float]

    @property
    def mean_ap(self) -> float:
        return float(np.mean([*self.ap.values()]))


def score_class(
    name: str, truth: GlobalBoxes, true_frames: np.ndarray, found: GlobalBoxes, found_frames: np.ndarray
) -> ClassScores:
    """Score a class over the counted boxes of all frames.

    Args:
        truth, found: M labels and K detections.
        true_frames, found_frames: indices of their frames, (M,) ascending and (K,) int.
    """
    own, own_found = (boxes.class_ids == NAMES.index(name) for boxes in (truth, found))
    truth, true_frames = truth[own], true_frames[own]
    found, found_frames = found[own_found], found_frames[own_found]
    order = np.argsort(found.scores, kind="stable")[::-1]
    found, found_frames = found[order], found_frames[order]
    frames = max(true_frames.max(initial=-1), found_frames.max(initial=-1)) + 1
    first = np.searchsorted(true_frames, np.arange(frames + 1))
    ap, errors = {}, {}
    for distance in DISTANCES:
        indices = _match(found.centres, found_frames, truth.centres, first, distance)
        precision, confidence = _interpolate_curves(indices >= 0, found.scores, len(truth))
        above = np.maximum(precision[FIRST_RECALL_INDEX:] - MIN_PRECISION, 0)
        ap[distance] = float(above.mean()) / (1 - MIN_PRECISION)
        if distance == ERROR_DISTANCE:
            hits = found[indices >= 0]
            errors = {
                error: _average_error(values, hits.scores, confidence)
                for error, values in compute_errors(
                    truth[indices[indices >= 0]], hits, name in SYMMETRIC_CLASSES
                ).items()
            }
    errors |= dict.fromkeys(UNDEFINED.get(name, ()), math.nan)
    return ClassScores(len(truth), len(found), ap, errors)


@njit(cache=True, nogil=True)
def _match(centres, frames, true_centres, first, max_distance):
    """Return the index (K,) int64 of the object that each detection hits, -1 without one.

    Detections are sorted by descending score; objects of frame f are first[f] .. first[f + 1].
    """
    indices, taken = np.full(len(centres), -1), np.zeros(len(true_centres), np.bool_)
    for i in range(len(centres)):
        best, nearest = -1, np.inf
        for j in range(first[frames[i]], first[frames[i] + 1]):
            away = np.sqrt((centres[i, 0] - true_centres[j, 0]) ** 2 + (centres[i, 1] - true_centres[j, 1]) ** 2)
            if not taken[j] and away < nearest:
                best, nearest = j, away
        if nearest < max_distance:
            indices[i], taken[best] = best, True
    return indices


def _interpolate_curves(hit: np.ndarray, scores: np.ndarray, objects: int) -> tuple[np.ndarray, np.ndarray]:
    """Interpolate precision and score at RECALLS, (101,) each, 0 at recall that is not reached.

    Detections (K,) are sorted by descending score.
    """
    if not hit.any():
        return np.zeros(len(RECALLS)), np.zeros(len(RECALLS))
    hits = np.cumsum(hit)
    recall = hits / objects
    precision = hits / np.arange(1, len(hit) + 1)
    return (np.interp(RECALLS, recall, precision, right=0), np.interp(RECALLS, recall, scores, right=0))


def _average_error(values: np.ndarray, scores: np.ndarray, confidence: np.ndarray) -> float:
    """Average an error over the recalls that are reached, from FIRST_RECALL_INDEX on.

    The error at a recall is the mean over all hits (H,) up to it. NaN are ignored; 1 if all are
    NaN.
    """
    reached = np.flatnonzero(confidence)
    last = reached[-1] if len(reached) else 0
    if last < FIRST_RECALL_INDEX or np.isnan(values).all():
        return 1.0
    known = np.cumsum(~np.isnan(values))
    so_far = np.nancumsum(values) / np.maximum(known, 1)
    curve = np.interp(confidence[::-1], scores[::-1], so_far[::-1])[::-1]
    return float(curve[FIRST_RECALL_INDEX : last + 1].mean())


def compute_errors(truth: GlobalBoxes, found: GlobalBoxes, half_turns: bool) -> dict[str, np.ndarray]:
    """Compute the ERRORS (H,) float64 of pairs of boxes.

    An error is NaN where the true velocity or attribute, or the detected velocity, is unknown. With
    half_turns a box rotated by pi is the same.
    """
    shared = np.minimum(truth.sizes, found.sizes).prod(axis=1)
    union = truth.sizes.prod(axis=1) + found.sizes.prod(axis=1) - shared
    period = np.pi if half_turns else 2 * np.pi
    rotation = (truth.yaws - found.yaws + period / 2) % period - period / 2
    differs = (truth.attributes != found.attributes).astype(float)
    return {
        "ate": np.hypot(*(truth.centres - found.centres)[:, :2].T),
        "ase": 1 - shared / union,
        "aoe": np.abs(rotation),
        "ave": np.hypot(*(truth.velocities - found.velocities).T),
        "aae": np.where(truth.attributes < 0, np.nan, differs),
    }


def summarize(scores: dict[str, ClassScores]) -> dict[str, float]:
    """Return map, the mean of each of ERRORS over its classes, and nds, all in 0..1.

    nds is nuScenes' detection score, the mean of mAP with weight MAP_WEIGHT and 1 - error (at least
    0) of each error.
    """
    result = {
        "map": float(np.mean([s.mean_ap for s in scores.values()])),
        **{error: float(np.nanmean([s.errors[error] for s in scores.values()])) for error in ERRORS},
    }
    parts = [max(0.0, 1.0 - result[error]) for error in ERRORS]
    result["nds"] = (MAP_WEIGHT * result["map"] + sum(parts)) / (MAP_WEIGHT + len(parts))
    return result
