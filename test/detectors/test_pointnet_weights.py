"""Weights of PointNet: checkpoints, mismatches, and opening as a detector."""

from __future__ import annotations

import json
import struct

import detection_samples
import pytest
import torch
from cli_samples import evaluate_detection as evaluate
from detection_samples import are_equal_detections, make_scan
from pointnet_samples import accept_every_cluster, make_random_detector, make_random_network, make_small_config
from samples import write_object_folder

from lidar_perception.detectors import weights_file
from lidar_perception.detectors.checkpoint import Header, read_header, save_checkpoint
from lidar_perception.detectors.open import open_detector
from lidar_perception.detectors.pointnet.detector import PointNetDetector, load_pointnet_detector
from lidar_perception.detectors.pointnet.network import load_pointnet
from lidar_perception.detectors.pointnet.params import PointNetDetectorParams
from lidar_perception.detectors.pointpillars.detector import PointPillarsDetector
from lidar_perception.detectors.pointpillars.network import load_network
from lidar_perception.param_fields import with_values
from lidar_perception.types import InputError

pytestmark = pytest.mark.usefixtures("one_thread", "keep_ego_detections")
GROUND, CLUSTERING = PointNetDetectorParams().ground, PointNetDetectorParams().clustering


@pytest.fixture
def checkpoints(tmp_path):
    """Return checkpoints of both networks."""
    config, pointpillars_config = make_small_config(), detection_samples.make_tiny_config("v4")
    header = Header(config, {"data": "simulated"}, {"accuracy": 0.9}, "abc123")
    save_checkpoint(tmp_path / "n.safetensors", make_random_network(config), header)
    pointpillars = detection_samples.make_random_network(pointpillars_config)
    save_checkpoint(tmp_path / "p.safetensors", pointpillars, Header(pointpillars_config))
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
    loaded_header, loaded_network = load_pointnet(path, header.config)
    assert loaded_header == header
    for name, value in make_random_network(header.config).state_dict().items():
        assert torch.equal(loaded_network.state_dict()[name], value), name
    save_checkpoint(tmp_path / "half", loaded_network, header, half=True)
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
