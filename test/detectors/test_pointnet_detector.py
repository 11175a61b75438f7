"""The PointNet detector: clusters, pose, thresholds, bad input."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from detection_samples import are_equal_detections, make_scan
from pointnet_samples import (
    CPU,
    accept_every_cluster,
    make_classifier,
    make_random_detector,
    make_random_network,
    make_small_config,
)

from lidar_perception.clustering.cluster import cluster_obstacles
from lidar_perception.detectors.checkpoint import Header
from lidar_perception.detectors.contract import DetectionResult
from lidar_perception.detectors.normalized_view import to_sensor_frame
from lidar_perception.detectors.pointnet.detector import PointNetDetector
from lidar_perception.detectors.pointnet.params import STEPS, PointNetDetectorParams
from lidar_perception.ground.params import SensorPoseParams
from lidar_perception.ground.segment import level_points, segment_ground
from lidar_perception.param_fields import with_values
from lidar_perception.types import CLASSES, Detections, InputError, PointCloud

pytestmark = pytest.mark.usefixtures("one_thread", "keep_ego_detections")

GROUND, CLUSTERING = PointNetDetectorParams().ground, PointNetDetectorParams().clustering


@pytest.fixture(scope="module")
def cluster_ids() -> np.ndarray:
    """Cluster ids of the points of make_scan()."""
    found = cluster_obstacles(make_scan().xyz, segment_ground(make_scan(), GROUND), CLUSTERING)
    assert found.max() >= 5
    return found


def move_detections(detections: Detections, angle: float = 0.0, shift=(0, 0, 0)) -> Detections:
    """Rotate a frame about the sensor's z axis, then shift it."""
    boxes = detections.boxes.astype(np.float64)
    cos, sin = np.cos(angle), np.sin(angle)
    boxes[:, :2] = boxes[:, :2] @ np.array([[cos, sin], [-sin, cos]])
    boxes[:, :3] += shift
    boxes[:, 6] += angle
    return replace(detections, boxes=boxes)


def are_almost_equal(a: Detections | DetectionResult, b: Detections | DetectionResult, atol: float = 1e-4) -> bool:
    """Return True if both are equal; detections with almost equal scores may be swapped."""
    a, b = (x.detections if isinstance(x, DetectionResult) else x for x in (a, b))
    if len(a) != len(b):
        return False
    unmatched = set(range(len(b)))
    for box, class_id, score in zip(a.boxes, a.class_ids, a.scores):
        matches = [
            i
            for i in unmatched
            if np.allclose(b.boxes[i, :6], box[:6], atol=atol)
            and np.cos(b.boxes[i, 6] - box[6]) > 1 - atol
            and b.class_ids[i] == class_id
            and abs(b.scores[i] - score) < atol
        ]
        if not matches:
            return False
        unmatched.remove(matches[0])
    return True


# clusters


def test_given_columns_equal_computed_columns(cluster_ids):
    detector, scan = make_random_detector(), make_scan()
    computed = detector(scan).detections
    assert len(computed) > 3 and len(set(computed.class_ids)) > 1
    ground = segment_ground(scan, GROUND)
    for columns in (
        dict(cluster_ids=cluster_ids),
        dict(ground=ground),
        dict(ground=ground.astype("u1")),
        dict(cluster_ids=cluster_ids.astype(np.uint32), ground=ground),
    ):
        assert are_equal_detections(detector(scan, **columns), computed)


def test_cluster_ids_do_not_matter(cluster_ids):
    detector, scan = make_random_detector(), make_scan()
    expected = detector(scan, cluster_ids=cluster_ids).detections
    assert are_equal_detections(
        detector(scan, cluster_ids=np.where(cluster_ids > 0, cluster_ids + 100_000, 0)), expected
    )
    assert are_equal_detections(detector(scan, cluster_ids=np.where(cluster_ids > 0, cluster_ids, -1)), expected)
    large_ids = np.where(cluster_ids > 0, cluster_ids.astype(np.int64) * 2**40, -(2**50))
    assert are_equal_detections(detector(scan, cluster_ids=large_ids), expected)
    permutation = np.random.default_rng(0).permutation(cluster_ids.max()) + 1
    permuted_ids = np.concatenate([[0], permutation])[cluster_ids]
    assert not np.array_equal(permuted_ids, cluster_ids) and are_almost_equal(
        detector(scan, cluster_ids=permuted_ids), expected
    )


def test_clusters_are_classified_independently(cluster_ids):
    detector, scan = make_random_detector(), make_scan()
    expected = detector(scan, cluster_ids=cluster_ids).detections
    single_results = [
        detector(scan, cluster_ids=np.where(cluster_ids == i, cluster_ids, 0)).detections
        for i in range(1, cluster_ids.max() + 1)
    ]
    combined = Detections(
        *(
            np.concatenate([getattr(result, name) for result in single_results])
            for name in ("boxes", "class_ids", "scores")
        )
    )
    assert are_almost_equal(combined, expected)


