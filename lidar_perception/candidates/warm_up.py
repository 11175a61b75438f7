"""Warm-up of the candidate pipeline: compiles or loads its code before the first cloud."""

from __future__ import annotations

import numpy as np

from lidar_perception.camera import Camera
from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.pipeline import find_candidates
from lidar_perception.candidates.seed_sources import make_automatic_source
from lidar_perception.candidates.seeds import seed_from_points
from lidar_perception.clustering.euclidean import cluster_euclidean
from lidar_perception.clustering.params import EuclideanParams
from lidar_perception.param_fields import with_values
from lidar_perception.runs.compiling import report_compilation
from lidar_perception.types import PointCloud
from lidar_perception.wire.params import ViewParams


@report_compilation(whole_detector=True)
def warm_up() -> None:
    """Run every stage and method once on synthetic points to trigger JIT compilation."""
    rng = np.random.default_rng(0)
    flat = rng.uniform(-20, 20, (600, 3)) * [1, 1, 0.001] - [0, 0, 1.7]
    person = rng.uniform(-0.5, 0.5, (400, 3)) * [0.5, 0.5, 1.7] + [8, 0, -0.8]
    dense = rng.uniform(-0.05, 0.05, (2000, 3)) + [8, 2, 0]  # for DBSCAN by cells
    across = rng.uniform(-0.1, 0.1, (200, 3)) + [15, 0, 0]  # across the limit of two bands
    xyz = np.concatenate([flat, person, person + [12, 0, 0], dense, across]).astype(np.float32)
    seed = seed_from_points(person.astype(np.float32), np.array([8, 0, -0.85, 1, 1, 1.7, 0]))
    forward = Camera(np.array([[50, -100, 0, 0], [50, 0, -100, 0], [1, 0, 0, 0]], float), 100, 100)
    base = PipelineParams(view=ViewParams(enabled=True))
    for ground, clustering, boxes, sure in (("threshold", "dbscan", "axis_aligned", False),
                                            ("cloth", "euclidean", "l_shape", True)):
        params = with_values(base, {
            "ground.method": ground, "clustering.method": clustering, "boxes.shape": boxes,
            "clustering.dbscan.join_bands": True, "confidence.enabled": sure,
            "seed.min_confidence": 0.0})
        find_candidates(PointCloud(xyz), make_automatic_source(seed, params), forward, params)
    for threshold in ("local", "global"):  # the tree, which only dense clouds need
        cluster_euclidean(person.astype(np.float32), EuclideanParams(threshold=threshold), -1, 0)
