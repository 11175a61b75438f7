"""The PointPillars detector: experts, pose, thresholds, bad input, devices."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from detection_samples import (
    are_equal_detections,
    lower_thresholds,
    make_detector,
    make_random_detector,
    make_random_network,
    make_scan,
    make_tiny_config,
)

from lidar_perception.clustering.cluster import cluster
from lidar_perception.clustering.density import measure_density
from lidar_perception.clustering.shapes import classify_by_diagonal, fit_boxes, fit_ellipses
from lidar_perception.detectors.checkpoint import Header
from lidar_perception.detectors.devices import CPU, find_device
from lidar_perception.detectors.normalized_view import NormalizedView, to_sensor_frame
from lidar_perception.detectors.pointpillars.config import VERSIONS
from lidar_perception.detectors.pointpillars.expert import draw_clusters, make_network_input
from lidar_perception.detectors.pointpillars.params import EXPERT_CLUSTERING, EXPERT_GROUND, STEPS
from lidar_perception.detectors.pointpillars.torch_network import TorchNetwork
from lidar_perception.ground.params import SensorPoseParams
from lidar_perception.ground.segment import level_points, segment_ground
from lidar_perception.param_fields import with_values
from lidar_perception.types import CLASSES, Detections, InputError, PointCloud

pytestmark = pytest.mark.usefixtures("one_thread", "keep_ego_detections")
each_version = pytest.mark.parametrize("version", VERSIONS)


# view


def test_view_includes_low_and_excludes_high():
    rng = np.random.default_rng(0)
    xyz = rng.integers(-3, 4, (500, 3)).astype(np.float32)  # many points are on the limits
    xyz[::7, rng.integers(3)] = np.nan
    low, high, height = (-2.0, -1.0, -2.0), (2.0, 3.0, 1.0), 2.73
    source = PointCloud(xyz, rng.random(500, np.float32), 5, "lidar")
    view = NormalizedView.of(source, SensorPoseParams(height=height), low, high)
    shifted_xyz = xyz + np.array([0, 0, height - 1.73], np.float32)
    expected = np.flatnonzero(((shifted_xyz >= low) & (shifted_xyz < high)).all(axis=1))
    np.testing.assert_array_equal(view.indices, expected)
    np.testing.assert_array_equal(view.frame.xyz, shifted_xyz[expected])
    cropped = view.crop((0.0, *low[1:]), high)
    np.testing.assert_array_equal(cropped.indices, expected[shifted_xyz[expected, 0] >= 0])
    assert len(cropped.frame.intensity) == len(cropped) and cropped.frame.frame_id == "lidar"


# experts


@each_version
def test_given_columns_equal_computed_columns(version):
    detector = make_random_detector(version)
    scan = make_scan()
    config = detector.proposer.config
    view = NormalizedView.of(scan, low=config.low, high=config.high)
    indices, view_frame = view.indices, view.frame
    ground = np.zeros(len(scan), bool)
    ground[indices] = segment_ground(view_frame, EXPERT_GROUND)
    ids = np.zeros(len(scan), np.uint32)
    obstacles = indices[~ground[indices]]
    ids[obstacles] = cluster(scan.xyz[obstacles], EXPERT_CLUSTERING, measure_density(view_frame.xyz))
    ids[ids > 0] *= 3  # ids need not be consecutive
    assert ground.any() and ids.max() >= 6
    computed = detector(scan)
    assert len(computed.detections) > 3
    for columns in (ground, None), (None, ids), (ground.astype(np.uint8), ids):
        assert are_equal_detections(detector(scan, ground=columns[0], cluster_ids=columns[1]), computed)


def test_versions_have_the_inputs_of_the_paper():
    scan = make_scan()
    inputs = {}
    for version in VERSIONS:
        config = make_tiny_config(version)
        view_frame = NormalizedView.of(scan, low=config.low, high=config.high).frame
        inputs[version] = make_network_input(view_frame, config)
    ground = segment_ground(view_frame, EXPERT_GROUND)
    assert [i.points.shape[1] for i in inputs.values()] == [4, 4, 5, 5, 4]
    assert [i.cluster_map is not None for i in inputs.values()] == [False] * 4 + [True]
    for version, mask in (
        ("v0", np.ones(len(view_frame), bool)),
        ("v1", ~ground),
        ("v2", ~ground),
        ("v3", np.ones(len(view_frame), bool)),
        ("v4", ~ground),
    ):
        np.testing.assert_array_equal(inputs[version].points[:, :3], view_frame.xyz[mask])
        np.testing.assert_array_equal(inputs[version].points[:, 3], view_frame.intensity[mask])
    np.testing.assert_array_equal(inputs["v3"].points[~ground], inputs["v2"].points)
    assert not inputs["v3"].points[ground, 4].any()
    ids = inputs["v2"].points[:, 4]
    assert {*np.unique(ids)} >= {1, 2} and ids.max() == len(np.unique(ids[ids > 0]))


MAP_CLASSES = ("Car", "Cyclist", "Pedestrian")  # by the channels of paper B


def test_cluster_map_equals_a_plain_loop_over_cells():
    config = make_tiny_config("v4", cell=0.16)
    rng = np.random.default_rng(4)
    centres = rng.uniform([0, -6, 0], [10.5, 6, 0], (25, 3))
    spread = np.linspace(0.02, 3, 25)[:, None, None]
    xyz = (centres[:, None] + rng.normal(size=(25, 40, 3)) * spread * 0.5).reshape(-1, 3)
    xyz, ids = xyz.astype(np.float32), np.repeat(np.arange(25), 40).astype(np.int32)  # 0: no cluster
    class_ids = classify_by_diagonal(fit_boxes(xyz, ids, "min_area"))
    assert {*class_ids} == {-1, *(CLASSES.index(n) for n in MAP_CLASSES)}
    expected = np.zeros((3, *config.grid), np.uint8)
    y, x = np.meshgrid(
        *(low + (np.arange(n) + 0.5) * 0.16 for low, n in zip((config.low[1], config.low[0]), config.grid)),
        indexing="ij",
    )
    for class_id, (cx, cy, a, b, yaw) in zip(class_ids, fit_ellipses(xyz, ids).astype(float)):
        if class_id < 0:
            continue
        u = np.cos(yaw) * (x - cx) + np.sin(yaw) * (y - cy)
        v = np.cos(yaw) * (y - cy) - np.sin(yaw) * (x - cx)
        contains_centre = np.maximum(abs(x - cx), abs(y - cy)) <= 0.08
        expected[MAP_CLASSES.index(CLASSES[class_id])] |= ((u / a) ** 2 + (v / b) ** 2 <= 1) | contains_centre
    image = draw_clusters(xyz, ids, config)
    assert (image != expected).sum() <= 2  # cells whose centre is on the edge of an ellipse
    assert image.shape == (3, 64, 64) and all(layer.any() for layer in image)


def test_cluster_of_collinear_points_is_drawn_at_its_centre():
    config = make_tiny_config("v4")
    xyz = np.float32([[4.1, 1.1, -1], [4.5, 1.1, -0.5], [4.9, 1.1, 0]])
    image = draw_clusters(xyz, np.ones(3, np.int32), config)
    assert np.argwhere(image).tolist() == [[MAP_CLASSES.index("Pedestrian"), int(6.22 / 0.32), int(4.5 / 0.32)]]


# the detector


def test_view_does_not_depend_on_sensor_height():
    config, rng = make_tiny_config(), np.random.default_rng(0)
    scan = PointCloud(rng.uniform([-2, -7, -6], [12, 7, 5], (500, 3)).astype(np.float32))
    view = NormalizedView.of(scan, low=config.low, high=config.high)
    higher_scan = replace(scan, xyz=scan.xyz - np.float32([0, 0, 0.5]))
    higher_view = NormalizedView.of(higher_scan, SensorPoseParams(height=2.23), config.low, config.high)
    assert view.indices.tolist() == higher_view.indices.tolist() and 50 < len(view) < 450
    np.testing.assert_allclose(higher_view.frame.xyz, view.frame.xyz, atol=1e-5)
    low, high = np.array(config.low), np.array(config.high)
    assert (view.frame.xyz >= low).all() and (view.frame.xyz < high).all()


def test_detections_pass_thresholds_sorted_without_overlap():
    detector = make_random_detector("v4")
    result = detector(make_scan())
    detections = result.detections
    assert (np.diff(detections.scores) <= 0).all() and (detections.scores >= 0.25).all()
    assert {*detections.class_ids} <= {CLASSES.index(n) for n in detector.classes}
    assert result.problem is None and list(result.timings) == list(STEPS)
    assert result.timings["network"] > 0
    median_score = float(np.median(detections.scores[detections.class_ids == detections.class_ids[0]]))
    name = CLASSES[detections.class_ids[0]].lower()
    detector.params = with_values(detector.params, {f"pointpillars.scores.{name}": median_score})
    remaining = detector(make_scan()).detections
    assert remaining.scores[remaining.class_ids == detections.class_ids[0]].min() >= median_score
    detector.params = with_values(detector.params, {"pointpillars.nms.max_boxes": 2})
    assert are_equal_detections(detector(make_scan()), remaining[:2])


def test_sensor_height_changes_only_z_of_boxes():
    detector = make_random_detector("v4")
    scan, expected = make_scan(), detector(make_scan()).detections
    higher_scan = replace(scan, xyz=scan.xyz - np.array([0, 0, 0.5], np.float32))
    detector.params = with_values(detector.params, {"ground.sensor_pose.height": 2.23})
    detections = detector(higher_scan).detections
    assert are_equal_detections(
        replace(detections, boxes=detections.boxes + np.float32([0, 0, 0.5, 0, 0, 0, 0])), expected, 1e-3
    )


@pytest.mark.parametrize("roll, pitch", [(3.1416, 0.0), (0.0, 0.2), (0.1, -0.1)])
def test_tilted_sensor_gives_the_same_boxes_in_its_frame(roll, pitch):
    pose = SensorPoseParams(roll=roll, pitch=pitch)
    rotation = level_points(np.eye(3, dtype=np.float32), pose)  # rows: the sensor's axes when level
    detections = Detections.of([[8, 2, -1, 4, 2, 1.5, 0.7]], scores=[0.5])
    box = to_sensor_frame(detections, pose).boxes[0]
    np.testing.assert_allclose(box[:3] @ rotation, [8, 2, -1], atol=1e-5)
    forward = np.array([np.cos(box[6]), np.sin(box[6]), 0]) @ rotation
    assert forward[:2] @ [np.cos(0.7), np.sin(0.7)] > 0.97  # yaw is about the sensor's own z
    assert are_equal_detections(to_sensor_frame(detections, SensorPoseParams()), detections)


def test_intensity_is_normalized_and_may_be_left_out():
    detector, scan = make_random_detector(), make_scan()
    expected = detector(scan)
    assert are_equal_detections(detector(replace(scan, intensity=scan.intensity / 2)), expected)
    reversed_scan = replace(scan, intensity=scan.intensity[::-1].copy())
    assert not are_equal_detections(detector(reversed_scan), expected)
    without_intensity = detector(replace(scan, intensity=None))
    assert "no intensity" in without_intensity.problem
    nan_intensity = np.where(np.arange(len(scan)) % 2, np.float32(np.nan), scan.intensity)
    assert "their intensity is NaN" in detector(replace(scan, intensity=nan_intensity)).problem
    detector.params = with_values(detector.params, {"pointpillars.use_intensity": False})
    for cloud in scan, replace(scan, intensity=None), replace(scan, intensity=nan_intensity):
        assert are_equal_detections(detector(cloud), without_intensity) and detector(cloud).problem is None


@pytest.mark.parametrize(
    "xyz, message",
    [
        (np.zeros((0, 3)), "empty"),
        (np.full((5, 3), np.nan), "network's range"),
        ([[-5, 0, 0], [500, 0, 0]], "network's range"),
    ],
)
@pytest.mark.parametrize("version", ["v0", "v4"])
def test_empty_cloud_is_reported_as_a_problem(version, xyz, message):
    detector = make_random_detector(version)
    result = detector(PointCloud(np.asarray(xyz, np.float32)))
    assert len(result.detections) == 0 and message in result.problem and result.timings["network"] == 0
    assert detector(make_scan()).problem is None


def test_cloud_of_ground_only_is_reported_as_a_problem():
    detector, scan = make_random_detector("v4"), make_scan()
    result = detector(scan, ground=np.ones(len(scan), bool))
    assert len(result.detections) == 0 and "ground.sensor_pose" in result.problem


def test_best_scores_are_reported_if_nothing_is_detected():
    detector, scan = make_random_detector("v4", lower_thresholds(score=0.0)), make_scan()
    assert detector(scan).best == {}
    detections = detector(scan).detections
    best_scores = {
        name: float(detections.scores[detections.class_ids == CLASSES.index(name)].max())
        for name in detector.classes
        if CLASSES.index(name) in detections.class_ids
    }
    result = detector.with_min_score(1.0)(scan)
    assert len(result.detections) == 0 and result.problem is None
    assert list(result.best) == list(detector.classes)
    assert max(result.best.values()) == pytest.approx(max(best_scores.values()))
    assert all(result.best[name] >= score - 1e-6 for name, score in best_scores.items())
    assert are_equal_detections(detector(scan), detections)  # the copy does not change the original
    for parameter in detector.proposer.network.network.head.parameters():
        parameter.fill_(np.nan)
    assert "NaN" in detector(scan).problem


def test_huge_and_non_finite_clouds_are_handled():
    detector, scan = make_random_detector("v2"), make_scan()
    xyz = np.tile(scan.xyz, (250, 1))
    xyz[:5] = [[np.nan, 0, 0], [np.inf, 0, 0], [0, 0, 0], [1e9, 0, 0], [-np.inf, 0, np.nan]]
    assert len(xyz) > 900_000
    result = detector(
        PointCloud(xyz, np.tile(scan.intensity, 250)),
        ground=np.zeros(len(xyz), bool),
        cluster_ids=np.tile(np.arange(len(scan)), 250),
    )
    assert result.problem is None


class OutOfMemory(TorchNetwork):
    """Network that runs out of memory on every device except the CPU."""

    def __init__(self, network):
        super().__init__(network, CPU)
        self.device = "meta"

    def to(self, device):
        self.device = device

    def __call__(self, pillars, maps):
        if self.device != CPU:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory")
        return super().__call__(pillars, maps)


def test_cpu_fallback_after_out_of_memory_is_reported():
    config, scan, meta = make_tiny_config(), make_scan(), "meta"
    detector = make_detector(OutOfMemory(make_random_network(config)), Header(config), lower_thresholds(), meta)
    for _ in range(2):
        result = detector(scan)
        assert are_equal_detections(result, make_random_detector()(scan)) and "CPU" in result.problem
        assert detector.device == CPU
    detector = make_detector(OutOfMemory(make_random_network(config)), Header(config), lower_thresholds(), meta)
    copies = detector.with_min_score(0.5), detector.with_raw_scores()  # these share the network
    detector(scan)
    assert all(copied_detector.device == CPU and "CPU" in copied_detector(scan).problem for copied_detector in copies)
    params = with_values(lower_thresholds(), {"pointpillars.cpu_fallback": False})
    with pytest.raises(InputError, match="out of memory"):
        make_detector(OutOfMemory(make_random_network(config)), Header(config), params, meta)(scan)


@pytest.mark.parametrize(
    "name, message", [("tpu", "unknown device 'tpu'"), ("mps", "unknown device 'mps'"), ("cuda:99", "CUDA device")]
)
def test_missing_device_is_rejected(name, message):
    with pytest.raises(InputError, match=message):
        find_device(name)
    assert find_device("cpu") == CPU
    assert find_device() == ("cuda" if torch.cuda.is_available() else "cpu")
