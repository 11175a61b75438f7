"""KITTI's object benchmark: which detection finds which object, and what counts.

Geiger, Lenz, Urtasun, CVPR 2012, and the benchmark's own program. For one class and difficulty an
object is counted (it must be found), ignored (it may be found: too small in the image, hidden or
cut off for the difficulty, or of a class like the wanted one) or other (as if it were not there).
A detection is counted, or ignored where it is lower than the least height, of whatever class, or
other. Detections are paired with objects twice: once by score, to learn at which scores recall
rises, and once for each of these scores by overlap, to count. In the image alone a detection that
lies in a DontCare region is not wrong; seen from above and in space such regions have no extent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from lidar_perception.classes import DETECTED, TABLE
from lidar_perception.geometry import bev_and_3d_iou
from lidar_perception.scoring.average_precision import (
    average_curve,
    choose_thresholds,
    sample_curve,
)
from lidar_perception.scoring.kitti.camera_objects import CameraObjects
from lidar_perception.types import CLASSES

SCORED = tuple(DETECTED)
NEIGHBOURS = {row.looks_like: row.name for row in TABLE if row.looks_like}
METRICS = ("image", "bev", "3d")
STRICT = {name: of.strict for name, of in DETECTED.items()}    # overlap needed for a hit
RELAXED = {name: of.relaxed for name, of in DETECTED.items()}  # seen from above and in space
DIFFICULTIES = ("easy", "moderate", "hard")
MIN_PIXELS = (40, 25, 25)        # height of the 2D box
MAX_OCCLUDED = (0, 1, 2)
MAX_TRUNCATED = (0.15, 0.3, 0.5)

COUNTED, IGNORED, OTHER = 0, 1, -1


@dataclass(frozen=True)
class ComparedFrame:
    """M true and K found objects of one frame, found ones by falling score; overlaps (3, K, M)
    float64 by METRICS; excused (K,) the largest share of a 2D box in a DontCare region."""

    true: CameraObjects
    found: CameraObjects
    overlaps: np.ndarray
    excused: np.ndarray


def compare_objects(true: CameraObjects, found: CameraObjects) -> ComparedFrame:
    """All overlaps of a frame. The order in which detections came makes no difference."""
    found = found.take(np.lexsort([*found.boxes.T, *found.image_boxes.T, -found.scores]))
    shared = _intersect(found.image_boxes, true.image_boxes)
    own, others = _compute_areas(found.image_boxes), _compute_areas(true.image_boxes)
    with np.errstate(invalid="ignore", divide="ignore"):  # a box without pixels shares none
        image = np.nan_to_num(shared / (own[:, None] + others - shared))
        excused = np.nan_to_num(_intersect(found.image_boxes, true.regions) / own[:, None])
    overlaps = np.stack([image, *bev_and_3d_iou(found.boxes, true.boxes)])
    return ComparedFrame(true, found, overlaps, excused.max(axis=1, initial=0.0))


def _compute_areas(boxes: np.ndarray) -> np.ndarray:
    return np.prod(boxes[:, 2:] - boxes[:, :2], axis=1)


def _intersect(boxes: np.ndarray, others: np.ndarray) -> np.ndarray:
    """(K, M) area that 2D boxes (K, 4) and (M, 4) share."""
    low = np.maximum(boxes[:, None, :2], others[None, :, :2])
    high = np.minimum(boxes[:, None, 2:], others[None, :, 2:])
    return np.prod(np.maximum(high - low, 0), axis=2)


@dataclass(frozen=True)
class Comparison:
    """All frames behind one another: true objects (M in all), found ones (K), overlaps (3, P) of
    the pairs of each frame, found by true; first_* (F + 1,) int64 where each frame begins."""

    true: CameraObjects
    found: CameraObjects
    overlaps: np.ndarray
    excused: np.ndarray
    first_true: np.ndarray
    first_found: np.ndarray
    first_pair: np.ndarray

    @staticmethod
    def of(frames: list[ComparedFrame]) -> Comparison:
        """At least one frame."""
        true, found = [f.true for f in frames], [f.found for f in frames]
        return Comparison(
            CameraObjects.concatenate(true), CameraObjects.concatenate(found),
            np.concatenate([f.overlaps.reshape(len(METRICS), -1) for f in frames], axis=1),
            np.concatenate([f.excused for f in frames]), _find_starts(map(len, true)),
            _find_starts(map(len, found)), _find_starts(f.overlaps[0].size for f in frames))


def _find_starts(sizes) -> np.ndarray:
    return np.concatenate([[0], np.cumsum([*sizes])]).astype(np.int64)


def classify_labels(objects: CameraObjects, name: str, difficulty: str) -> np.ndarray:
    """(K,) int8 COUNTED, IGNORED or OTHER of labels, for the class called name."""
    level = DIFFICULTIES.index(difficulty)
    own = objects.class_ids == CLASSES.index(name)
    like = objects.class_ids == CLASSES.index(NEIGHBOURS.get(name, name))
    fit = ((objects.occluded <= MAX_OCCLUDED[level])
           & (objects.truncated <= MAX_TRUNCATED[level])
           & (objects.pixels_high >= MIN_PIXELS[level]))
    return np.where(own & fit, COUNTED, np.where(own | like, IGNORED, OTHER)).astype(np.int8)


def classify_detections(objects: CameraObjects, name: str, difficulty: str) -> np.ndarray:
    """(K,) int8 COUNTED, IGNORED or OTHER of detections, for the class called name."""
    low = objects.pixels_high < MIN_PIXELS[DIFFICULTIES.index(difficulty)]
    own = objects.class_ids == CLASSES.index(name)
    return np.where(low, IGNORED, np.where(own, COUNTED, OTHER)).astype(np.int8)


@dataclass(frozen=True)
class Precision:
    """What was reached for one class, metric, overlap and difficulty: objects to find, and percent
    at 11 and 40 recall points; the same for orientation (AOS); as KITTI's program gives them
    where there are fewer objects than recall points."""

    objects: int
    r11: float
    r40: float
    aos_r11: float
    aos_r40: float
    official_r11: float
    official_r40: float


def compute_precision(frames: Comparison, name: str, metric: str, overlap: float,
                      difficulty: str) -> Precision | None:
    """Average precision of the class called name at an overlap above the given one; None where
    there is nothing to find. Orientation is NaN where a hit has no angle."""
    pairs = _collect_pairs(frames, name, metric, overlap, difficulty)
    objects = int((pairs[2] == COUNTED).sum())
    if objects == 0:
        return None
    thresholds = choose_thresholds(_find_hit_scores(*pairs), objects)
    hits, wrong, turned = _count(frames, pairs, metric, thresholds)
    right = hits / np.maximum(hits + wrong, 1)
    turned = turned / np.maximum(hits + wrong, 1)
    return Precision(objects, *average_curve(sample_curve(right, objects)),
                     *average_curve(sample_curve(turned, objects)),
                     *average_curve(sample_curve(right, objects, official=True)))


def count_hits(frames: Comparison, name: str, metric: str, overlap: float, difficulty: str,
               thresholds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two (T,) float64: how many detections of a score of thresholds (T,) or more are right, and
    how many are wrong, by the rules of precision(); those that are ignored are neither."""
    pairs = _collect_pairs(frames, name, metric, overlap, difficulty)
    return _count(frames, pairs, metric, np.asarray(thresholds, np.float64))[:2]


