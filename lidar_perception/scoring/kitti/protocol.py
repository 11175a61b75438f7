"""KITTI's object benchmark: matching of detections and labels, and average precision.

The rules follow Geiger, Lenz, Urtasun, CVPR 2012, and the benchmark's own program.

For a class and a difficulty, a label is
- counted: it must be detected;
- ignored: it may be detected, because it is too small in the image, too occluded or truncated for
  the difficulty, or of a neighbour class;
- other: it has no effect.

A detection is ignored if its 2D box is lower than the minimum height (in any class), counted if it
is of the class, and otherwise other. Detections are matched twice: by score, to find the thresholds
at which recall rises, and by overlap at each threshold, to count. A detection inside a DontCare
region is not a false positive in the image; in BEV and 3D such regions have no extent.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from lidar_perception.classes import DETECTED, TABLE
from lidar_perception.geometry import bev_and_3d_iou
from lidar_perception.scoring.average_precision import average_curve, choose_thresholds, sample_curve
from lidar_perception.scoring.kitti.camera_objects import CameraObjects
from lidar_perception.types import CLASSES

SCORED = tuple(DETECTED)
NEIGHBOURS = {row.looks_like: row.name for row in TABLE if row.looks_like}
METRICS = ("image", "bev", "3d")
STRICT = {name: of.strict for name, of in DETECTED.items()}  # minimum overlap of a match
RELAXED = {name: of.relaxed for name, of in DETECTED.items()}  # minimum overlap of a match, in BEV and 3D
DIFFICULTIES = ("easy", "moderate", "hard")
MIN_PIXELS = (40, 25, 25)  # minimum height of the 2D box (easy, moderate, hard)
MAX_OCCLUDED = (0, 1, 2)
MAX_TRUNCATED = (0.15, 0.3, 0.5)

COUNTED, IGNORED, OTHER = 0, 1, -1
EPS = np.finfo(float).eps  # smaller areas count as 0


@dataclass(frozen=True)
class ComparedFrame:
    """M labels and K detections of one frame.

    Attributes:
        true: Labels.
        found: Detections in descending order of score.
        overlaps: (3, K, M) float64 IoU for each of METRICS.
        excused: (K,) largest fraction of a detection's 2D box inside one DontCare region.
    """

    true: CameraObjects
    found: CameraObjects
    overlaps: np.ndarray
    excused: np.ndarray


def compare_objects(labels: CameraObjects, detections: CameraObjects) -> ComparedFrame:
    """Compute the overlaps of the labels and detections of a frame; detections in any order."""
    detections = detections.take(np.lexsort([*detections.boxes.T, *detections.image_boxes.T, -detections.scores]))
    overlaps = np.stack(
        [compute_image_iou(detections.image_boxes, labels.image_boxes), *bev_and_3d_iou(detections.boxes, labels.boxes)]
    )
    excused = compute_image_iou(detections.image_boxes, labels.regions, over_first=True)
    return ComparedFrame(labels, detections, overlaps, excused.max(axis=1, initial=0.0))


def compute_image_iou(boxes: np.ndarray, others: np.ndarray, over_first: bool = False) -> np.ndarray:
    """Compute the IoU (K, M) of 2D boxes (K, 4) and (M, 4) [left top right bottom].

    With over_first, divide the intersection by the area of the first box instead of the union. The
    result is 0 for boxes with zero or infinite area.
    """
    low = np.maximum(boxes[:, None, :2], others[None, :, :2])
    high = np.minimum(boxes[:, None, 2:], others[None, :, 2:])
    areas, other_areas = (np.prod(b[:, 2:] - b[:, :2], axis=1) for b in (boxes, others))
    shared = np.prod(np.maximum(high - low, 0.0), axis=2)
    with np.errstate(invalid="ignore"):
        denominator = areas[:, None] + (0.0 if over_first else other_areas - shared)
        return np.divide(shared, denominator, out=np.zeros_like(shared), where=denominator > EPS)


@dataclass(frozen=True)
class Comparison:
    """Labels, detections and overlaps of all F frames, concatenated.

    Attributes:
        true: M labels.
        found: K detections.
        overlaps: (3, P) overlaps of the pairs of each frame, with the label as the fastest index.
        excused: (K,) as in ComparedFrame.
        first_true: (F + 1,) int64 index of the first label of each frame.
        first_found: (F + 1,) int64 index of the first detection of each frame.
        first_pair: (F + 1,) int64 index of the first pair of each frame.
    """

    true: CameraObjects
    found: CameraObjects
    overlaps: np.ndarray
    excused: np.ndarray
    first_true: np.ndarray
    first_found: np.ndarray
    first_pair: np.ndarray

    @staticmethod
    def of(frames: list[ComparedFrame]) -> Comparison:
        """Concatenate one or more frames."""
        labels, detections = [f.true for f in frames], [f.found for f in frames]
        return Comparison(
            CameraObjects.concatenate(labels),
            CameraObjects.concatenate(detections),
            np.concatenate([f.overlaps.reshape(len(METRICS), -1) for f in frames], axis=1),
            np.concatenate([f.excused for f in frames]),
            _find_starts(map(len, labels)),
            _find_starts(map(len, detections)),
            _find_starts(f.overlaps[0].size for f in frames),
        )


def _find_starts(sizes) -> np.ndarray:
    return np.concatenate([[0], np.cumsum([*sizes])]).astype(np.int64)


def classify_labels(objects: CameraObjects, name: str, difficulty: str) -> np.ndarray:
    """Return COUNTED, IGNORED or OTHER for each label, (K,) int8, given a class and difficulty."""
    level = DIFFICULTIES.index(difficulty)
    is_class = objects.class_ids == CLASSES.index(name)
    is_neighbour = objects.class_ids == CLASSES.index(NEIGHBOURS.get(name, name))
    is_visible_enough = (
        (objects.occluded <= MAX_OCCLUDED[level])
        & (objects.truncated <= MAX_TRUNCATED[level])
        & (objects.pixels_high >= MIN_PIXELS[level])
    )
    return np.where(is_class & is_visible_enough, COUNTED, np.where(is_class | is_neighbour, IGNORED, OTHER)).astype(
        np.int8
    )


def classify_detections(objects: CameraObjects, name: str, difficulty: str) -> np.ndarray:
    """Return COUNTED, IGNORED or OTHER for each detection, (K,) int8."""
    is_small = objects.pixels_high < MIN_PIXELS[DIFFICULTIES.index(difficulty)]
    is_class = objects.class_ids == CLASSES.index(name)
    return np.where(is_small, IGNORED, np.where(is_class, COUNTED, OTHER)).astype(np.int8)


@dataclass(frozen=True)
class Precision:
    """Average precision in percent for one class, metric, overlap and difficulty.

    Attributes:
        objects: Number of counted labels.
        r11, r40: Average precision over 11 and 40 recall points.
        aos_r11, aos_r40: Average orientation similarity (AOS) over 11 and 40 recall points.
        official_r11, official_r40: r11 and r40 as computed by KITTI's own program, which differ if
            there are few objects.
    """

    objects: int
    r11: float
    r40: float
    aos_r11: float
    aos_r40: float
    official_r11: float
    official_r40: float


def compute_precision(frames: Comparison, name: str, metric: str, overlap: float, difficulty: str) -> Precision | None:
    """Compute the average precision of a class; hits have more than the given overlap.

    Returns None without counted labels. AOS is NaN if a hit has no observation angle.
    """
    pairs = _collect_pairs(frames, name, metric, overlap, difficulty)
    objects = int((pairs.labels == COUNTED).sum())
    if objects == 0:
        return None
    thresholds = choose_thresholds(_find_hit_scores(pairs), objects)
    hits, false_positives, similarity = _count(frames, pairs, metric, thresholds)
    precision = hits / np.maximum(hits + false_positives, 1)
    orientation_similarity = similarity / np.maximum(hits + false_positives, 1)
    return Precision(
        objects,
        *average_curve(sample_curve(precision, objects)),
        *average_curve(sample_curve(orientation_similarity, objects)),
        *average_curve(sample_curve(precision, objects, official=True)),
    )


def count_hits(
    frames: Comparison, name: str, metric: str, overlap: float, difficulty: str, thresholds: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Count hits and false positives at each score threshold, each (T,) float64.

    The rules are those of compute_precision; ignored detections are not counted.
    """
    pairs = _collect_pairs(frames, name, metric, overlap, difficulty)
    return _count(frames, pairs, metric, np.asarray(thresholds, np.float64))[:2]


