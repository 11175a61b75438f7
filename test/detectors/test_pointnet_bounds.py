"""The work of PointNet is bounded for any number of clusters."""

from __future__ import annotations

import numpy as np
import pytest
from pointnet_samples import accept_every_cluster, make_random_detector

from lidar_perception.detectors.pointnet.clusters import find_ground_heights
from lidar_perception.detectors.pointnet.torch_network import CHUNK
from lidar_perception.param_fields import with_values
from lidar_perception.types import PointCloud

pytestmark = pytest.mark.usefixtures("one_thread")


def test_clusters_of_any_size_and_number_are_accepted():
    rng = np.random.default_rng(0)
    detector = make_random_detector(with_values(accept_every_cluster(), {"pointnet.min_points": 1}))
    network, batches = detector.classifier.network, []
    network.compiled = None
    network.network.register_forward_hook(lambda net, arguments, _: batches.append(len(arguments[0])))
    single_point = PointCloud(np.float32([[9, 0, -1]]), np.ones(1, np.float32))
    assert len(detector(single_point, cluster_ids=np.ones(1, int)).detections) == 1
    xyz = rng.uniform([5, -3, -1.7], [9, 3, 2], (50_000, 3)).astype(np.float32)
    large_cloud = PointCloud(xyz, rng.uniform(0, 1, len(xyz)).astype(np.float32))
    assert len(detector(large_cloud, cluster_ids=np.ones(len(xyz), int)).detections) == 1
    centres = rng.uniform(-80, 80, (5000, 1, 3)) * [1, 1, 0.01]
    xyz = (centres + rng.normal(0, 0.2, (5000, 6, 3))).reshape(-1, 3).astype(np.float32)
    batches.clear()
    result = detector(PointCloud(xyz, np.zeros(len(xyz), np.float32)), cluster_ids=np.repeat(np.arange(5000), 6) + 1)
    assert sum(batches) == 4000 and max(batches) <= CHUNK
    assert len(result.detections) == detector.params.pointnet.nms.max_boxes
    assert "farthest 1000 of 5000 clusters are ignored" in result.problem


def test_most_distant_excess_clusters_are_dropped_and_counted():
    rng = np.random.default_rng(0)
    centres = np.column_stack([np.linspace(4, 60, 300), rng.uniform(-3, 3, 300), np.zeros(300)])
    rng.shuffle(centres)
    xyz = (np.repeat(centres, 6, axis=0) + rng.normal(0, 0.02, (1800, 3))).astype(np.float32)
    frame = PointCloud(xyz, np.full(1800, 0.5, np.float32))
    ids, ground = np.repeat(np.arange(1, 301), 6), np.zeros(1800, bool)

    def detect(params, mask=None):
        cluster_ids = ids if mask is None else np.where(mask, ids, 0)
        return make_random_detector(with_values(params, {"pointnet.use_intensity": False}))(
            frame, ground=ground, cluster_ids=cluster_ids
        )

    limited_params = with_values(accept_every_cluster(), {"pointnet.max_clusters": 40})
    limited_result, full_result = detect(limited_params), detect(accept_every_cluster())
    assert "farthest 260 of 300 clusters are ignored" in limited_result.problem
    assert "left out" not in (full_result.problem or "")
    means = np.add.reduceat(xyz, np.arange(0, 1800, 6)) / 6
    nearest = np.argsort(np.hypot(means[:, 0], means[:, 1]))[:40] + 1
    expected = detect(accept_every_cluster(), np.isin(ids, nearest))
    np.testing.assert_array_equal(limited_result.detections.boxes, expected.detections.boxes)
    assert 0 < len(limited_result.detections) < len(full_result.detections)


def test_ground_height_does_not_depend_on_distant_clusters():
    rng = np.random.default_rng(1)
    ground = rng.uniform([-40, -40, -1.8], [40, 40, -1.6], (5000, 3)).astype(np.float32)
    positions = rng.uniform(-30, 30, (50, 2))
    heights = find_ground_heights(ground, positions)
    distant_positions = np.array([[9e4, -9e4], [-9e4, 9e4]])
    all_heights = find_ground_heights(ground, np.concatenate([positions, distant_positions]))
    np.testing.assert_array_equal(all_heights[:50], heights)
