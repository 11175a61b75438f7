"""The PointNet detector: clusters, pose, thresholds, bad input, weights."""

from __future__ import annotations

import json
import struct
from dataclasses import replace

import numpy as np
import pytest
import torch
from cli_samples import evaluate_detection as evaluate
from detection_samples import are_equal_detections, make_scan
from detection_samples import make_random_network as lively_pointpillars
from detection_samples import make_tiny_config as tiny_pointpillars
from pointnet_samples import (
    CPU,
    accept_every_cluster,
    make_classifier,
    make_random_detector,
    make_random_network,
    make_small_config,
)
from samples import write_object_folder

from lidar_perception.clustering.cluster import cluster_obstacles
from lidar_perception.detectors import weights_file
from lidar_perception.detectors.checkpoint import Header, read_header, save_checkpoint
from lidar_perception.detectors.checkpoint import Header as PointPillarsHeader
from lidar_perception.detectors.contract import DetectionResult
from lidar_perception.detectors.normalized_view import to_sensor_frame
from lidar_perception.detectors.open import open_detector
from lidar_perception.detectors.pointnet.detector import PointNetDetector, load_pointnet_detector
from lidar_perception.detectors.pointnet.network import load_pointnet
from lidar_perception.detectors.pointnet.params import STEPS, PointNetDetectorParams
from lidar_perception.detectors.pointpillars.detector import PointPillarsDetector
from lidar_perception.detectors.pointpillars.network import load_network
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


def test_columns_of_wrong_length_are_rejected():
    for column in "cluster_ids", "ground":
        with pytest.raises(InputError, match=f"{column} has 3 values"):
            make_random_detector()(make_scan(), **{column: np.zeros(3, int)})


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


# weights


@pytest.fixture
def checkpoints(tmp_path):
    """Return checkpoints of both networks."""
    config, pointpillars_config = make_small_config(), tiny_pointpillars("v4")
    header = Header(config, {"data": "simulated"}, {"accuracy": 0.9}, "abc123")
    save_checkpoint(tmp_path / "n.safetensors", make_random_network(config), header)
    save_checkpoint(
        tmp_path / "p.safetensors", lively_pointpillars(pointpillars_config), PointPillarsHeader(pointpillars_config)
    )
    return tmp_path / "n.safetensors", tmp_path / "p.safetensors", header


def copy_with_header(path, out, **changes):
    """Copy a checkpoint with changed values in its header; None removes them."""
    content = path.read_bytes()
    length = struct.unpack("<Q", content[:8])[0]
    names = json.loads(content[8 : 8 + length])
    header = {**json.loads(names["__metadata__"]["lidar_perception"]), **changes}
    names["__metadata__"]["lidar_perception"] = json.dumps({k: v for k, v in header.items() if v is not None})
    text = json.dumps(names).encode()
    out.write_bytes(struct.pack("<Q", len(text)) + text + content[8 + length :])
    return out


def test_checkpoint_survives_saving_and_loading(checkpoints, tmp_path):
    path, pointpillars_path, header = checkpoints
    assert read_header(path) == header and header.network == "pointnet"
    loaded_header, loaded = load_pointnet(path, header.config)
    assert loaded_header == header
    for name, value in make_random_network(header.config).state_dict().items():
        assert torch.equal(loaded.state_dict()[name], value), name
    save_checkpoint(tmp_path / "half", loaded, header, half=True)
    assert (tmp_path / "half").stat().st_size < path.stat().st_size
    detector = load_pointnet_detector(path, "cpu", accept_every_cluster())
    assert are_equal_detections(detector(make_scan()), make_random_detector()(make_scan()), 1e-5)
    old_file = copy_with_header(
        pointpillars_path, tmp_path / "first.safetensors", network=None
    )  # older checkpoints lack this key
    assert read_header(pointpillars_path).network == read_header(old_file).network == "pointpillars"
    assert load_network(old_file)[0] == load_network(pointpillars_path)[0]


