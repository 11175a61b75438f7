"""KITTI's object benchmark: matching of detections and labels, and average precision.

The rules follow Geiger, Lenz, Urtasun, CVPR 2012, and the benchmark's own program.

For a class and a difficulty, a label is
- counted: it must be detected;
- ignored: it may be detected; it is too small in the image, too occluded or truncated for the
  difficulty, or has a neighbour class;
- other: it has no effect.

A detection is ignored if its 2D box is smaller than the minimum height (in any class), counted if it
has the class, and otherwise other. Detections are matched twice: by score, to find the thresholds at
which recall rises, and by overlap at each threshold, to count. In the image, a detection inside a
DontCare region is not a false positive. In BEV and 3D, such regions have no extent.
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
STRICT = {name: overlap.strict for name, overlap in DETECTED.items()}  # minimum overlap of a match
RELAXED = {name: overlap.relaxed for name, overlap in DETECTED.items()}  # minimum overlap of a match, in BEV and 3D
DIFFICULTIES = ("easy", "moderate", "hard")
MIN_PIXELS = (40, 25, 25)  # minimum height of the 2D box (easy, moderate, hard)
MAX_OCCLUDED = (0, 1, 2)
MAX_TRUNCATED = (0.15, 0.3, 0.5)

COUNTED, IGNORED, OTHER = 0, 1, -1
EPS = np.finfo(float).eps  # areas up to this size count as 0


@dataclass(frozen=True)
class ComparedFrame:
    """M labels and K detections of one frame.

    Attributes:
        labels: Labels.
        detections: Detections in descending order of score.
        overlaps: (3, K, M) float64 IoU for each of METRICS.
        dont_care: (K,) largest fraction of each detection's 2D box inside one DontCare region.
    """

    labels: CameraObjects
    detections: CameraObjects
    overlaps: np.ndarray
    dont_care: np.ndarray


def compare_objects(labels: CameraObjects, detections: CameraObjects) -> ComparedFrame:
    """Sort the detections of a frame by score, and compute their overlaps with the labels."""
    detections = detections.take(np.lexsort([*detections.boxes.T, *detections.image_boxes.T, -detections.scores]))
    overlaps = np.stack(
        [compute_image_iou(detections.image_boxes, labels.image_boxes), *bev_and_3d_iou(detections.boxes, labels.boxes)]
    )
    dont_care = compute_image_iou(detections.image_boxes, labels.regions, over_first=True)
    return ComparedFrame(labels, detections, overlaps, dont_care.max(axis=1, initial=0.0))


def compute_image_iou(boxes: np.ndarray, others: np.ndarray, over_first: bool = False) -> np.ndarray:
    """Compute the IoU (K, M) of 2D boxes (K, 4) and (M, 4) [left top right bottom].

    With over_first, the intersection is divided by the area of the first box, not by the union. The
    result is 0 for boxes with zero or infinite area.
    """
    low = np.maximum(boxes[:, None, :2], others[None, :, :2])
    high = np.minimum(boxes[:, None, 2:], others[None, :, 2:])
    areas, other_areas = (np.prod(b[:, 2:] - b[:, :2], axis=1) for b in (boxes, others))
    intersection = np.prod(np.maximum(high - low, 0.0), axis=2)
    with np.errstate(invalid="ignore"):
        denominator = areas[:, None] + (0.0 if over_first else other_areas - intersection)
        return np.divide(intersection, denominator, out=np.zeros_like(intersection), where=denominator > EPS)


@dataclass(frozen=True)
class Comparison:
    """Labels, detections and overlaps of all F frames, concatenated.

    Attributes:
        labels: M labels.
        detections: K detections.
        overlaps: (3, P) overlaps of all pairs in a frame; the label index changes fastest.
        dont_care: (K,) see ComparedFrame.
        first_label: (F + 1,) int64 index of the first label of each frame.
        first_detection: (F + 1,) int64 index of the first detection of each frame.
        first_pair: (F + 1,) int64 index of the first pair of each frame.
    """

    labels: CameraObjects
    detections: CameraObjects
    overlaps: np.ndarray
    dont_care: np.ndarray
    first_label: np.ndarray
    first_detection: np.ndarray
    first_pair: np.ndarray

    @staticmethod
    def concatenate(frames: list[ComparedFrame]) -> Comparison:
        """Concatenate one or more frames."""
        labels, detections = [f.labels for f in frames], [f.detections for f in frames]
        return Comparison(
            CameraObjects.concatenate(labels),
            CameraObjects.concatenate(detections),
            np.concatenate([f.overlaps.reshape(len(METRICS), -1) for f in frames], axis=1),
            np.concatenate([f.dont_care for f in frames]),
            _find_starts(map(len, labels)),
            _find_starts(map(len, detections)),
            _find_starts(f.overlaps[0].size for f in frames),
        )


def _find_starts(sizes) -> np.ndarray:
    return np.concatenate([[0], np.cumsum([*sizes])]).astype(np.int64)


def classify_labels(objects: CameraObjects, name: str, difficulty: str) -> np.ndarray:
    """Return COUNTED, IGNORED or OTHER for each label, (K,) int8, for a class and difficulty."""
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
    """Return COUNTED, IGNORED or OTHER for each detection, (K,) int8, for a class and difficulty."""
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
    """

    objects: int
    r11: float
    r40: float
    aos_r11: float
    aos_r40: float


