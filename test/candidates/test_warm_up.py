"""Warm-up compiles exactly the code that a node runs."""

from __future__ import annotations

import subprocess
import sys

import numba
import pytest

COUNT = """
import sys
import numpy as np
from numba.core.dispatcher import Dispatcher
from lidar_perception.types import PointCloud

def compiled():
    return {f"{name}.{key}": len(value.signatures) for name, module in [*sys.modules.items()]
            if name.startswith("lidar_perception") for key, value in vars(module).items()
            if isinstance(value, Dispatcher) and value.signatures}

rng = np.random.default_rng(1)
walls = rng.uniform([5, -9, -1], [5.1, 9, 2], (20_000, 3))
spread = rng.uniform([-40, -40, -1.8], [40, 40, -1.7], (20_000, 3))
dense = rng.normal([12, 3, 0], 0.05, (8_000, 3))
people = rng.uniform(-0.3, 0.3, (900, 3)) * [1, 1, 3] + (
    [[15, 0, -0.8], [30, 5, -0.8], [9, -4, -0.8]] * 300)
cloud = PointCloud(np.concatenate([walls, spread, dense, people]).astype(np.float32))
"""
NODES = (
    COUNT
    + """
from lidar_perception.candidates.warm_up import (
    warm_up_candidates, warm_up_clustering, warm_up_ground)
from lidar_perception.candidates.params import PipelineParams
from lidar_perception.clustering.cluster import cluster_obstacles
from lidar_perception.ground.segment import segment_ground
from lidar_perception.param_fields import with_values

params = with_values(PipelineParams(), {
    "ground.method": "cloth", "clustering.method": sys.argv[1],
    "clustering.density": float(sys.argv[2])})
warm_up_ground(params.ground)
assert not any(".clustering.cells" in name or ".dbscan" in name or ".tree" in name
               for name in compiled()), compiled()
warm_up_clustering(params.clustering, params.boxes)
assert not any(".candidates." in name for name in compiled()), compiled()
before = compiled()
ground = segment_ground(cloud, params.ground)
assert cluster_obstacles(cloud.xyz, ground, params.clustering).max() > 0
assert compiled() == before, {k: v for k, v in compiled().items() if before.get(k) != v}
"""
)
DETECTOR = (
    COUNT
    + """
import lidar_perception
detector = lidar_perception.load_detector(sys.argv[1], device="cpu")
before = compiled()
detector(cloud)
assert compiled() == before, {k: v for k, v in compiled().items() if before.get(k) != v}
"""
)
TRACKER = (
    COUNT
    + """
from lidar_perception.tracking.tracker import Tracker, warm_up
from lidar_perception.types import Detections

warm_up()
before, tracker = compiled(), Tracker()
for frame in range(1, 9):
    boxes = rng.uniform([-40, -40, -2, 1, 1, 1, -3], [40, 40, 0, 5, 2, 2, 3], (100, 7))
    tracker(Detections.of(boxes.astype(np.float32), np.arange(100) % 3, np.full(100, 0.9)),
            frame * 10**8)
assert before and compiled() == before, {k: v for k, v in compiled().items() if before.get(k) != v}
"""
)
needs_numba = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="Numba compiles nothing")


@needs_numba
@pytest.mark.parametrize("detector", ["fused", "pointpillars", "pointnet"])
def test_dense_cloud_compiles_nothing_once_a_detector_is_loaded(detector):
    subprocess.run([sys.executable, "-c", DETECTOR, detector], check=True)


@needs_numba
@pytest.mark.parametrize("method, density", [("dbscan", 0), ("euclidean", 0), ("euclidean", 9)])
def test_cloud_after_warm_up_compiles_nothing(method, density):
    subprocess.run([sys.executable, "-c", NODES, method, str(density)], check=True)


@needs_numba
def test_tracks_after_warm_up_compile_nothing():
    subprocess.run([sys.executable, "-c", TRACKER], check=True)
