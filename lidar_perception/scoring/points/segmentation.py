"""Scores of ground and clusters on labelled points (SemanticKITTI) or boxes (KITTI, bags).

Ground is road, parking, sidewalk, other-ground, lane-marking and terrain. Unlabelled points and
outliers are ignored. There are three protocols, because vegetation changes F1 by several points:

- without vegetation: vegetation is ignored (Patchwork++, Lee et al., IROS 2022, Section IV-A).
- with vegetation: vegetation is ground below z = -1.3 m in KITTI's LiDAR frame, which is 0.43 m above
  the road, and not ground above it (Patchwork, Lim et al., RA-L 2021).
- vegetation not ground: vegetation is not ground.

A cluster C and an object O are compared by their points: IoU = |C and O| / |C or O|. A hit is an IoU
above one half, so that a cluster hits at most one object. Object points that were segmented as ground
are in no cluster, which lowers the IoU.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from lidar_perception.data.semantickitti import GROUND, MOVING, THINGS, UNLABELLED, VEGETATION
from lidar_perception.geometry import horizontal_range, points_in_box
from lidar_perception.groups import renumber_ids
from lidar_perception.types import CLASSES, GroundTruth

PROTOCOLS = ("without vegetation", "with vegetation", "vegetation not ground")
LOW_VEGETATION_Z = -1.3  # maximum z of ground in metres, in KITTI's LiDAR frame (1.73 m above the road)

HIT_IOU = 0.5
MIN_POINTS = 10  # minimum number of points of an object; others are ignored
BOTTOM_MARGIN = 0.2  # points up to this height in metres above the bottom of a box may belong to the road
BOX_MARGIN = 0.2  # margin of boxes in metres; a cluster is scored if most of its points are in enlarged boxes
MIN_PIECE_FRACTION = 0.1  # a cluster with at least this fraction of an object's points is a piece of the object
RANGE_NAMES = ("0-15", "15-30", "30-45", "45+")
RANGE_LIMITS = np.array([15.0, 30.0, 45.0])


def select_true_ground(semantic: np.ndarray, z: np.ndarray, protocol: str) -> tuple[np.ndarray, np.ndarray]:
    """Return two masks (N,): points of the true ground, and points to score.

    Args:
        semantic: (N,) SemanticKITTI classes.
        z: (N,) height relative to a sensor at KITTI's mounting height, metres.
        protocol: One of PROTOCOLS.
    """
    ground, is_counted = np.isin(semantic, GROUND), ~np.isin(semantic, UNLABELLED)
    vegetation = semantic == VEGETATION
    if protocol == "without vegetation":
        is_counted &= ~vegetation
    elif protocol == "with vegetation":
        ground |= vegetation & (z < LOW_VEGETATION_Z)
    return ground, is_counted


def count_ground(predicted_ground: np.ndarray, ground: np.ndarray, is_counted: np.ndarray) -> np.ndarray:
    """Count true and false positives and negatives (4,) int64 [tp fp fn tn] of a ground mask (N,)."""
    case = np.where(ground, np.where(predicted_ground, 0, 2), np.where(predicted_ground, 1, 3))
    return np.bincount(case.compress(is_counted), minlength=4)


def count_by_protocol(predicted_ground: np.ndarray, semantic: np.ndarray, z: np.ndarray) -> dict[str, np.ndarray]:
    """Return the result of count_ground for each protocol."""
    return {name: count_ground(predicted_ground, *select_true_ground(semantic, z, name)) for name in PROTOCOLS}


def to_ground_row(counts: np.ndarray) -> dict:
    """Return counts (4,) and their ratios for the JSON file. A ratio with denominator 0 is 0."""
    tp, fp, fn, tn = counts.tolist()
    return dict(
        tp=tp,
        fp=fp,
        fn=fn,
        tn=tn,
        precision=_divide(tp, tp + fp),
        recall=_divide(tp, tp + fn),
        f1=_divide(2 * tp, 2 * tp + fp + fn),
        accuracy=_divide(tp + tn, tp + fp + fn + tn),
    )


@dataclass
class GroundReport:
    """Counts of one ground method by protocol, over the points of all scans."""

    counts: dict[str, np.ndarray] = field(default_factory=lambda: {name: np.zeros(4, np.int64) for name in PROTOCOLS})
    ms: list[float] = field(default_factory=list)

    def update(self, counts: dict[str, np.ndarray], ms: float) -> None:
        """Add one scan: the result of count_by_protocol, and the run time in ms."""
        for name, total in self.counts.items():
            total += counts[name]
        self.ms.append(ms)

    def compute(self) -> dict:
        """Return the content of the JSON file."""
        return {
            "scans": len(self.ms),
            "ms": _compute_median(self.ms),
            "protocols": {name: to_ground_row(c) for name, c in self.counts.items()},
        }


@dataclass(frozen=True)
class Objects:
    """K labelled objects among N points.

    Attributes:
        owner: (N,) int32 object 1..K of each point, 0 for none.
        region: (N,) int32, owner extended by neutral points, such as the road in the box of an
            object. They do not change the IoU of the object.
        is_near: (N,) bool, points near an object; clusters elsewhere are not scored.
        is_counted: (N,) bool, points with a known class; other points are ignored.
        classes: Class names of the K objects.
        ranges: (K,) horizontal range, metres.
    """

    owner: np.ndarray
    region: np.ndarray
    is_near: np.ndarray
    is_counted: np.ndarray
    classes: tuple[str, ...]
    ranges: np.ndarray


def find_objects_in_boxes(xyz: np.ndarray, truth: GroundTruth) -> Objects:
    """Find the objects in labelled boxes, except DontCare, with at least MIN_POINTS points.

    A box contains some of the road, so only points more than BOTTOM_MARGIN above its bottom belong
    to the object. Lower points are neutral. A point in two boxes belongs to the smaller one.
    """
    owner, region = np.zeros((2, len(xyz)), np.int32)
    for k in np.argsort(-np.prod(truth.boxes[:, 3:6], axis=1), kind="stable"):
        box = truth.boxes[k]
        if CLASSES[truth.class_ids[k]] != "DontCare":
            in_box = points_in_box(xyz, box)
            region[in_box] = k + 1
            owner[in_box] = np.where(xyz[in_box, 2] > box[2] - box[5] / 2 + BOTTOM_MARGIN, k + 1, 0)
    kept_indices = np.flatnonzero(np.bincount(owner, minlength=len(truth) + 1)[1:] >= MIN_POINTS)
    near_object = np.zeros(len(xyz), bool)
    for box in truth.boxes[kept_indices]:
        near_object |= points_in_box(xyz, box, BOX_MARGIN)
    return Objects(
        _renumber(owner, kept_indices + 1),
        _renumber(region, kept_indices + 1),
        near_object,
        np.ones(len(xyz), bool),
        tuple(truth.labels[k] for k in kept_indices),
        np.hypot(*truth.boxes[kept_indices, :2].T),
    )


def find_instances(xyz: np.ndarray, semantic: np.ndarray, instance: np.ndarray) -> Objects:
    """Find the objects of a SemanticKITTI scan with at least MIN_POINTS points.

    An object consists of the points of one class and instance, moving or not. Unlabelled points,
    outliers, object classes without an instance id, and smaller objects are ignored.
    """
    thing_of_class = np.zeros(1 << 16, np.int32)
    thing_of_class[list(THINGS)] = list(THINGS)
    thing_of_class[list(MOVING)] = list(MOVING.values())
    thing_class = thing_of_class[semantic]
    keys, key_index, counts = np.unique(
        np.where((thing_class > 0) & (instance > 0), thing_class << 16 | instance, 0),
        return_inverse=True,
        return_counts=True,
    )
    kept_indices = np.flatnonzero((keys > 0) & (counts >= MIN_POINTS))
    owner = _renumber(key_index.reshape(-1), kept_indices)
    sums = [np.bincount(owner, axis, minlength=len(kept_indices) + 1)[1:] for axis in xyz[:, :2].T]
    centres = np.stack(sums, axis=1) / counts[kept_indices, None]
    is_counted = (owner > 0) | ((thing_class == 0) & ~np.isin(semantic, UNLABELLED))
    return Objects(
        owner,
        owner,
        owner > 0,
        is_counted,
        tuple(THINGS[key >> 16] for key in keys[kept_indices].tolist()),
        horizontal_range(centres),
    )


@dataclass(frozen=True)
class ClusterScore:
    """Scores of the clusters of one frame for K objects.

    Attributes:
        iou: (K,) IoU with the best cluster, 0 if no cluster overlaps.
        pieces: (K,) number of clusters with at least MIN_PIECE_FRACTION of the object's points.
        is_shared: (K,) bool, True if the best cluster also contains a piece of another object.
        cluster_count: Number of clusters.
        scored_count: Number of clusters with most of their points near objects, which are scored.
    """

    iou: np.ndarray
    pieces: np.ndarray
    is_shared: np.ndarray
    cluster_count: int
    scored_count: int


def score_clusters(cluster_ids: np.ndarray, objects: Objects) -> ClusterScore:
    """Score the clusters of a frame.

    Memory grows only with the number of pairs of objects and clusters that share points.

    Args:
        cluster_ids: (N,) int, any id for each cluster, 0 for points without a cluster.
        objects: Labelled objects among the N points.
    """
    labels, numbers = renumber_ids(cluster_ids)
    ids, owner, region, is_near = (
        a.compress(objects.is_counted).astype(np.int64)
        for a in (labels, objects.owner, objects.region, objects.is_near)
    )
    size, rows = np.bincount(ids, minlength=len(numbers) + 1), len(objects.classes) + 1
    points = np.bincount(owner, minlength=rows)
    in_both = (owner > 0) & (ids > 0)
    pairs, shared_points = np.unique(owner[in_both] * len(size) + ids[in_both], return_counts=True)
    region_pairs, region_points = np.unique(region * len(size) + ids, return_counts=True)
    object_index, cluster_index = np.divmod(pairs, len(size))
    # Object points are in the region of the object, so each of the pairs is also one of the region_pairs.
    iou = shared_points / (
        size[cluster_index] + points[object_index] - region_points[np.searchsorted(region_pairs, pairs)]
    )
    is_piece = shared_points >= MIN_PIECE_FRACTION * points[object_index]
    best_iou = np.zeros(rows)
    np.maximum.at(best_iou, object_index, iou)
    has_several_pieces = np.bincount(cluster_index[is_piece], minlength=len(size)) > 1
    is_shared = (
        np.bincount(
            object_index[(iou == best_iou[object_index]) & is_piece & has_several_pieces[cluster_index]], minlength=rows
        )
        > 0
    )
    is_scored = 2 * np.bincount(ids, is_near, minlength=len(size))[1:] > size[1:]
    return ClusterScore(
        best_iou[1:],
        np.bincount(object_index[is_piece], minlength=rows)[1:],
        is_shared[1:],
        len(numbers),
        int(is_scored.sum()),
    )


@dataclass
class ClusterReport:
    """Scores of one clustering method over the frames."""

    frames: list[tuple[tuple[str, ...], np.ndarray, ClusterScore]] = field(default_factory=list)
    ms: list[float] = field(default_factory=list)

    def update(self, classes: tuple[str, ...], ranges: np.ndarray, score: ClusterScore, ms: float) -> None:
        """Add one frame: classes and ranges (K,) of its Objects, its score, and the run time in ms."""
        self.frames.append((classes, ranges, score))
        self.ms.append(ms)

    def compute(self) -> dict:
        """Return the content of the JSON file. Precision is the fraction of scored clusters that are hits."""
        classes = np.array([c for names, _, _ in self.frames for c in names], str)
        ranges = _concatenate(frame_ranges for _, frame_ranges, _ in self.frames)
        bins = np.searchsorted(RANGE_LIMITS, ranges, "right")
        columns = [
            _concatenate(getattr(score, name) for _, _, score in self.frames) for name in ("iou", "pieces", "is_shared")
        ]
        overall = _to_object_row(*columns)
        clusters = sum(score.cluster_count for _, _, score in self.frames)
        scored_clusters = sum(score.scored_count for _, _, score in self.frames)
        hits = overall["hits"]
        return {
            "frames": len(self.frames),
            "ms": _compute_median(self.ms),
            "clusters": clusters,
            "clusters_per_frame": _divide(clusters, len(self.frames)),
            "judged_clusters": scored_clusters,
            **overall,
            "precision": _divide(hits, scored_clusters),
            "f1": _divide(2 * hits, scored_clusters + overall["objects"]),
            "by_class": {
                str(name): _to_object_row(*(c[classes == name] for c in columns)) for name in np.unique(classes)
            },
            "by_range": {name: _to_object_row(*(c[bins == i] for c in columns)) for i, name in enumerate(RANGE_NAMES)},
        }


def _to_object_row(iou: np.ndarray, pieces: np.ndarray, is_shared: np.ndarray) -> dict:
    """Return counts and ratios of K objects. mean_pieces is the mean over objects with a piece."""
    count, hits = len(iou), int(np.sum(iou > HIT_IOU))
    over_segmented, under_segmented = int(np.sum(pieces > 1)), int(np.sum(is_shared))
    return dict(
        objects=count,
        hits=hits,
        recall=_divide(hits, count),
        mean_iou=_divide(float(np.sum(iou)), count),
        over_segmented=over_segmented,
        over_segmentation=_divide(over_segmented, count),
        mean_pieces=float(np.mean(pieces[pieces > 0])) if (pieces > 0).any() else None,
        under_segmented=under_segmented,
        under_segmentation=_divide(under_segmented, count),
    )


def _renumber(ids: np.ndarray, kept_ids: np.ndarray) -> np.ndarray:
    """Map ids (N,) to their position in kept_ids, from 1, and all other ids to 0; return (N,) int32."""
    new_ids = np.zeros(max(ids.max(initial=0), kept_ids.max(initial=0)) + 1, np.int32)
    new_ids[kept_ids] = np.arange(1, len(kept_ids) + 1)
    return new_ids[ids]


def _concatenate(parts) -> np.ndarray:
    return np.concatenate([np.zeros(0), *parts])


def _compute_median(values: list[float]) -> float | None:
    return float(np.median(values)) if values else None


def _divide(numerator: float, denominator: float) -> float:
    return numerator / denominator if denominator else 0.0