class _Pairs(NamedTuple):
    """Pairs of all frames for one class, metric and difficulty; see Comparison.

    The overlap of a hit is greater than min_overlap. The values of labels (M,) and detections (K,)
    int8 are COUNTED, IGNORED or OTHER.
    """

    overlaps: np.ndarray
    min_overlap: float
    labels: np.ndarray
    detections: np.ndarray
    scores: np.ndarray
    first_true: np.ndarray
    first_found: np.ndarray
    first_pair: np.ndarray


def _collect_pairs(frames: Comparison, name: str, metric: str, overlap: float, difficulty: str) -> _Pairs:
    return _Pairs(
        frames.overlaps[METRICS.index(metric)],
        overlap,
        classify_labels(frames.true, name, difficulty),
        classify_detections(frames.found, name, difficulty),
        frames.found.scores,
        frames.first_true,
        frames.first_found,
        frames.first_pair,
    )


def _count(frames: Comparison, pairs: _Pairs, metric: str, thresholds: np.ndarray) -> tuple:
    excused = (frames.excused if metric == "image" else np.zeros(len(frames.found))) > pairs.min_overlap
    return _count_hits(pairs, thresholds, excused, frames.true.alpha, frames.found.alpha)


@njit(cache=True, nogil=True)
def _find_hit_scores(pairs):
    """Return the scores of the detections that hit a counted label.

    Each label is matched with the free detection with the highest score.
    """
    overlaps, min_overlap, labels, detections, scores, first_true, first_found, first_pair = pairs
    hits, hit_count = np.empty(len(scores)), 0
    is_taken = np.zeros(len(scores), np.bool_)
    for f in range(len(first_pair) - 1):
        count = first_true[f + 1] - first_true[f]
        for i in range(first_true[f], first_true[f + 1]):
            if labels[i] == OTHER:
                continue
            best = -1
            for j in range(first_found[f], first_found[f + 1]):
                pair = first_pair[f] + (j - first_found[f]) * count + i - first_true[f]
                if (
                    detections[j] != OTHER
                    and not is_taken[j]
                    and overlaps[pair] > min_overlap
                    and (best < 0 or scores[j] > scores[best])
                ):
                    best = j
            if best >= 0:
                is_taken[best] = True
                if labels[i] == COUNTED and detections[best] == COUNTED:
                    hits[hit_count] = scores[best]
                    hit_count += 1
    return hits[:hit_count]


