"""Scenes to labelled clusters, cut by the package's own ground and clustering, with a cache.

So a network sees the errors that it will see later: objects in pieces, objects merged, background.
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
from lidar_perception.detectors.pointnet.clusters import Clusters, clusters_of, middles, points_of
from lidar_perception.detectors.pointnet.config import PointNetConfig
from lidar_perception.detectors.pointpillars.detector import PointPillarsDetector, load_detector
from lidar_perception.detectors.pointpillars.params import DetectorParams, PointPillarsParams
from lidar_perception.geometry import bev_iou
from lidar_perception.ground.segment import segment_ground
from lidar_perception.scoring.points.clusters import UNKNOWN, labelled
from lidar_perception.scoring.thinning import drawn
from lidar_perception.training.augment import TrainingScene, raised
from lidar_perception.training.cache import kept, path_in, state_of
from lidar_perception.types import CLASSES, SENSOR_HEIGHT, LidarFrame

SPARSE = 0.08, 0.7  # of the points stay where a scene is thinned,
FEWEST = 3          # and a cluster counts there that has so many left
AROUND = 0.3  # m: points so near to an object are looked at, too
DECOYS = 24    # in a scene, at most
PROPOSED = 14  # proposals of each class among them, where there is a proposer,
MADE_UP = 8    # and others beside those


@dataclass(frozen=True)
class CutScene:
    """K clusters with labels (K,) int64 of scoring.points.clusters.labelled; boxes (K, 7) float64
    of the objects, 0 where there is none. loose (K,) bool: not made by clustering but all around an
    object, or decoy, that is not ground."""

    clusters: Clusters
    labels: np.ndarray
    boxes: np.ndarray
    loose: np.ndarray


@dataclass(frozen=True)
class CutScenes:
    """scene(i): the clusters of a scene of `scenes`, as a network of the config is to see them, of
    min_points or more. cache: folder for them, or None. proposer: a file of PointPillars' weights
    whose proposals are among the decoys, or None. sparse: so many of the scenes, 0..1, are thinned
    as a whole before they are cut, as a sparser sensor would see them; always the same ones."""

    scenes: Any
    config: PointNetConfig
    min_points: int = 5
    cache: Path | None = None
    proposer: Path | None = None
    sparse: float = 0.0

    def __len__(self) -> int:
        return len(self.scenes)

    def frame(self, i: int) -> Frame:
        """The frame that it is cut from, to validate on."""
        return self.scenes.frame(i)

    def share(self, i: int) -> float:
        """Of the points of scene i that stay."""
        rng = np.random.default_rng(i)
        if rng.random() >= self.sparse:
            return 1.0
        return float(np.exp(rng.uniform(*np.log(SPARSE))))

    def path(self, i: int) -> Path | None:
        """The file that keeps the clusters of scene i."""
        proposer = [] if self.proposer is None else [state_of(self.proposer)]
        thinned = [share] if (share := self.share(i)) < 1 else []
        return path_in(self.cache, self.scenes.key(i), self.config.ground, self.config.clustering,
                       self.config.classes, self.min_points, *proposer, *thinned)

    def keep(self, i: int) -> None:
        """Put it into the cache."""
        self.scene(i)

    def scene(self, i: int) -> CutScene:
        """InputError naming the file that cannot be used."""
        return kept(self.path(i), lambda: self._cut(i), _read, _arrays)

    def _cut(self, i: int) -> CutScene:
        scene, least, share = self.scenes.scene(i), self.min_points, self.share(i)
        if share < 1:
            left = drawn(len(scene.points), share, str(i))
            scene, least = replace(scene, points=scene.points[left]), min(least, FEWEST)
        return cut(scene, self.config, least, self.proposer)


def cut(scene: TrainingScene, config: PointNetConfig, min_points: int,
        proposer: Path | None = None) -> CutScene:
    """The clusters of a scene, as from SENSOR_HEIGHT; after them the points around each object that
    is wanted, and decoys: background cut out in the same way, as the network judges what is in a
    detector's boxes, too; some of them where a proposer is wrong. A cluster of an object that is
    not wanted is UNKNOWN."""
    sensed = scene.points[:, :3]  # whose density counts, as where the network is used
    scene = raised(scene, scene.height - SENSOR_HEIGHT)
    frame = LidarFrame(np.ascontiguousarray(scene.points[:, :3]), scene.points[:, 3].copy())
    ground = segment_ground(frame, config.ground)
    clusters = clusters_of(frame, cluster_obstacles(frame.xyz, ground, config.clustering, sensed),
                           min_points, ground)
    labels, owners = labelled(clusters, scene.boxes, scene.class_ids, config.classes)
    hidden = (owners >= 0) & ~np.append(scene.wanted, False)[owners]
    labels[hidden], owners[hidden] = UNKNOWN, -1
    boxes = np.zeros((len(clusters), 7))
    boxes[owners >= 0] = scene.boxes[owners[owners >= 0]]
    background = len(config.classes)
    wanted = [i for i in np.flatnonzero(scene.wanted)
              if CLASSES[scene.class_ids[i]] in config.classes]
    made_up = elsewhere(decoys(clusters.take(np.flatnonzero(labels == background)), config),
                        scene.boxes)
    proposed = np.zeros((0, 7))
    if proposer is not None:
        made_up, proposed = made_up[:MADE_UP], elsewhere(proposals(frame, proposer), scene.boxes)
    around = np.concatenate([scene.boxes[wanted].reshape(-1, 7), proposed, made_up])
    of_around = np.append([config.classes.index(CLASSES[scene.class_ids[i]]) for i in wanted],
                          np.full(len(around) - len(wanted), background)).astype(np.int64)
    obstacles = frame.take(np.flatnonzero(~ground))
    loose = points_of(around, obstacles, AROUND)
    kept = np.flatnonzero(loose.sizes >= min_points)
    loose = loose.take(kept).on(frame.xyz.compress(ground, axis=0))
    both = Clusters(np.concatenate([clusters.points, loose.points]),
                    np.concatenate([clusters.first, clusters.first[-1] + loose.first[1:]]),
                    np.concatenate([clusters.ids, np.full(len(loose), -1)]),
                    np.concatenate([clusters.ground, loose.ground]))
    return CutScene(both, np.concatenate([labels, of_around[kept]]),
                    np.concatenate([boxes, around[kept]]), np.arange(len(both)) >= len(clusters))


def decoys(background: Clusters, config: PointNetConfig) -> np.ndarray:
    """(D, 7) boxes as large as objects, at most DECOYS, each at the mean of a background cluster
    and on the ground there. The same clusters give the same."""
    rng = np.random.default_rng(len(background.points))
    chosen = rng.permutation(len(background))[:DECOYS]
    own = background.take(chosen)
    places = middles(own.points, own.first)
    sizes = np.array(config.sizes)[rng.integers(len(config.sizes), size=len(own))]
    sizes = sizes * rng.uniform(0.9, 1.15, sizes.shape)
    return np.column_stack([places + rng.normal(0, 0.2, places.shape),
                            own.floor + sizes[:, 2] / 2, sizes,
                            rng.uniform(-np.pi, np.pi, len(own))])


def proposals(frame: LidarFrame, proposer: Path) -> np.ndarray:
    """(P, 7) boxes that PointPillars with these weights proposes at SENSOR_HEIGHT, as low as its
    score is: the best of each class, at most PROPOSED."""
    found = _proposer(proposer).propose(frame).detections
    return np.concatenate([found.boxes[found.class_ids == i][:PROPOSED]
                           for i in range(len(CLASSES))])


@lru_cache(maxsize=1)
def _proposer(path: Path) -> PointPillarsDetector:
    """One for each process, with the least score of fused."""
    params = DetectorParams(pointpillars=PointPillarsParams(warm_up=False))
    return load_detector(path, "cpu", params).raw().with_min_score(FusedParams().proposals)


def elsewhere(found: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Those of boxes (D, 7) that touch none of the labelled ones (M, 7)."""
    room = boxes + [0, 0, 0, 2 * AROUND, 2 * AROUND, 0, 0]
    return found[~(bev_iou(found, room) > 0).any(axis=1)]


def _arrays(scene: CutScene) -> dict[str, np.ndarray]:
    return dict(**vars(scene.clusters), labels=scene.labels, boxes=scene.boxes, loose=scene.loose)


def _read(arrays: Any) -> CutScene:
    clusters = Clusters(*(arrays[name] for name in ("points", "first", "ids", "ground")))
    return CutScene(clusters, arrays["labels"], arrays["boxes"], arrays["loose"])
