"""Ground and clusters against labels of points (SemanticKITTI) or boxes (KITTI, bags).

Ground is road, parking, sidewalk, other-ground, lane-marking and terrain; unlabelled points and
outliers are ignored. There are three protocols, since vegetation changes F1 by several points:

    without vegetation     vegetation is ignored (Patchwork++, Lee et al., IROS 2022, Section IV-A);
    with vegetation        vegetation is ground below z = -1.3 m in the LiDAR frame of KITTI, 0.43 m
    above the road, else not ground (Patchwork, Lim et al., RA-L 2021);
    vegetation not ground  vegetation is not ground.

A cluster and an object are compared by their points: IoU = |C and O| / |C or O|. A hit is an IoU
above one half, so a cluster hits at most one object. Points of an object that were segmented as
ground count as missed.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from lidar_perception.data.semantickitti import GROUND, MOVING, THINGS, UNLABELLED, VEGETATION
from lidar_perception.geometry import horizontal_range, points_in_box
from lidar_perception.groups import renumber_ids
from lidar_perception.types import CLASSES, GroundTruth

PROTOCOLS = ("without vegetation", "with vegetation", "vegetation not ground")
LOW_VEGETATION_Z = -1.3  # in metres, in KITTI's LiDAR frame, which is 1.73 m above the road

HIT_IOU = 0.5
MIN_POINTS = 10  # objects with fewer points are ignored
BOTTOM_MARGIN = 0.2  # in metres above the bottom of a box; lower points may be road
BOX_MARGIN = 0.2  # in metres; a cluster is scored if most of its points are in boxes enlarged by this
MIN_PIECE_SHARE = 0.1  # minimum fraction of an object's points for a cluster to be a piece of it
RANGE_NAMES = ("0-15", "15-30", "30-45", "45+")
RANGE_LIMITS = np.array([15.0, 30.0, 45.0])


def select_true_ground(semantic: np.ndarray, z: np.ndarray, protocol: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the masks ground (N,) and counted (N,) of points.

    Args:
        semantic: (N,) classes.
        z: (N,) height as seen from KITTI's sensor, metres.
        protocol: one of PROTOCOLS.
    """
    ground, counted = np.isin(semantic, GROUND), ~np.isin(semantic, UNLABELLED)
    vegetation = semantic == VEGETATION
    if protocol == "without vegetation":
        counted &= ~vegetation
    elif protocol == "with vegetation":
        ground |= vegetation & (z < LOW_VEGETATION_Z)
    return ground, counted


def count_ground(found: np.ndarray, ground: np.ndarray, counted: np.ndarray) -> np.ndarray:
    """Count the predicted ground, found (N,) bool, as (4,) int64 [tp fp fn tn]."""
    case = np.where(ground, np.where(found, 0, 2), np.where(found, 1, 3))
    return np.bincount(case.compress(counted), minlength=4)


def count_by_protocol(found: np.ndarray, semantic: np.ndarray, z: np.ndarray) -> dict[str, np.ndarray]:
    """Count the predicted ground, found (N,) bool, by protocol; see select_true_ground."""
    return {name: count_ground(found, *select_true_ground(semantic, z, name)) for name in PROTOCOLS}