def test_frame_without_clusters_is_reported_as_a_problem(cluster_ids):
    detector, scan = make_random_detector(), make_scan()
    no_clusters = np.zeros(len(scan), np.int32)
    sparse_cloud = PointCloud(np.float32([[9, 0, -1], [20, 3, 0]]), np.zeros(2, np.float32))
    for cloud, columns, message in (
        (PointCloud(np.zeros((0, 3), np.float32)), {}, "empty"),
        (PointCloud.of(np.full((5, 3), np.nan, np.float32)), {}, "no finite point"),
        (scan, {"cluster_ids": no_clusters}, "no clusters"),
        (scan, {"cluster_ids": no_clusters - 1}, "no clusters"),
        (sparse_cloud, {}, "no clusters"),
        (scan, {"ground": np.ones(len(scan), bool)}, "no clusters"),
        (scan, {"cluster_ids": np.arange(len(scan))}, "fewer than 3 points"),
    ):
        result = detector(cloud, **columns)
        assert len(result.detections) == 0 and message in result.problem, message
        assert result.best == {} and list(result.timings) == list(STEPS)
        result = detector(scan, cluster_ids=cluster_ids)
        assert result.problem is None and result.timings["network"] > 0


# sensor pose


def test_rotated_scene_has_rotated_boxes(cluster_ids):
    detector, scan = make_random_detector(), make_scan()
    detections = detector(scan, cluster_ids=cluster_ids).detections
    cos, sin = np.cos(2.0), np.sin(2.0)
    rotation = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
    rotated_scan = replace(scan, xyz=(scan.xyz @ rotation).astype(np.float32))
    assert are_almost_equal(detector(rotated_scan, cluster_ids=cluster_ids), move_detections(detections, 2.0), 2e-3)


def test_sensor_height_changes_only_z_of_boxes(cluster_ids):
    detector, scan = make_random_detector(), make_scan()
    params = {"clustering.density": 0.0}  # the density depends on the viewpoint
    for columns in {"cluster_ids": cluster_ids}, {}:
        detector.params = with_values(accept_every_cluster(), params)
        detections = detector(scan, **columns).detections
        higher_scan = replace(scan, xyz=scan.xyz - np.float32([0, 0, 0.5]))
        # heights are relative to the nearby ground, so no parameter is needed
        assert are_almost_equal(detector(higher_scan, **columns), move_detections(detections, shift=(0, 0, -0.5)), 1e-3)
        detector.params = with_values(accept_every_cluster(), params | {"ground.sensor_pose.height": 2.23})
        assert are_almost_equal(detector(higher_scan, **columns), move_detections(detections, shift=(0, 0, -0.5)), 1e-3)


@pytest.mark.parametrize("roll, pitch", [(3.1416, 0.0), (0.0, 0.2)])
def test_tilted_sensor_gives_the_same_boxes_in_its_frame(roll, pitch, cluster_ids):
    pose = SensorPoseParams(roll=roll, pitch=pitch)
    detector, scan = make_random_detector(), make_scan()
    detections = detector(scan, cluster_ids=cluster_ids).detections
    rotation = level_points(np.eye(3, dtype=np.float32), pose).T
    detector.params = with_values(
        accept_every_cluster(),
        {"ground.sensor_pose.roll": roll, "ground.sensor_pose.pitch": pitch, "pointnet.nms.iou": 1.0},
    )
    tilted_detections = detector(replace(scan, xyz=scan.xyz @ rotation), cluster_ids=cluster_ids).detections
    detector.params = with_values(accept_every_cluster(), {"pointnet.nms.iou": 1.0})
    assert (
        are_almost_equal(
            tilted_detections, to_sensor_frame(detector(scan, cluster_ids=cluster_ids).detections, pose), 2e-3
        )
        and len(detections) > 3
    )


# scores, boxes, intensity


def test_detections_pass_thresholds_sorted_without_overlap(cluster_ids):
    detector, scan = make_random_detector(), make_scan()
    detections = detector(scan, cluster_ids=cluster_ids).detections
    assert (np.diff(detections.scores) <= 0).all() and len(detections) > 3
    middle = float(np.median(detections.scores[detections.class_ids == detections.class_ids[0]]))
    name = CLASSES[detections.class_ids[0]].lower()
    detector.params = with_values(accept_every_cluster(), {f"pointnet.scores.{name}": middle})
    remaining = detector(scan, cluster_ids=cluster_ids).detections
    assert remaining.scores[remaining.class_ids == detections.class_ids[0]].min() >= np.float32(middle)
    others = detections[detections.class_ids != detections.class_ids[0]]
    assert len(others) and are_equal_detections(remaining[remaining.class_ids != detections.class_ids[0]], others)
    detector.params = with_values(accept_every_cluster(), {"pointnet.nms.max_boxes": 2})
    assert are_equal_detections(detector(scan, cluster_ids=cluster_ids), detections[:2])
    split_ids = cluster_ids.copy()  # two clusters of one object: one of their boxes remains
    rows = np.flatnonzero(cluster_ids == 1)
    split_ids[rows[::2]] = cluster_ids.max() + 1
    detector.params = with_values(accept_every_cluster(), {"pointnet.nms.iou": 1.0})
    all_detections = detector(scan, cluster_ids=split_ids).detections
    detector.params = with_values(
        accept_every_cluster(), {"pointnet.nms.iou": 0.05, "pointnet.nms.across_classes": True}
    )
    assert len(all_detections) > len(detector(scan, cluster_ids=split_ids).detections)


