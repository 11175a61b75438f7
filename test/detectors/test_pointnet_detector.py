"""The PointNet detector: clusters, pose, thresholds, bad input, weights."""

from __future__ import annotations

import json
import struct
from dataclasses import replace

import numpy as np
import pytest
import torch
from cli_samples import evaluate_detection as evaluate
from detection_samples import frame, same
from detection_samples import lively as lively_pointpillars
from detection_samples import tiny as tiny_pointpillars
from pointnet_samples import CPU, eager, lively, make_classifier, random_detector, small
from samples import object_folder

from lidar_perception.clustering.cluster import cluster_obstacles
from lidar_perception.detectors import weights_file
from lidar_perception.detectors.checkpoint import Header, read_header, read_network_name, save_checkpoint
from lidar_perception.detectors.checkpoint import Header as PointPillarsHeader
from lidar_perception.detectors.contract import DetectionResult
from lidar_perception.detectors.normalized_view import to_sensor_frame
from lidar_perception.detectors.open import open_detector
from lidar_perception.detectors.pointnet.detector import PointNetDetector, load_pointnet_detector
from lidar_perception.detectors.pointnet.network import load_pointnet
from lidar_perception.detectors.pointnet.params import CLUSTERING, GROUND, STEPS
from lidar_perception.detectors.pointpillars.detector import PointPillarsDetector
from lidar_perception.detectors.pointpillars.network import load_network
from lidar_perception.ground.params import SensorPoseParams
from lidar_perception.ground.segment import level_points, segment_ground
from lidar_perception.param_fields import with_values
from lidar_perception.types import CLASSES, Detections, InputError, PointCloud

pytestmark = pytest.mark.usefixtures("one_thread", "carrier_too")


@pytest.fixture(scope="module")
def ids() -> np.ndarray:
    """Cluster ids of the points of frame()."""
    found = cluster_obstacles(frame().xyz, segment_ground(frame(), GROUND), CLUSTERING)
    assert found.max() >= 5
    return found


def moved(found: Detections, turn: float = 0.0, shift=(0, 0, 0)) -> Detections:
    """Rotate a frame about the sensor's z axis, then shift it."""
    boxes = found.boxes.astype(np.float64)
    cos, sin = np.cos(turn), np.sin(turn)
    boxes[:, :2] = boxes[:, :2] @ np.array([[cos, sin], [-sin, cos]])
    boxes[:, :3] += shift
    boxes[:, 6] += turn
    return replace(found, boxes=boxes)


def alike(a: Detections | DetectionResult, b: Detections | DetectionResult, atol: float = 1e-4) -> bool:
    """Return True if both are equal; detections with almost equal scores may be swapped."""
    a, b = (x.detections if isinstance(x, DetectionResult) else x for x in (a, b))
    if len(a) != len(b):
        return False
    left = set(range(len(b)))
    for box, kind, score in zip(a.boxes, a.class_ids, a.scores):
        near = [
            i
            for i in left
            if np.allclose(b.boxes[i, :6], box[:6], atol=atol)
            and np.cos(b.boxes[i, 6] - box[6]) > 1 - atol
            and b.class_ids[i] == kind
            and abs(b.scores[i] - score) < atol
        ]
        if not near:
            return False
        left.remove(near[0])
    return True


# clusters


def test_given_columns_equal_computed_columns(ids):
    detector, scan = random_detector(), frame()
    computed = detector(scan).detections
    assert len(computed) > 3 and len(set(computed.class_ids)) > 1
    flat = segment_ground(scan, GROUND)
    for columns in (
        dict(cluster_ids=ids),
        dict(ground=flat),
        dict(ground=flat.astype("u1")),
        dict(cluster_ids=ids.astype(np.uint32), ground=flat),
    ):
        assert same(detector(scan, **columns), computed)


