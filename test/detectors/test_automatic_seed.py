"""The automatic seed: clusters that PointNet classifies as pedestrians."""

from __future__ import annotations

import numpy as np
import pytest
from candidate_samples import make_floor, make_person

from lidar_perception.candidates.configurations import BEST
from lidar_perception.candidates.params import SeedParams
from lidar_perception.candidates.pipeline import find_candidates, segment_cloud
from lidar_perception.candidates.segmented_cloud import SegmentedCloud
from lidar_perception.detectors.automatic_seed import classify_pedestrians, make_automatic_source
from lidar_perception.geometry import points_in_box
from lidar_perception.param_fields import with_values
from lidar_perception.simulation.drive import simulate_scan
from lidar_perception.simulation.scene import Scenes
from lidar_perception.simulation.sensor import HDL64E
from lidar_perception.types import PEDESTRIAN, PointCloud

PARAMS = with_values(BEST, {"view.enabled": False})


@pytest.fixture(scope="module")
def scan():
    return simulate_scan(4, 0, HDL64E, Scenes(None, 12.0))


def test_automatic_seeds_are_pedestrians_by_confidence(scan):
    seeds = make_automatic_source(SeedParams(min_confidence=0.8))(segment_cloud(scan.frame, params=PARAMS))
    confidences = [seed.confidence for seed in seeds]
    assert len(seeds) >= 3
    assert confidences == sorted(confidences, reverse=True) and min(confidences) >= 0.8
    pedestrians = scan.truth.select_class(PEDESTRIAN)
    assert all(max(points_in_box(seed.xyz, box).mean() for box in pedestrians) > 0.5 for seed in seeds)


def test_automatic_seed_does_not_depend_on_sensor_height(scan):
    lower = PointCloud(scan.frame.xyz + np.float32([0, 0, 1.0]), scan.frame.intensity)
    params = with_values(PARAMS, {"ground.sensor_pose.height": PARAMS.ground.sensor_pose.height - 1.0})
    expected, actual = (
        classify_pedestrians(segment_cloud(cloud, params=p)) for cloud, p in ((scan.frame, PARAMS), (lower, params))
    )
    assert len(actual) == len(expected) > 10
    assert np.mean(np.abs(actual - expected) < 0.05) > 0.9


@pytest.mark.parametrize(
    "xyz", [np.zeros((0, 3)), make_floor(), make_person(6, 0, count=9)], ids=["empty", "only ground", "nine points"]
)
def test_clouds_without_a_person_have_no_seed_and_no_candidates(xyz):
    params = with_values(PARAMS, {"clustering.dbscan.min_samples": 3, "seed.min_confidence": 0.0})
    source = make_automatic_source(params.seed)
    segmented, candidates = find_candidates(PointCloud(xyz.astype(np.float32)), source, params=params)
    assert source(segmented) == ()
    assert len(candidates.stage1) == len(candidates.final) == 0


@pytest.mark.parametrize("point", [(np.nan, 0, 0), (0, 0, np.inf), (2e7, -2e7, 0)], ids=["NaN", "inf", "far"])
def test_unusable_and_distant_ground_points_have_no_effect(scan, point):
    segmented = segment_cloud(scan.frame, params=PARAMS)
    extended = SegmentedCloud(
        np.arange(len(segmented.xyz) + 1),
        np.concatenate([segmented.xyz, np.float32([point])]),
        np.append(segmented.ground, True),
        np.append(segmented.cluster_ids, np.int32(0)),
        segmented.boxes,
        intensity=np.append(segmented.intensity, np.float32(0.2)),
    )
    np.testing.assert_allclose(classify_pedestrians(extended), classify_pedestrians(segmented), atol=0.01)


def test_cloud_has_no_seed_if_no_cluster_is_probable_enough(scan):
    segmented = segment_cloud(scan.frame, params=PARAMS)
    assert make_automatic_source(SeedParams(min_confidence=1.0))(segmented) == ()