def compute_precision(frames: Comparison, name: str, metric: str, overlap: float, difficulty: str) -> Precision | None:
    """Compute the average precision of a class.

    Args:
        frames: All frames.
        name: Name of the class.
        metric: One of METRICS.
        overlap: Overlap that a hit must exceed.
        difficulty: One of DIFFICULTIES.

    Returns:
        The precision; None without counted labels. AOS is NaN if a hit has no observation angle.
    """
    pairs = _collect_pairs(frames, name, metric, overlap, difficulty)
    objects = int((pairs.labels == COUNTED).sum())
    if objects == 0:
        return None
    thresholds = choose_thresholds(_find_hit_scores(pairs), objects)
    hits, false_positives, similarity = _count_at_thresholds(frames, pairs, metric, thresholds)
    precision = hits / np.maximum(hits + false_positives, 1)
    orientation_similarity = similarity / np.maximum(hits + false_positives, 1)
    return Precision(
        objects,
        *average_curve(sample_curve(precision, objects)),
        *average_curve(sample_curve(orientation_similarity, objects)),
    )


def count_hits(
    frames: Comparison, name: str, metric: str, overlap: float, difficulty: str, thresholds: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Count hits and false positives at each score threshold, each (T,) float64.

    See compute_precision for the arguments and rules. Ignored detections are not counted.
    """
    pairs = _collect_pairs(frames, name, metric, overlap, difficulty)
    return _count_at_thresholds(frames, pairs, metric, np.asarray(thresholds, np.float64))[:2]


class _Pairs(NamedTuple):
    """Pairs of all frames for one class, metric and difficulty; see Comparison.

    The overlap of a hit is greater than min_overlap. labels (M,) and detections (K,) are int8, one of
    COUNTED, IGNORED and OTHER.
    """

    overlaps: np.ndarray
    min_overlap: float
    labels: np.ndarray
    detections: np.ndarray
    scores: np.ndarray
    first_label: np.ndarray
    first_detection: np.ndarray
    first_pair: np.ndarray


def _collect_pairs(frames: Comparison, name: str, metric: str, overlap: float, difficulty: str) -> _Pairs:
    return _Pairs(
        frames.overlaps[METRICS.index(metric)],
        overlap,
        classify_labels(frames.labels, name, difficulty),
        classify_detections(frames.detections, name, difficulty),
        frames.detections.scores,
        frames.first_label,
        frames.first_detection,
        frames.first_pair,
    )


def _count_at_thresholds(frames: Comparison, pairs: _Pairs, metric: str, thresholds: np.ndarray) -> tuple:
    dont_care = frames.dont_care if metric == "image" else np.zeros(len(frames.detections))
    return _count_hits(pairs, thresholds, dont_care > pairs.min_overlap, frames.labels.alpha, frames.detections.alpha)


@njit(cache=True, nogil=True)
def _find_hit_scores(pairs):
    """Return the scores of the detections that hit a counted label.

    Each label is matched with the unmatched detection with the highest score.
    """
    overlaps, min_overlap, labels, detections, scores, first_label, first_detection, first_pair = pairs
    hits, hit_count = np.empty(len(scores)), 0
    is_matched = np.zeros(len(scores), np.bool_)
    for f in range(len(first_pair) - 1):
        count = first_label[f + 1] - first_label[f]
        for i in range(first_label[f], first_label[f + 1]):
            if labels[i] == OTHER:
                continue
            best = -1
            for j in range(first_detection[f], first_detection[f + 1]):
                pair = first_pair[f] + (j - first_detection[f]) * count + i - first_label[f]
                if (
                    detections[j] != OTHER
                    and not is_matched[j]
                    and overlaps[pair] > min_overlap
                    and (best < 0 or scores[j] > scores[best])
                ):
                    best = j
            if best >= 0:
                is_matched[best] = True
                if labels[i] == COUNTED and detections[best] == COUNTED:
                    hits[hit_count] = scores[best]
                    hit_count += 1
    return hits[:hit_count]


@njit(cache=True, nogil=True)
def _count_hits(pairs, thresholds, is_dont_care, label_alpha, detection_alpha):
    """Return hits, false positives and the sum of the angle similarities of the hits, each (T,).

    At each threshold, a label is matched with the unmatched detection with the highest overlap, or
    with an ignored detection if there is no other.
    """
    overlaps, min_overlap, labels, detections, scores, first_label, first_detection, first_pair = pairs
    hits, false_positives, similarity = np.zeros((3, len(thresholds)))
    matched_at = np.zeros(len(scores), np.int64)  # last threshold (from 1) at which each detection was matched
    for f in range(len(first_pair) - 1):
        count = first_label[f + 1] - first_label[f]
        for t in range(len(thresholds)):
            end = first_detection[f]  # valid because the scores are in descending order
            while end < first_detection[f + 1] and scores[end] >= thresholds[t]:
                end += 1
            for i in range(first_label[f], first_label[f + 1]):
                if labels[i] == OTHER:
                    continue
                best, best_overlap = -1, 0.0
                for j in range(first_detection[f], end):
                    overlap = overlaps[first_pair[f] + (j - first_detection[f]) * count + i - first_label[f]]
                    if detections[j] == OTHER or matched_at[j] == t + 1 or not overlap > min_overlap:
                        continue
                    if detections[j] == COUNTED and overlap > best_overlap:
                        best, best_overlap = j, overlap
                    elif detections[j] == IGNORED and best < 0:
                        best = j
                if best >= 0:
                    matched_at[best] = t + 1
                    if labels[i] == COUNTED and detections[best] == COUNTED:
                        hits[t] += 1
                        similarity[t] += (1 + np.cos(label_alpha[i] - detection_alpha[best])) / 2
            for j in range(first_detection[f], end):
                if detections[j] == COUNTED and matched_at[j] != t + 1 and not is_dont_care[j]:
                    false_positives[t] += 1
    return hits, false_positives, similarity