def test_cluster_ids_do_not_matter(ids):
    detector, scan = random_detector(), frame()
    found = detector(scan, cluster_ids=ids).detections
    assert same(detector(scan, cluster_ids=np.where(ids > 0, ids + 100_000, 0)), found)
    assert same(detector(scan, cluster_ids=np.where(ids > 0, ids, -1)), found)
    huge = np.where(ids > 0, ids.astype(np.int64) * 2**40, -(2**50))
    assert same(detector(scan, cluster_ids=huge), found)
    turn = np.random.default_rng(0).permutation(ids.max()) + 1
    permuted = np.concatenate([[0], turn])[ids]
    assert not np.array_equal(permuted, ids) and alike(detector(scan, cluster_ids=permuted), found)


def test_result_of_a_cluster_does_not_depend_on_others(ids):
    detector, scan = random_detector(), frame()
    everything = detector(scan, cluster_ids=ids).detections
    alone = [detector(scan, cluster_ids=np.where(ids == i, ids, 0)).detections for i in range(1, ids.max() + 1)]
    joined = Detections(
        *(np.concatenate([getattr(one, part) for one in alone]) for part in ("boxes", "class_ids", "scores"))
    )
    assert alike(joined, everything)


def test_frame_without_clusters_has_a_problem(ids):
    detector, scan = random_detector(), frame()
    nothing = np.zeros(len(scan), np.int32)
    far = PointCloud(np.float32([[9, 0, -1], [20, 3, 0]]), np.zeros(2, np.float32))
    for cloud, columns, words in (
        (PointCloud(np.zeros((0, 3), np.float32)), {}, "empty"),
        (PointCloud.of(np.full((5, 3), np.nan, np.float32)), {}, "no finite point"),
        (scan, {"cluster_ids": nothing}, "no clusters"),
        (scan, {"cluster_ids": nothing - 1}, "no clusters"),
        (far, {}, "no clusters"),
        (scan, {"ground": np.ones(len(scan), bool)}, "no clusters"),
        (scan, {"cluster_ids": np.arange(len(scan))}, "fewer than 3 points"),
    ):
        found = detector(cloud, **columns)
        assert len(found.detections) == 0 and words in found.problem, words
        assert found.best == {} and list(found.timings) == list(STEPS)
        found = detector(scan, cluster_ids=ids)
        assert found.problem is None and found.timings["network"] > 0


# sensor pose


def test_rotated_scene_has_rotated_boxes(ids):
    detector, scan = random_detector(), frame()
    found = detector(scan, cluster_ids=ids).detections
    cos, sin = np.cos(2.0), np.sin(2.0)
    turn = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
    turned = replace(scan, xyz=(scan.xyz @ turn).astype(np.float32))
    assert alike(detector(turned, cluster_ids=ids), moved(found, 2.0), 2e-3)


def test_sensor_height_only_shifts_boxes(ids):
    detector, scan = random_detector(), frame()
    known = {"clustering.density": 0.0}  # the density depends on the viewpoint
    for columns in {"cluster_ids": ids}, {}:
        detector.params = with_values(eager(), known)
        found = detector(scan, **columns).detections
        higher = replace(scan, xyz=scan.xyz - np.float32([0, 0, 0.5]))
        # heights are relative to the nearby ground, so no parameter is needed
        assert alike(detector(higher, **columns), moved(found, shift=(0, 0, -0.5)), 1e-3)
        detector.params = with_values(eager(), known | {"ground.sensor_pose.height": 2.23})
        assert alike(detector(higher, **columns), moved(found, shift=(0, 0, -0.5)), 1e-3)


@pytest.mark.parametrize("roll, pitch", [(3.1416, 0.0), (0.0, 0.2)])
def test_tilted_sensor_gives_the_same_boxes_in_its_frame(roll, pitch, ids):
    pose = SensorPoseParams(roll=roll, pitch=pitch)
    detector, scan = random_detector(), frame()
    found = detector(scan, cluster_ids=ids).detections
    back = level_points(np.eye(3, dtype=np.float32), pose).T
    detector.params = with_values(
        eager(), {"ground.sensor_pose.roll": roll, "ground.sensor_pose.pitch": pitch, "pointnet.nms.iou": 1.0}
    )
    seen = detector(replace(scan, xyz=scan.xyz @ back), cluster_ids=ids).detections
    detector.params = with_values(eager(), {"pointnet.nms.iou": 1.0})
    assert alike(seen, to_sensor_frame(detector(scan, cluster_ids=ids).detections, pose), 2e-3) and len(found) > 3


