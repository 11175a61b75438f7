"""Labelled clusters, cut from scenes by the package's own ground and clustering, with a cache.

So the network is trained on the errors of the pipeline: split and merged objects, and background.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from lidar_perception.clustering.cluster import cluster_obstacles
from lidar_perception.data.frame import Frame
from lidar_perception.detectors.fused.params import FusedParams
from lidar_perception.detectors.pointnet.clusters import Clusters, compute_centroids, crop_boxes, make_clusters
from lidar_perception.detectors.pointnet.config import PointNetConfig
from lidar_perception.detectors.pointpillars.detector import PointPillarsDetector, load_detector
from lidar_perception.detectors.pointpillars.params import DetectorParams, PointPillarsParams
from lidar_perception.geometry import bev_iou
from lidar_perception.ground.segment import segment_ground
from lidar_perception.intensity import normalize_intensity
from lidar_perception.scoring.detections import draw_subset
from lidar_perception.scoring.points.clusters import UNKNOWN, label_clusters
from lidar_perception.training.augment import TrainingScene, raise_scene
from lidar_perception.training.cache import cache_path, file_fingerprint, load_or_make
from lidar_perception.types import CLASSES, SENSOR_HEIGHT, PointCloud

SPARSE_SHARES = 0.08, 0.7  # minimum and maximum fraction of points left in a sparse scene
MIN_POINTS_LEFT = 3  # minimum points left of a cluster in a sparse or augmented scene
OBJECT_MARGIN_M = 0.3  # points this close to an object are cut out with it
MAX_DECOYS = 24  # number of random decoys in a scene without a proposer
MAX_PROPOSALS = 14  # maximum proposals of each class in a scene with a proposer
MAX_RANDOM_DECOYS = 8  # number of random decoys in a scene with a proposer


@dataclass(frozen=True)
class CutScene:
    """K clusters of a scene.

    Attributes:
        clusters: The clusters.
        labels: (K,) int64, as scoring.points.clusters.labelled gives them.
        boxes: (K, 7) float64 boxes of the objects, 0 for background.
        loose: (K,) bool, True for clusters that are not made by clustering but consist of all
            obstacle points around an object or decoy.
    """

    clusters: Clusters
    labels: np.ndarray
    boxes: np.ndarray
    loose: np.ndarray


@dataclass(frozen=True)
class CutScenes:
    """A source whose scene(i) is the CutScene of scene i, see cut_clusters.

    Attributes:
        min_points: Clusters with fewer points are left out.
        cache: Folder that keeps the clusters, or None.
        proposer: PointPillars checkpoint whose wrong proposals become decoys, or None.
        sparse: Share of the scenes that lose points before they are cut, as from a sparser
            sensor; always the same ones.
    """

    scenes: Any
    config: PointNetConfig
    min_points: int = 5
    cache: Path | None = None
    proposer: Path | None = None
    sparse: float = 0.0

    def __len__(self) -> int:
        return len(self.scenes)

    def frame(self, i: int) -> Frame:
        """Return the frame of scene i, to validate on."""
        return self.scenes.frame(i)

    def draw_share(self, i: int) -> float:
        """Return the share of its points that scene i keeps."""
        rng = np.random.default_rng(i)
        if rng.random() >= self.sparse:
            return 1.0
        return float(np.exp(rng.uniform(*np.log(SPARSE_SHARES))))

    def path(self, i: int) -> Path | None:
        """Return the cache file of scene i."""
        proposer = [] if self.proposer is None else [file_fingerprint(self.proposer)]
        sparse = [share] if (share := self.draw_share(i)) < 1 else []
        return cache_path(
            self.cache,
            self.scenes.key(i),
            self.config.ground,
            self.config.clustering,
            self.config.classes,
            self.min_points,
            *proposer,
            *sparse,
        )

    def keep(self, i: int) -> None:
        """Put the clusters of scene i into the cache."""
        self.scene(i)

    def scene(self, i: int) -> CutScene:
        """Return the clusters of scene i. Raise InputError, naming the file, for a broken scene."""
        return load_or_make(self.path(i), lambda: self._cut(i), _from_arrays, _to_arrays)

    def _cut(self, i: int) -> CutScene:
        scene, min_points, share = self.scenes.scene(i), self.min_points, self.draw_share(i)
        if share < 1:
            left = draw_subset(len(scene.points), share, str(i))
            scene = replace(scene, points=scene.points[left])
            min_points = min(min_points, MIN_POINTS_LEFT)
        return cut_clusters(scene, self.config, min_points, self.proposer)


def cut_clusters(
    scene: TrainingScene, config: PointNetConfig, min_points: int, proposer: Path | None = None
) -> CutScene:
    """Cut a scene into labelled clusters, as from a sensor at SENSOR_HEIGHT.

    After the clusters come the loose ones: the points around each wanted object, and decoys, which
    are background cut out in the same way. The network needs both, since it also classifies the
    points in a detector's boxes. Clusters of objects that are not wanted are UNKNOWN.

    Args:
        min_points: Clusters with fewer points are left out.
        proposer: PointPillars checkpoint, some of whose wrong proposals become decoys.
    """
    sensed = scene.points[:, :3]  # clustering uses the density that the sensor sees
    scene = raise_scene(scene, scene.height - SENSOR_HEIGHT)
    frame = PointCloud(np.ascontiguousarray(scene.points[:, :3]), normalize_intensity(scene.points[:, 3]))
    ground = segment_ground(frame, config.ground)
    clusters = make_clusters(frame, cluster_obstacles(frame.xyz, ground, config.clustering, sensed), min_points, ground)
    labels, owners = label_clusters(clusters, scene.boxes, scene.class_ids, config.classes)
    unwanted = (owners >= 0) & ~np.append(scene.wanted, False)[owners]
    labels[unwanted], owners[unwanted] = UNKNOWN, -1
    boxes = np.zeros((len(clusters), 7))
    boxes[owners >= 0] = scene.boxes[owners[owners >= 0]]
    background = len(config.classes)
    wanted = [i for i in np.flatnonzero(scene.wanted) if CLASSES[scene.class_ids[i]] in config.classes]
    decoys = drop_touching(make_decoys(clusters.take(np.flatnonzero(labels == background)), config), scene.boxes)
    proposed = np.zeros((0, 7))
    if proposer is not None:
        decoys = decoys[:MAX_RANDOM_DECOYS]
        proposed = drop_touching(propose_boxes(frame, proposer), scene.boxes)
    cut_boxes = np.concatenate([scene.boxes[wanted].reshape(-1, 7), proposed, decoys])
    cut_labels = np.append(
        [config.classes.index(CLASSES[scene.class_ids[i]]) for i in wanted],
        np.full(len(cut_boxes) - len(wanted), background),
    ).astype(np.int64)
    obstacles = frame.take(np.flatnonzero(~ground))
    loose = crop_boxes(cut_boxes, obstacles, OBJECT_MARGIN_M)
    kept = np.flatnonzero(loose.sizes >= min_points)
    loose = loose.take(kept).with_ground(frame.xyz.compress(ground, axis=0))
    both = Clusters(
        np.concatenate([clusters.points, loose.points]),
        np.concatenate([clusters.first, clusters.first[-1] + loose.first[1:]]),
        np.concatenate([clusters.ids, np.full(len(loose), -1)]),
        np.concatenate([clusters.ground, loose.ground]),
    )
    return CutScene(
        both,
        np.concatenate([labels, cut_labels[kept]]),
        np.concatenate([boxes, cut_boxes[kept]]),
        np.arange(len(both)) >= len(clusters),
    )


def make_decoys(background: Clusters, config: PointNetConfig) -> np.ndarray:
    """Return boxes (D, 7) of object size on background clusters, the same for the same clusters.

    At most MAX_DECOYS, each near the mean of a cluster and on the ground there.
    """
    rng = np.random.default_rng(len(background.points))
    chosen = rng.permutation(len(background))[:MAX_DECOYS]
    own = background.take(chosen)
    centres = compute_centroids(own.points, own.first)
    sizes = np.array(config.sizes)[rng.integers(len(config.sizes), size=len(own))]
    sizes = sizes * rng.uniform(0.9, 1.15, sizes.shape)
    return np.column_stack(
        [
            centres + rng.normal(0, 0.2, centres.shape),
            own.floor + sizes[:, 2] / 2,
            sizes,
            rng.uniform(-np.pi, np.pi, len(own)),
        ]
    )


def propose_boxes(frame: PointCloud, proposer: Path) -> np.ndarray:
    """Return the boxes (P, 7) that PointPillars proposes at any score.

    Args:
        frame: Cloud of a sensor at SENSOR_HEIGHT.
        proposer: Checkpoint of PointPillars.

    Returns:
        The best MAX_PROPOSALS boxes of each class.
    """
    found = _load_proposer(proposer).propose(frame).detections
    return np.concatenate([found.boxes[found.class_ids == i][:MAX_PROPOSALS] for i in range(len(CLASSES))])


@lru_cache(maxsize=1)
def _load_proposer(path: Path) -> PointPillarsDetector:
    """Load a proposer with the lowest score that `fused` uses, once in each process."""
    params = DetectorParams(pointpillars=PointPillarsParams(warm_up=False))
    return load_detector(path, "cpu", params).with_raw_scores().with_min_score(FusedParams().proposals)


def drop_touching(found: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Return those of boxes (D, 7) that touch none of the labelled boxes (M, 7)."""
    enlarged = boxes + [0, 0, 0, 2 * OBJECT_MARGIN_M, 2 * OBJECT_MARGIN_M, 0, 0]
    return found[~(bev_iou(found, enlarged) > 0).any(axis=1)]


def _to_arrays(scene: CutScene) -> dict[str, np.ndarray]:
    return dict(**vars(scene.clusters), labels=scene.labels, boxes=scene.boxes, loose=scene.loose)


def _from_arrays(arrays: Any) -> CutScene:
    clusters = Clusters(*(arrays[name] for name in ("points", "first", "ids", "ground")))
    return CutScene(clusters, arrays["labels"], arrays["boxes"], arrays["loose"])