def to_ground_row(counts: np.ndarray) -> dict:
    """Return counts (4,) and their ratios for the JSON file. A ratio without cases is 0."""
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
        """Add one scan: counts of count_by_protocol and the duration of the method."""
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
        owner: (N,) int32 object 1..K of each point, or 0.
        region: (N,) int32 owner, and also points that are neutral for clusters of that object.
        near: (N,) bool points whose clusters are scored.
        counted: (N,) bool points with a known class; the others are ignored.
        classes: K names.
        ranges: (K,) horizontal range, metres.
    """

    owner: np.ndarray
    region: np.ndarray
    near: np.ndarray
    counted: np.ndarray
    classes: tuple[str, ...]
    ranges: np.ndarray


def find_objects_in_boxes(xyz: np.ndarray, truth: GroundTruth) -> Objects:
    """Return the objects of labelled boxes, except DontCare, with at least MIN_POINTS points.

    A box contains some of the road, so an object's points are more than BOTTOM_MARGIN above the
    bottom of the box; lower ones are neutral. A point in two boxes belongs to the smaller one.
    """
    owner, region = np.zeros((2, len(xyz)), np.int32)
    for k in np.argsort(-np.prod(truth.boxes[:, 3:6], axis=1), kind="stable"):
        box = truth.boxes[k]
        if CLASSES[truth.class_ids[k]] != "DontCare":
            inside = points_in_box(xyz, box)
            region[inside] = k + 1
            owner[inside] = np.where(xyz[inside, 2] > box[2] - box[5] / 2 + BOTTOM_MARGIN, k + 1, 0)
    chosen = np.flatnonzero(np.bincount(owner, minlength=len(truth) + 1)[1:] >= MIN_POINTS)
    near = np.zeros(len(xyz), bool)
    for box in truth.boxes[chosen]:
        near |= points_in_box(xyz, box, BOX_MARGIN)
    return Objects(
        _renumber(owner, chosen + 1),
        _renumber(region, chosen + 1),
        near,
        np.ones(len(xyz), bool),
        tuple(truth.labels[k] for k in chosen),
        np.hypot(*truth.boxes[chosen, :2].T),
    )


def find_instances(xyz: np.ndarray, semantic: np.ndarray, instance: np.ndarray) -> Objects:
    """Return the objects of SemanticKITTI with at least MIN_POINTS points.

    An object is the points of one class and instance, moving or not. Unlabelled points, outliers,
    things without an instance and smaller objects are ignored.
    """
    table = np.zeros(1 << 16, np.int32)
    table[list(THINGS)] = list(THINGS)
    table[list(MOVING)] = list(MOVING.values())
    thing = table[semantic]
    keys, which, counts = np.unique(
        np.where((thing > 0) & (instance > 0), thing << 16 | instance, 0), return_inverse=True, return_counts=True
    )
    chosen = np.flatnonzero((keys > 0) & (counts >= MIN_POINTS))
    owner = _renumber(which.reshape(-1), chosen)
    sums = [np.bincount(owner, axis, minlength=len(chosen) + 1)[1:] for axis in xyz[:, :2].T]
    centres = np.stack(sums, axis=1) / counts[chosen, None]
    counted = (owner > 0) | ((thing == 0) & ~np.isin(semantic, UNLABELLED))
    return Objects(
        owner,
        owner,
        owner > 0,
        counted,
        tuple(THINGS[key >> 16] for key in keys[chosen].tolist()),
        horizontal_range(centres),
    )


@dataclass(frozen=True)
class ClusterScore:
    """Clusters of one frame against K objects.

    Attributes:
        iou: (K,) IoU with the best cluster, 0 without one.
        pieces: (K,) number of clusters with at least MIN_PIECE_SHARE of the object's points.
        shared: (K,) bool, True if the best cluster is also a piece of another object.
        clusters: number of clusters.
        judged: number of clusters with most of their points near objects.
    """

    iou: np.ndarray
    pieces: np.ndarray
    shared: np.ndarray
    clusters: int
    judged: int


def score_clusters(cluster_ids: np.ndarray, objects: Objects) -> ClusterScore:
    """Score the clusters cluster_ids (N,) int, 0 = none, of a frame.

    The result does not depend on the numbers of the clusters. Memory grows with the pairs of
    objects and clusters that share points only.
    """
    labels, numbers = renumber_ids(cluster_ids)
    ids, owner, region, near = (
        a.compress(objects.counted).astype(np.int64) for a in (labels, objects.owner, objects.region, objects.near)
    )
    size, rows = np.bincount(ids, minlength=len(numbers) + 1), len(objects.classes) + 1
    points = np.bincount(owner, minlength=rows)
    both = (owner > 0) & (ids > 0)
    pairs, common = np.unique(owner[both] * len(size) + ids[both], return_counts=True)
    touched, inside = np.unique(region * len(size) + ids, return_counts=True)
    thing, cluster = np.divmod(pairs, len(size))
    # the points of an object are in its region, so each pair is also a pair of the regions
    iou = common / (size[cluster] + points[thing] - inside[np.searchsorted(touched, pairs)])
    piece = common >= MIN_PIECE_SHARE * points[thing]
    best = np.zeros(rows)
    np.maximum.at(best, thing, iou)
    several = np.bincount(cluster[piece], minlength=len(size)) > 1
    shared = np.bincount(thing[(iou == best[thing]) & piece & several[cluster]], minlength=rows) > 0
    judged = 2 * np.bincount(ids, near, minlength=len(size))[1:] > size[1:]
    return ClusterScore(
        best[1:], np.bincount(thing[piece], minlength=rows)[1:], shared[1:], len(numbers), int(judged.sum())
    )


@dataclass
class ClusterReport:
    """Scores of one clustering method over the frames."""

    frames: list[tuple[tuple[str, ...], np.ndarray, ClusterScore]] = field(default_factory=list)
    ms: list[float] = field(default_factory=list)

    def update(self, classes: tuple[str, ...], ranges: np.ndarray, score: ClusterScore, ms: float) -> None:
        """Add one frame: classes and ranges (K,) of its Objects, its score, and the duration."""
        self.frames.append((classes, ranges, score))
        self.ms.append(ms)

    def compute(self) -> dict:
        """Return the content of the JSON file. precision is hits / judged clusters."""
        classes = np.array([c for names, _, _ in self.frames for c in names], str)
        ranges = _concatenate(each for _, each, _ in self.frames)
        bins = np.searchsorted(RANGE_LIMITS, ranges, "right")
        columns = [
            _concatenate(getattr(score, name) for _, _, score in self.frames) for name in ("iou", "pieces", "shared")
        ]
        everything = _to_object_row(*columns)
        clusters, judged = (sum(getattr(score, name) for _, _, score in self.frames) for name in ("clusters", "judged"))
        hits = everything["hits"]
        return {
            "frames": len(self.frames),
            "ms": _compute_median(self.ms),
            "clusters": clusters,
            "clusters_per_frame": _divide(clusters, len(self.frames)),
            "judged_clusters": judged,
            **everything,
            "precision": _divide(hits, judged),
            "f1": _divide(2 * hits, judged + everything["objects"]),
            "by_class": {
                str(name): _to_object_row(*(c[classes == name] for c in columns)) for name in np.unique(classes)
            },
            "by_range": {name: _to_object_row(*(c[bins == i] for c in columns)) for i, name in enumerate(RANGE_NAMES)},
        }


def _to_object_row(iou: np.ndarray, pieces: np.ndarray, shared: np.ndarray) -> dict:
    """mean_pieces is the mean over objects with a piece; 1 is no over-segmentation."""
    count, hits = len(iou), int(np.sum(iou > HIT_IOU))
    over, under = int(np.sum(pieces > 1)), int(np.sum(shared))
    return dict(
        objects=count,
        hits=hits,
        recall=_divide(hits, count),
        mean_iou=_divide(float(np.sum(iou)), count),
        over_segmented=over,
        over_segmentation=_divide(over, count),
        mean_pieces=float(np.mean(pieces[pieces > 0])) if (pieces > 0).any() else None,
        under_segmented=under,
        under_segmentation=_divide(under, count),
    )


def _renumber(ids: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Map ids (N,) to their position 1.. in chosen, else 0, as (N,) int32."""
    table = np.zeros(max(ids.max(initial=0), chosen.max(initial=0)) + 1, np.int32)
    table[chosen] = np.arange(1, len(chosen) + 1)
    return table[ids]


def _concatenate(parts) -> np.ndarray:
    return np.concatenate([np.zeros(0), *parts])


def _compute_median(values: list[float]) -> float | None:
    return float(np.median(values)) if values else None


def _divide(part: float, whole: float) -> float:
    return part / whole if whole else 0.0