@njit(cache=True, nogil=True)
def _count_hits(pairs, thresholds, excused, true_alpha, found_alpha):
    """Return hits, false positives and the sum of the hits' angle similarities, each (T,).

    At each threshold a label is matched with the free detection with the highest overlap, or with
    an ignored detection if there is no other.
    """
    overlaps, min_overlap, labels, detections, scores, first_true, first_found, first_pair = pairs
    hits, false_positives, similarity = np.zeros((3, len(thresholds)))
    taken_at = np.zeros(len(scores), np.int64)  # number of the threshold, from 1, at which each is matched
    for f in range(len(first_pair) - 1):
        count = first_true[f + 1] - first_true[f]
        for t in range(len(thresholds)):
            end = first_found[f]  # valid because the scores are in descending order
            while end < first_found[f + 1] and scores[end] >= thresholds[t]:
                end += 1
            for i in range(first_true[f], first_true[f + 1]):
                if labels[i] == OTHER:
                    continue
                best, best_overlap = -1, 0.0
                for j in range(first_found[f], end):
                    overlap = overlaps[first_pair[f] + (j - first_found[f]) * count + i - first_true[f]]
                    if detections[j] == OTHER or taken_at[j] == t + 1 or not overlap > min_overlap:
                        continue
                    if detections[j] == COUNTED and overlap > best_overlap:
                        best, best_overlap = j, overlap
                    elif detections[j] == IGNORED and best < 0:
                        best = j
                if best >= 0:
                    taken_at[best] = t + 1
                    if labels[i] == COUNTED and detections[best] == COUNTED:
                        hits[t] += 1
                        similarity[t] += (1 + np.cos(true_alpha[i] - found_alpha[best])) / 2
            for j in range(first_found[f], end):
                if detections[j] == COUNTED and taken_at[j] != t + 1 and not excused[j]:
                    false_positives[t] += 1
    return hits, false_positives, similarity
