"""Labelled clusters cut from scenes by ground segmentation and clustering, with a cache.

The network is thus trained on the errors of the pipeline: split and merged objects, and background.
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
from lidar_perception.training.cache import file_fingerprint, load_or_compute, make_cache_path
from lidar_perception.types import CLASSES, SENSOR_HEIGHT, PointCloud

SPARSE_FRACTIONS = 0.08, 0.7  # minimum and maximum fraction of the points that a subsampled scene keeps
MIN_POINTS_LEFT = 3  # minimum points of a cluster in a subsampled or augmented scene
OBJECT_MARGIN_M = 0.3  # margin added to a box when its object is cut out
MAX_DECOYS = 24  # random decoys per scene without a proposer
MAX_RANDOM_DECOYS = 8  # random decoys per scene with a proposer
MAX_PROPOSALS = 14  # decoys of each class per scene from a proposer


@dataclass(frozen=True)
class CutScene:
    """K labelled clusters of a scene.

    Attributes:
        clusters: The clusters.
        labels: (K,) int64, see scoring.points.clusters.label_clusters.
        boxes: (K, 7) float64 boxes of the objects, 0 for background.
        is_box_crop: (K,) bool, True for clusters that were cut out with the box of an object or
            decoy instead of by clustering.
    """

    clusters: Clusters
    labels: np.ndarray
    boxes: np.ndarray
    is_box_crop: np.ndarray


@dataclass(frozen=True)
class CutScenes:
    """Source whose load_scene(i) is the CutScene of scene i, see cut_clusters.

    Attributes:
        scenes: Source of scenes.
        config: Configuration of the network, with ground segmentation and clustering.
        min_points: Clusters with fewer points are ignored.
        cache: Folder of cached clusters, or None.
        proposer: PointPillars checkpoint whose wrong proposals become decoys, or None.
        sparse: Fraction of the scenes that are subsampled before the cut, to imitate a sparser
            sensor. The choice depends only on the number of the scene.
    """

    scenes: Any
    config: PointNetConfig
    min_points: int = 5
    cache: Path | None = None
    proposer: Path | None = None
    sparse: float = 0.0

    def __len__(self) -> int:
        return len(self.scenes)

    def load_frame(self, i: int) -> Frame:
        """Return the frame of scene i for validation."""
        return self.scenes.load_frame(i)

    def draw_fraction(self, i: int) -> float:
        """Return the fraction of the points to which scene i is subsampled."""
        rng = np.random.default_rng(i)
        if rng.random() >= self.sparse:
            return 1.0
        return float(np.exp(rng.uniform(*np.log(SPARSE_FRACTIONS))))

    def cache_file(self, i: int) -> Path | None:
        """Return the cache file of scene i."""
        proposer = [] if self.proposer is None else [file_fingerprint(self.proposer)]
        fractions = [fraction] if (fraction := self.draw_fraction(i)) < 1 else []
        return make_cache_path(
            self.cache,
            self.scenes.cache_key(i),
            self.config.ground,
            self.config.clustering,
            self.config.classes,
            self.min_points,
            *proposer,
            *fractions,
        )

    def load_scene(self, i: int) -> CutScene:
        """Return the clusters of scene i. Raise InputError if the scene cannot be read."""
        return load_or_compute(self.cache_file(i), lambda: self._cut(i), _from_arrays, _to_arrays)

    def _cut(self, i: int) -> CutScene:
        scene, min_points, fraction = self.scenes.load_scene(i), self.min_points, self.draw_fraction(i)
        if fraction < 1:
            indices = draw_subset(len(scene.points), fraction, str(i))
            scene = replace(scene, points=scene.points[indices])
            min_points = min(min_points, MIN_POINTS_LEFT)
        return cut_clusters(scene, self.config, min_points, self.proposer)


def cut_clusters(
    scene: TrainingScene, config: PointNetConfig, min_points: int, proposer: Path | None = None
) -> CutScene:
    """Cut a scene into labelled clusters in the frame of a sensor at SENSOR_HEIGHT.

    The clusters are followed by box crops: the points around each detectable object, and decoys,
    which are background cut in the same way. They are needed because the network also classifies
    the points in the boxes of a detector. Clusters of objects that are not detectable are labelled
    UNKNOWN.

    Args:
        config: Configuration of the network, with ground segmentation and clustering.
        min_points: Clusters with fewer points are ignored.
        proposer: PointPillars checkpoint whose wrong proposals become decoys, or None.
    """
    raw_xyz = scene.points[:, :3]  # clustering adapts to the density in the sensor's frame
    scene = raise_scene(scene, scene.height - SENSOR_HEIGHT)
    frame = PointCloud(np.ascontiguousarray(scene.points[:, :3]), normalize_intensity(scene.points[:, 3]))
    ground = segment_ground(frame, config.ground)
    clusters = make_clusters(
        frame, cluster_obstacles(frame.xyz, ground, config.clustering, raw_xyz), min_points, ground
    )
    labels, owners = label_clusters(clusters, scene.boxes, scene.class_ids, config.classes)
    is_hidden = (owners >= 0) & ~np.append(scene.detectable, False)[owners]
    labels[is_hidden], owners[is_hidden] = UNKNOWN, -1
    boxes = np.zeros((len(clusters), 7))
    boxes[owners >= 0] = scene.boxes[owners[owners >= 0]]
    background = len(config.classes)
    objects = [i for i in np.flatnonzero(scene.detectable) if CLASSES[scene.class_ids[i]] in config.classes]
    decoys = drop_touching(make_decoys(clusters.take(np.flatnonzero(labels == background)), config), scene.boxes)
    proposals = np.zeros((0, 7))
    if proposer is not None:
        decoys = decoys[:MAX_RANDOM_DECOYS]
        proposals = drop_touching(propose_boxes(frame, proposer), scene.boxes)
    crop_regions = np.concatenate([scene.boxes[objects].reshape(-1, 7), proposals, decoys])
    crop_labels = np.append(
        [config.classes.index(CLASSES[scene.class_ids[i]]) for i in objects],
        np.full(len(crop_regions) - len(objects), background),
    ).astype(np.int64)
    obstacles = frame.take(np.flatnonzero(~ground))
    crops = crop_boxes(crop_regions, obstacles, OBJECT_MARGIN_M)
    indices = np.flatnonzero(crops.sizes >= min_points)
    crops = crops.take(indices).with_ground(frame.xyz.compress(ground, axis=0))
    all_clusters = Clusters(
        np.concatenate([clusters.points, crops.points]),
        np.concatenate([clusters.first, clusters.first[-1] + crops.first[1:]]),
        np.concatenate([clusters.ids, np.full(len(crops), -1)]),
        np.concatenate([clusters.ground, crops.ground]),
    )
    return CutScene(
        all_clusters,
        np.concatenate([labels, crop_labels[indices]]),
        np.concatenate([boxes, crop_regions[indices]]),
        np.arange(len(all_clusters)) >= len(clusters),
    )


def make_decoys(background: Clusters, config: PointNetConfig) -> np.ndarray:
    """Return boxes (D, 7) of object size on random background clusters, D <= MAX_DECOYS.

    Each box is near the mean of a cluster and stands on the ground. The result is deterministic.
    """
    rng = np.random.default_rng(len(background.points))
    clusters = background.take(rng.permutation(len(background))[:MAX_DECOYS])
    centres = compute_centroids(clusters.points, clusters.first)
    sizes = np.array(config.sizes)[rng.integers(len(config.sizes), size=len(clusters))]
    sizes = sizes * rng.uniform(0.9, 1.15, sizes.shape)
    return np.column_stack(
        [
            centres + rng.normal(0, 0.2, centres.shape),
            clusters.floor + sizes[:, 2] / 2,
            sizes,
            rng.uniform(-np.pi, np.pi, len(clusters)),
        ]
    )


def propose_boxes(frame: PointCloud, proposer: Path) -> np.ndarray:
    """Return the MAX_PROPOSALS best proposals (P, 7) of PointPillars for each class.

    Args:
        frame: Cloud of a sensor at SENSOR_HEIGHT.
        proposer: Checkpoint of PointPillars.
    """
    proposals = _load_proposer(proposer).propose(frame).detections
    return np.concatenate([proposals.boxes[proposals.class_ids == i][:MAX_PROPOSALS] for i in range(len(CLASSES))])


@lru_cache(maxsize=1)
def _load_proposer(path: Path) -> PointPillarsDetector:
    """Load a proposer, once per process, with the score threshold of `fused`."""
    params = DetectorParams(pointpillars=PointPillarsParams(warm_up=False))
    return load_detector(path, "cpu", params).with_raw_scores().with_min_score(FusedParams().proposals)


def drop_touching(candidates: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Return the candidate boxes (D, 7) that touch no labelled box (M, 7)."""
    enlarged_boxes = boxes + [0, 0, 0, 2 * OBJECT_MARGIN_M, 2 * OBJECT_MARGIN_M, 0, 0]
    return candidates[~(bev_iou(candidates, enlarged_boxes) > 0).any(axis=1)]


def _to_arrays(scene: CutScene) -> dict[str, np.ndarray]:
    return dict(**vars(scene.clusters), labels=scene.labels, boxes=scene.boxes, loose=scene.is_box_crop)


def _from_arrays(arrays: Any) -> CutScene:
    clusters = Clusters(*(arrays[name] for name in ("points", "first", "ids", "ground")))
    return CutScene(clusters, arrays["labels"], arrays["boxes"], arrays["loose"])