def _collect_pairs(
    frames: Comparison, name: str, metric: str, overlap: float, difficulty: str
) -> tuple:
    """What _hit_scores takes."""
    return (frames.overlaps[METRICS.index(metric)], overlap,
            classify_labels(frames.true, name, difficulty),
            classify_detections(frames.found, name, difficulty),
            frames.found.scores, frames.first_true, frames.first_found, frames.first_pair)


def _count(frames: Comparison, pairs: tuple, metric: str, thresholds: np.ndarray) -> tuple:
    """What _counts gives of pairs at thresholds (T,)."""
    excused = (frames.excused if metric == "image" else np.zeros(len(frames.found))) > pairs[1]
    return _count_hits(*(*pairs, thresholds, excused, frames.true.alpha, frames.found.alpha))


@njit(cache=True, nogil=True)
def _find_hit_scores(
    overlaps,
    least,
    classify_labels,
    classify_detections,
    scores,
    first_true,
    first_found,
    first_pair,
):
    """Scores of the detections that find a counted object, when every object takes the best scored
    one that is left."""
    hits, number = np.empty(len(scores)), 0
    taken = np.zeros(len(scores), np.bool_)
    for f in range(len(first_pair) - 1):
        count = first_true[f + 1] - first_true[f]
        for i in range(first_true[f], first_true[f + 1]):
            if classify_labels[i] == OTHER:
                continue
            best = -1
            for j in range(first_found[f], first_found[f + 1]):
                pair = first_pair[f] + (j - first_found[f]) * count + i - first_true[f]
                if (classify_detections[j] != OTHER and not taken[j] and overlaps[pair] > least
                        and (best < 0 or scores[j] > scores[best])):
                    best = j
            if best >= 0:
                taken[best] = True
                if classify_labels[i] == COUNTED and classify_detections[best] == COUNTED:
                    hits[number] = scores[best]
                    number += 1
    return hits[:number]


@njit(cache=True, nogil=True)
def _count_hits(
    overlaps,
    least,
    classify_labels,
    classify_detections,
    scores,
    first_true,
    first_found,
    first_pair,
    thresholds,
    excused,
    true_alpha,
    found_alpha,
):
    """(T,) float64 each: hits, wrong detections and summed similarity of angle of the hits, among
    the detections that score each threshold or more, when every object takes the one of greatest
    overlap that is left; an ignored one only where there is no other."""
    hits, wrong, turned = (np.zeros(len(thresholds)), np.zeros(len(thresholds)),
                           np.zeros(len(thresholds)))
    taken = np.zeros(len(scores), np.int64)  # at which threshold, from 1
    for f in range(len(first_pair) - 1):
        count = first_true[f + 1] - first_true[f]
        for t in range(len(thresholds)):
            end = first_found[f]  # scores fall
            while end < first_found[f + 1] and scores[end] >= thresholds[t]:
                end += 1
            for i in range(first_true[f], first_true[f + 1]):
                if classify_labels[i] == OTHER:
                    continue
                best, most = -1, 0.0
                for j in range(first_found[f], end):
                    overlap = overlaps[first_pair[f] + (j - first_found[f]) * count
                                       + i - first_true[f]]
                    if classify_detections[j] == OTHER or taken[j] == t + 1 or not overlap > least:
                        continue
                    if classify_detections[j] == COUNTED and overlap > most:
                        best, most = j, overlap
                    elif classify_detections[j] == IGNORED and best < 0:
                        best = j
                if best >= 0:
                    taken[best] = t + 1
                    if classify_labels[i] == COUNTED and classify_detections[best] == COUNTED:
                        hits[t] += 1
                        turned[t] += (1 + np.cos(true_alpha[i] - found_alpha[best])) / 2
            for j in range(first_found[f], end):
                if classify_detections[j] == COUNTED and taken[j] != t + 1 and not excused[j]:
                    wrong[t] += 1
    return hits, wrong, turned