# scores, boxes, intensity


def test_detections_pass_thresholds_sorted_without_overlap(ids):
    detector, scan = random_detector(), frame()
    found = detector(scan, cluster_ids=ids).detections
    assert (np.diff(found.scores) <= 0).all() and len(found) > 3
    middle = float(np.median(found.scores[found.class_ids == found.class_ids[0]]))
    name = CLASSES[found.class_ids[0]].lower()
    detector.params = with_values(eager(), {f"pointnet.scores.{name}": middle})
    fewer = detector(scan, cluster_ids=ids).detections
    assert fewer.scores[fewer.class_ids == found.class_ids[0]].min() >= np.float32(middle)
    others = found[found.class_ids != found.class_ids[0]]
    assert len(others) and same(fewer[fewer.class_ids != found.class_ids[0]], others)
    detector.params = with_values(eager(), {"pointnet.nms.max_boxes": 2})
    assert same(detector(scan, cluster_ids=ids), found[:2])
    halves = ids.copy()  # two clusters of one object: one of their boxes remains
    thing = np.flatnonzero(ids == 1)
    halves[thing[::2]] = ids.max() + 1
    detector.params = with_values(eager(), {"pointnet.nms.iou": 1.0})
    both = detector(scan, cluster_ids=halves).detections
    detector.params = with_values(eager(), {"pointnet.nms.iou": 0.05, "pointnet.nms.across_classes": True})
    assert len(both) > len(detector(scan, cluster_ids=halves).detections)


def test_best_scores_are_reported_without_detections(ids):
    detector, scan = random_detector(), frame()
    found = detector(scan, cluster_ids=ids).detections
    assert detector(scan, cluster_ids=ids).best == {} and len(found) == ids.max()
    nothing = detector.with_min_score(1.0)(scan, cluster_ids=ids)
    assert len(nothing.detections) == 0 and nothing.problem is None
    assert list(nothing.best) == ["Car", "Pedestrian", "Cyclist"]
    assert max(nothing.best.values()) == pytest.approx(found.scores.max())
    assert same(detector(scan, cluster_ids=ids), found)  # the copy does not change the original


@pytest.mark.parametrize("layer", ["classes", "box"])
def test_nan_outputs_are_left_out_and_reported(layer, ids):
    detector, scan = random_detector(), frame()
    dark = replace(scan, intensity=np.where(ids == 2, np.float32(0), scan.intensity))
    expected = detector(dark, cluster_ids=np.where(ids == 2, 0, ids)).detections
    intensity = np.where(ids == 2, np.float32(np.nan), scan.intensity)
    found = detector(replace(scan, intensity=intensity), cluster_ids=ids)
    assert same(found, expected)
    assert f"1 of {ids.max()} clusters" in found.problem and "NaN" in found.problem
    network = detector.classifier.network.network
    getattr(network, layer).bias.fill_(np.nan)
    broken = PointNetDetector(make_classifier(network, detector.classifier.header), detector.params)
    found = broken(scan, cluster_ids=ids)
    assert len(found.detections) == 0 and "NaN" in found.problem


def test_intensity_is_normalized_and_may_be_left_out(ids):
    detector, scan = random_detector(), frame()
    found = detector(scan, cluster_ids=ids).detections
    half = replace(scan, intensity=scan.intensity / 2)
    assert same(detector(half, cluster_ids=ids), found)
    other = replace(scan, intensity=scan.intensity[::-1].copy())
    assert not same(detector(other, cluster_ids=ids), found)
    without = detector(replace(scan, intensity=None), cluster_ids=ids)
    assert "no intensity" in without.problem
    detector.params = with_values(eager(), {"pointnet.use_intensity": False})
    unknown = np.full_like(scan.intensity, np.nan)
    for blind in scan, replace(scan, intensity=None), replace(scan, intensity=unknown):
        found = detector(blind, cluster_ids=ids)
        assert same(found, without) and found.problem is None