def test_weights_of_another_network_or_classes_are_rejected(checkpoints, tmp_path):
    path, pointpillars_path, header = checkpoints
    with pytest.raises(InputError, match=r"contains a PointNet .*pointnet_detector.*PointPillars"):
        load_network(path)
    with pytest.raises(InputError, match=r"contains a PointPillars .*pointpillars_detector"):
        load_pointnet(pointpillars_path)
    unknown_network = copy_with_header(path, tmp_path / "u.safetensors", network="transformer")
    for read in read_header, load_network:
        with pytest.raises(InputError, match="'transformer'; supported: "):
            read(unknown_network)
    two_classes = make_small_config(classes=("Car", "Pedestrian"), sizes=header.config.sizes[:2])
    with pytest.raises(InputError, match=r"classes is .*Cyclist.*expected"):
        load_pointnet(path, two_classes)
    config = json.loads(header.to_json())["config"]
    for change, message in (
        (dict(classes=two_classes.classes, sizes=two_classes.sizes), "do not match its header"),
        (dict(classes=("Car", "Dog", "Cyclist")), "unknown class 'Dog'"),
        (dict(colour=1), "'colour'"),
    ):
        changed_file = copy_with_header(path, tmp_path / "c.safetensors", config={**config, **change})
        with pytest.raises(InputError, match=message) as error:
            load_pointnet(changed_file)
        assert "\n" not in str(error.value)


def test_class_id_of_a_single_class_network_is_kept(cluster_ids):
    config = make_small_config(classes=("Pedestrian",), sizes=make_small_config().sizes[1:2])
    detections = PointNetDetector(make_classifier(make_random_network(config), Header(config)), accept_every_cluster())(
        make_scan(), cluster_ids=cluster_ids
    ).detections
    assert len(detections) > 3 and {*detections.class_ids} == {CLASSES.index("Pedestrian")}


def test_load_detector_opens_both_networks(checkpoints, tmp_path):
    path, pointpillars_path, _ = checkpoints
    pointnet, pointpillars = open_detector(path, "cpu"), open_detector(pointpillars_path, "cpu")
    assert isinstance(pointnet, PointNetDetector) and isinstance(pointpillars, PointPillarsDetector)
    assert pointnet.params.clustering == CLUSTERING and pointnet.params.ground == GROUND
    ablated_config = make_small_config(dynamic_threshold=False)
    save_checkpoint(tmp_path / "a.safetensors", make_random_network(ablated_config), Header(ablated_config))
    clustering = open_detector(tmp_path / "a.safetensors", "cpu").params.clustering
    assert clustering == ablated_config.clustering != CLUSTERING
    for detector in pointnet, pointpillars:
        result = detector(make_scan())
        assert result.timings["network"] > 0 and result.problem is None
    for name, message in ("none.safetensors", "checkpoint not found"), ("none.onnx", "onnx"):
        with pytest.raises(InputError, match=message):
            open_detector(tmp_path / name)
    (tmp_path / "text").write_text("hello")
    with pytest.raises(InputError, match="not a checkpoint, or is truncated"):
        open_detector(tmp_path / "text")


def test_evaluate_runs_both_networks(checkpoints, tmp_path):
    kitti = write_object_folder(tmp_path / "kitti")
    for path in checkpoints[:2]:
        content, _ = evaluate(tmp_path, "--data", kitti, "--weights", path, "--device", "cpu")
        assert content["frames"] == 2 and content["ms"] > 0 and not content["skipped"]


def test_error_for_missing_weights_explains_how_to_get_them(checkpoints, tmp_path, monkeypatch):
    path, _, _ = checkpoints
    monkeypatch.setattr(weights_file, "POINTNET_WEIGHTS", tmp_path / "own.safetensors")
    with pytest.raises(InputError, match="the package has no weights for PointNet"):
        load_pointnet_detector()
    params = with_values(accept_every_cluster(), {"pointnet.weights": str(path)})
    expected = make_random_detector()(make_scan())
    assert are_equal_detections(load_pointnet_detector("", "cpu", params)(make_scan()), expected, 1e-5)
    path.rename(tmp_path / "own.safetensors")
    assert are_equal_detections(load_pointnet_detector("", "cpu", accept_every_cluster())(make_scan()), expected, 1e-5)
    with pytest.raises(InputError, match=r"checkpoint not found: .*pointnet\.weights"):
        load_pointnet_detector("", "cpu", params)
    with pytest.raises(InputError, match="unknown device 'tpu'"):
        load_pointnet_detector("", "tpu")


def test_every_network_runs_on_real_scans(data):
    from lidar_perception.data.open import open_recording

    scan = open_recording(data / "kitti_object").frames[0].load()
    for name in "improved", "pointnet", "pointnet2":
        config = make_small_config(name)
        result = PointNetDetector(make_classifier(make_random_network(config), Header(config)))(scan)
        assert result.problem is None and result.timings["network"] > 0