def test_best_scores_are_reported_if_nothing_is_detected(cluster_ids):
    detector, scan = make_random_detector(), make_scan()
    detections = detector(scan, cluster_ids=cluster_ids).detections
    assert detector(scan, cluster_ids=cluster_ids).best == {} and len(detections) == cluster_ids.max()
    result = detector.with_min_score(1.0)(scan, cluster_ids=cluster_ids)
    assert len(result.detections) == 0 and result.problem is None
    assert list(result.best) == ["Car", "Pedestrian", "Cyclist"]
    assert max(result.best.values()) == pytest.approx(detections.scores.max())
    assert are_equal_detections(
        detector(scan, cluster_ids=cluster_ids), detections
    )  # the copy does not change the original


@pytest.mark.parametrize("layer", ["classes", "box"])
def test_nan_outputs_are_dropped_and_reported(layer, cluster_ids):
    detector, scan = make_random_detector(), make_scan()
    dark_scan = replace(scan, intensity=np.where(cluster_ids == 2, np.float32(0), scan.intensity))
    expected = detector(dark_scan, cluster_ids=np.where(cluster_ids == 2, 0, cluster_ids)).detections
    intensity = np.where(cluster_ids == 2, np.float32(np.nan), scan.intensity)
    result = detector(replace(scan, intensity=intensity), cluster_ids=cluster_ids)
    assert are_equal_detections(result, expected)
    assert f"1 of {cluster_ids.max()} clusters" in result.problem and "NaN" in result.problem
    network = detector.classifier.network.network
    getattr(network, layer).bias.fill_(np.nan)
    broken_detector = PointNetDetector(make_classifier(network, detector.classifier.header), detector.params)
    result = broken_detector(scan, cluster_ids=cluster_ids)
    assert len(result.detections) == 0 and "NaN" in result.problem


def test_intensity_is_normalized_and_may_be_left_out(cluster_ids):
    detector, scan = make_random_detector(), make_scan()
    detections = detector(scan, cluster_ids=cluster_ids).detections
    dimmed_scan = replace(scan, intensity=scan.intensity / 2)
    assert are_equal_detections(detector(dimmed_scan, cluster_ids=cluster_ids), detections)
    reversed_scan = replace(scan, intensity=scan.intensity[::-1].copy())
    assert not are_equal_detections(detector(reversed_scan, cluster_ids=cluster_ids), detections)
    without_intensity = detector(replace(scan, intensity=None), cluster_ids=cluster_ids)
    assert "no intensity" in without_intensity.problem
    detector.params = with_values(accept_every_cluster(), {"pointnet.use_intensity": False})
    nan_intensity = np.full_like(scan.intensity, np.nan)
    for cloud in scan, replace(scan, intensity=None), replace(scan, intensity=nan_intensity):
        detections = detector(cloud, cluster_ids=cluster_ids)
        assert are_equal_detections(detections, without_intensity) and detections.problem is None


# devices


def test_cpu_fallback_after_out_of_memory_is_reported(cluster_ids, monkeypatch):
    """Simulate a GPU without memory."""
    from lidar_perception.detectors.pointnet import classifier as module

    scan, expected, original_predict = (
        make_scan(),
        make_random_detector()(make_scan(), cluster_ids=cluster_ids),
        module.predict,
    )
    detector = make_random_detector()

    def predict(network, clusters, **labels):
        if detector.device != CPU:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory")
        return original_predict(network, clusters, **labels)

    monkeypatch.setattr(module, "predict", predict)
    detector.classifier.placement.device = "meta"
    for _ in range(2):
        result = detector(scan, cluster_ids=cluster_ids)
        assert are_equal_detections(result, expected) and "CPU" in result.problem and detector.device == CPU
    detector.classifier.placement.device = "meta"
    detector.params = with_values(accept_every_cluster(), {"pointnet.cpu_fallback": False})
    with pytest.raises(InputError, match="out of memory"):
        detector(scan, cluster_ids=cluster_ids)


def test_class_id_of_a_single_class_network_is_kept(cluster_ids):
    config = make_small_config(classes=("Pedestrian",), sizes=make_small_config().sizes[1:2])
    detections = PointNetDetector(make_classifier(make_random_network(config), Header(config)), accept_every_cluster())(
        make_scan(), cluster_ids=cluster_ids
    ).detections
    assert len(detections) > 3 and {*detections.class_ids} == {CLASSES.index("Pedestrian")}