def test_columns_of_wrong_length_are_rejected():
    for name in "cluster_ids", "ground":
        with pytest.raises(InputError, match=f"{name} has 3 values"):
            random_detector()(frame(), **{name: np.zeros(3, int)})


# devices


def test_cpu_fallback_after_out_of_memory_is_reported(ids, monkeypatch):
    """Simulate a GPU without memory."""
    from lidar_perception.detectors.pointnet import classifier as module

    scan, expected, real = frame(), random_detector()(frame(), cluster_ids=ids), module.predict
    broken = random_detector()

    def predict(network, clusters, **labels):
        if broken.device != CPU:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory")
        return real(network, clusters, **labels)

    monkeypatch.setattr(module, "predict", predict)
    broken.classifier.placement.device = "meta"
    for _ in range(2):
        found = broken(scan, cluster_ids=ids)
        assert same(found, expected) and "CPU" in found.problem and broken.device == CPU
    broken.classifier.placement.device = "meta"
    broken.params = with_values(eager(), {"pointnet.cpu_fallback": False})
    with pytest.raises(InputError, match="out of memory"):
        broken(scan, cluster_ids=ids)


# weights


@pytest.fixture
def saved(tmp_path):
    """Return checkpoints of both networks."""
    config, other = small(), tiny_pointpillars("v4")
    header = Header(config, {"data": "simulated"}, {"accuracy": 0.9}, "abc123")
    save_checkpoint(tmp_path / "n.safetensors", lively(config), header)
    save_checkpoint(tmp_path / "p.safetensors", lively_pointpillars(other), PointPillarsHeader(other))
    return tmp_path / "n.safetensors", tmp_path / "p.safetensors", header


def with_header(path, out, **changes):
    """Copy a checkpoint with changed values in its header; None removes them."""
    content = path.read_bytes()
    length = struct.unpack("<Q", content[:8])[0]
    names = json.loads(content[8 : 8 + length])
    header = {**json.loads(names["__metadata__"]["lidar_perception"]), **changes}
    names["__metadata__"]["lidar_perception"] = json.dumps({k: v for k, v in header.items() if v is not None})
    text = json.dumps(names).encode()
    out.write_bytes(struct.pack("<Q", len(text)) + text + content[8 + length :])
    return out


def test_checkpoint_round_trip(saved, tmp_path):
    path, other, header = saved
    assert read_header(path) == header and read_network_name(path) == "pointnet"
    loaded_header, loaded = load_pointnet(path, header.config)
    assert loaded_header == header
    for name, value in lively(header.config).state_dict().items():
        assert torch.equal(loaded.state_dict()[name], value), name
    save_checkpoint(tmp_path / "half", loaded, header, half=True)
    assert (tmp_path / "half").stat().st_size < path.stat().st_size
    detector = load_pointnet_detector(path, "cpu", eager())
    assert same(detector(frame()), random_detector()(frame()), 1e-5)
    first = with_header(other, tmp_path / "first.safetensors", network=None)  # older checkpoints lack this key
    assert read_network_name(other) == read_network_name(first) == "pointpillars"
    assert load_network(first)[0] == load_network(other)[0]


def test_weights_of_another_network_or_classes_are_rejected(saved, tmp_path):
    path, other, header = saved
    with pytest.raises(InputError, match=r"contains a PointNet .*pointnet_detector.*PointPillars"):
        load_network(path)
    with pytest.raises(InputError, match=r"contains a PointPillars .*pointpillars_detector"):
        load_pointnet(other)
    unknown = with_header(path, tmp_path / "u.safetensors", network="transformer")
    for read in read_header, read_network_name, load_network:
        with pytest.raises(InputError, match="'transformer'; supported are"):
            read(unknown)
    two = small(classes=("Car", "Pedestrian"), sizes=header.config.sizes[:2])
    with pytest.raises(InputError, match=r"classes is .*Cyclist.*expected"):
        load_pointnet(path, two)
    config = json.loads(header.to_json())["config"]
    for change, words in (
        (dict(classes=two.classes, sizes=two.sizes), "do not fit its header"),
        (dict(classes=("Car", "Dog", "Cyclist")), "unknown class 'Dog'"),
        (dict(colour=1), "'colour'"),
    ):
        changed = with_header(path, tmp_path / "c.safetensors", config={**config, **change})
        with pytest.raises(InputError, match=words) as error:
            load_pointnet(changed)
        assert "\n" not in str(error.value)


def test_network_with_one_class_keeps_its_class_id(ids):
    config = small(classes=("Pedestrian",), sizes=small().sizes[1:2])
    found = PointNetDetector(make_classifier(lively(config), Header(config)), eager())(
        frame(), cluster_ids=ids
    ).detections
    assert len(found) > 3 and {*found.class_ids} == {CLASSES.index("Pedestrian")}


def test_load_detector_opens_both_networks(saved, tmp_path):
    path, other, _ = saved
    pointnet, pointpillars = open_detector(path, "cpu"), open_detector(other, "cpu")
    assert isinstance(pointnet, PointNetDetector) and isinstance(pointpillars, PointPillarsDetector)
    assert pointnet.params.clustering == CLUSTERING and pointnet.params.ground == GROUND
    ablated = small(dynamic_threshold=False)
    save_checkpoint(tmp_path / "a.safetensors", lively(ablated), Header(ablated))
    clustering = open_detector(tmp_path / "a.safetensors", "cpu").params.clustering
    assert clustering == ablated.clustering != CLUSTERING
    for detector in pointnet, pointpillars:
        found = detector(frame())
        assert found.timings["network"] > 0 and found.problem is None
    for name, words in ("none.safetensors", "no checkpoint"), ("none.onnx", "onnx"):
        with pytest.raises(InputError, match=words):
            open_detector(tmp_path / name)
    (tmp_path / "text").write_text("hello")
    with pytest.raises(InputError, match="not a checkpoint, or is truncated"):
        open_detector(tmp_path / "text")


def test_evaluate_runs_both_networks(saved, tmp_path):
    kitti = object_folder(tmp_path / "kitti")
    for path in saved[:2]:
        content, _ = evaluate(tmp_path, "--data", kitti, "--weights", path, "--device", "cpu")
        assert content["frames"] == 2 and content["ms"] > 0 and not content["skipped"]


def test_error_for_missing_weights_explains_how_to_get_them(saved, tmp_path, monkeypatch):
    path, _, _ = saved
    monkeypatch.setattr(weights_file, "POINTNET_WEIGHTS", tmp_path / "own.safetensors")
    with pytest.raises(InputError, match="the package has no weights for PointNet"):
        load_pointnet_detector()
    named = with_values(eager(), {"pointnet.weights": str(path)})
    expected = random_detector()(frame())
    assert same(load_pointnet_detector("", "cpu", named)(frame()), expected, 1e-5)
    path.rename(tmp_path / "own.safetensors")
    assert same(load_pointnet_detector("", "cpu", eager())(frame()), expected, 1e-5)
    with pytest.raises(InputError, match=r"no checkpoint .*pointnet\.weights"):
        load_pointnet_detector("", "cpu", named)
    with pytest.raises(InputError, match="no device 'tpu'"):
        load_pointnet_detector("", "tpu")


def test_every_network_runs_on_real_scans(data):
    from lidar_perception.data.open import open_recording

    scan = open_recording(data / "kitti_object").frames[0].load()
    for name in "improved", "pointnet", "pointnet2":
        config = small(name)
        found = PointNetDetector(make_classifier(lively(config), Header(config)))(scan)
        assert found.problem is None and found.timings["network"] > 0
