"""Checkpoints, exported networks, and weights of other projects."""

from __future__ import annotations

import importlib.util
import json
import os
import runpy
import struct
import zipfile
from pathlib import Path

import numpy as np
import pointnet_samples
import pytest
import torch
from click.testing import CliRunner
from detection_samples import (
    are_equal_detections,
    lower_thresholds,
    make_detector,
    make_random_detector,
    make_random_network,
    make_scan,
    make_tiny_config,
)

from lidar_perception.cli.main import cli
from lidar_perception.detectors import weights_file
from lidar_perception.detectors.checkpoint import Header, copy_matching_weights, read_header, save_checkpoint
from lidar_perception.detectors.open import open_detector
from lidar_perception.detectors.pointnet.detector import _load_network
from lidar_perception.detectors.pointpillars.config import NetworkConfig, make_config
from lidar_perception.detectors.pointpillars.detector import load_detector
from lidar_perception.detectors.pointpillars.import_weights import import_weights
from lidar_perception.detectors.pointpillars.network import load_network, make_network
from lidar_perception.detectors.pointpillars.params import DetectorParams
from lidar_perception.detectors.pointpillars.torch_network import TorchNetwork
from lidar_perception.param_fields import with_values
from lidar_perception.types import InputError

pytestmark = pytest.mark.usefixtures("one_thread")
needs_onnx = pytest.mark.skipif(
    not all(importlib.util.find_spec(name) for name in ("onnx", "onnxruntime", "onnxscript")),
    reason="needs the extra [onnx]",
)


# checkpoints


@pytest.fixture
def checkpoint(tmp_path):
    config = make_tiny_config("v4")
    header = Header(config, {"data": "simulated", "steps": 10}, {"map": 0.5}, "abc123", {"Pedestrian": (1.5, -0.25)})
    network = make_random_network(config)
    save_checkpoint(tmp_path / "w.safetensors", network, header)
    return tmp_path / "w.safetensors", header, network


def test_checkpoint_survives_saving_and_loading(checkpoint, tmp_path):
    path, header, network = checkpoint
    assert read_header(path) == header
    loaded_header, loaded_network = load_network(path, header.config)
    assert loaded_header == header
    for name, value in network.state_dict().items():
        assert torch.equal(loaded_network.state_dict()[name], value), name
    save_checkpoint(tmp_path / "half", network, header, half=True)
    assert (tmp_path / "half").stat().st_size < path.stat().st_size
    for name, value in load_network(tmp_path / "half")[1].state_dict().items():
        torch.testing.assert_close(value, network.state_dict()[name], atol=1e-7, rtol=0 if value.ndim < 2 else 2**-10)
    result = load_detector(path, "cpu", lower_thresholds(engine="torch"))(make_scan())
    expected = make_detector(TorchNetwork(network), header, lower_thresholds())(make_scan())
    assert len(result.detections) and are_equal_detections(result, expected)


def test_error_for_another_config_shows_both_values(checkpoint):
    path, _, _ = checkpoint
    with pytest.raises(InputError, match=r"version is v4, expected v2"):
        load_network(path, make_tiny_config("v2"))
    params = with_values(DetectorParams(), {"pointpillars.version": "v1"})
    with pytest.raises(InputError, match=r"has version v4, not v1"):
        load_detector(path, "cpu", params)
    with pytest.raises(InputError, match=r"has size compact, not full"):
        load_detector(path, "cpu", with_values(DetectorParams(), {"pointpillars.size": "full"}))


def test_matching_weights_of_another_network_are_copied(checkpoint):
    path, header, network = checkpoint
    state = network.state_dict()
    same_network = make_network(header.config)
    copied, count = copy_matching_weights(same_network, path, NetworkConfig)
    assert copied == count == len(state)
    assert all(torch.equal(value, state[name]) for name, value in same_network.state_dict().items())
    # without the map branch the first block has fewer inputs; it copies the matching ones
    smaller_network = make_network(make_tiny_config("v1"))
    copied, count = copy_matching_weights(smaller_network, path, NetworkConfig)
    assert copied == count
    new_weight, stored_weight = (s["blocks.0.0.0.weight"] for s in (smaller_network.state_dict(), state))
    assert new_weight.shape[1] < stored_weight.shape[1] and torch.equal(
        new_weight, stored_weight[:, : new_weight.shape[1]]
    )
    # a new input, such as the cluster id, comes last and starts at 0
    network_with_ids = make_network(make_tiny_config("v2"))
    assert len(set(copy_matching_weights(network_with_ids, path, NetworkConfig))) == 1
    new_weight, stored_weight = (s["pillar_net.linear.weight"] for s in (network_with_ids.state_dict(), state))
    assert torch.equal(new_weight[:, :-1], stored_weight) and not new_weight[:, -1].any()
    # a neck of another shape keeps its random weights
    different_network = make_network(make_tiny_config("v0"))
    initial_state = {name: value.clone() for name, value in different_network.state_dict().items()}
    copied, count = copy_matching_weights(different_network, path, NetworkConfig)
    assert 0 < copied < count
    assert all(
        torch.equal(value, initial_state[name])
        for name, value in different_network.state_dict().items()
        if name.startswith("neck")
    )
    with pytest.raises(InputError, match="no layer"):
        copy_matching_weights(torch.nn.Linear(2, 3), path, NetworkConfig)


def test_invalid_checkpoint_files_are_rejected(checkpoint, tmp_path):
    path, _, _ = checkpoint
    content = path.read_bytes()
    length = struct.unpack("<Q", content[:8])[0]
    names = json.loads(content[8 : 8 + length])
    header = json.loads(names["__metadata__"]["lidar_perception"])
    cases = {
        "missing": (None, "checkpoint not found"),
        "cut": (content[:-9], "is truncated"),
        "text": (b"hello", "is truncated"),
        "empty": (b"", "is truncated"),
    }
    for name, change, message in (
        ("foreign", None, "import-weights"),
        ("later", dict(format=9), "format version 9"),
        ("unknown", dict(config={**header["config"], "colour": 1}), "'colour'"),
        ("unfit", dict(config={**header["config"], "fpn_channels": 9}), "do not match"),
        ("odd", dict(config={**header["config"], "cell": "wide"}), "has an invalid network config"),
    ):
        tensors = {k: v for k, v in names.items() if k != "__metadata__"}
        if change:
            tensors["__metadata__"] = {"lidar_perception": json.dumps({**header, **change})}
        text = json.dumps(tensors).encode()
        cases[name] = (struct.pack("<Q", len(text)) + text + content[8 + length :], message)
    for name, (file_content, message) in cases.items():
        if file_content is not None:
            (tmp_path / name).write_bytes(file_content)
        with pytest.raises(InputError, match=message) as error:
            load_network(tmp_path / name)
        assert "\n" not in str(error.value) and name in str(error.value)


def test_last_checkpoint_survives_a_full_disk(checkpoint, monkeypatch):
    path, header, network = checkpoint
    content = path.read_bytes()

    def raise_disk_full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", raise_disk_full)
    with pytest.raises(InputError, match="No space left"):
        save_checkpoint(path, network, header, half=True)
    assert path.read_bytes() == content and [*path.parent.iterdir()] == [path]


def test_model_card_states_the_sensor_of_the_header():
    describe = runpy.run_path(str(Path(__file__).parents[2] / "scripts/publish_weights.py"))["describe_weights"]
    training = dict(data=["sim"], scenes=5, validation_scenes=0, steps=9, batch=4, seconds=60, seed=0)
    for sensor, expected in (
        ({"name": "vlp-16", "beams": 16, "height": 0.6}, "Sensor: vlp-16, 16 beams, 0.6 m above the ground."),
        ({}, "Sensor: several, which the header does not list."),
    ):
        assert expected in describe(Header(make_tiny_config(), training={**training, "sensor": sensor}), "v4")


def test_error_for_missing_weights_explains_how_to_get_them(tmp_path, monkeypatch):
    monkeypatch.setattr(weights_file, "POINTPILLARS_WEIGHTS", tmp_path)
    with pytest.raises(InputError, match="no weights for v4 compact"):
        load_detector("", "cpu")
    params = with_values(lower_thresholds(engine="torch"), {"pointpillars.version": "v1"})
    config = make_tiny_config("v1")
    save_checkpoint(tmp_path / "pointpillars_v1_compact.safetensors", make_random_network(config), Header(config))
    assert are_equal_detections(load_detector("", "cpu", params)(make_scan()), make_random_detector("v1")(make_scan()))
    named_params = with_values(
        lower_thresholds(engine="torch"),
        {"pointpillars.weights": str(tmp_path / "pointpillars_v1_compact.safetensors")},
    )
    assert are_equal_detections(
        load_detector("", "cpu", named_params)(make_scan()), make_random_detector("v1")(make_scan())
    )
    with pytest.raises(InputError, match="checkpoint not found: /nowhere"):
        load_detector("", "cpu", with_values(lower_thresholds(), {"pointpillars.weights": "/nowhere"}))


# export


@needs_onnx
@pytest.mark.no_cover
def test_exported_network_gives_the_same_detections(tmp_path):
    """v0 is exported by the function, v4 by the command. The other versions contain no other layers."""
    from lidar_perception.detectors.pointpillars.onnx import OnnxNetwork, export_onnx

    config = make_tiny_config("v0", anchors=make_tiny_config().anchors[:1], max_points=3, zero_row=True, middle_z=True)
    network, header = make_random_network(config), Header(config, {"steps": 3})
    export_onnx(network, header, tmp_path / "n.onnx")
    exported = load_detector(tmp_path / "n.onnx", "auto", lower_thresholds(score=0.1))
    assert exported.proposer.header == header
    assert isinstance(exported.proposer.network, OnnxNetwork)
    expected = make_detector(TorchNetwork(network), header, lower_thresholds(score=0.1))(make_scan())
    assert len(expected.detections) and are_equal_detections(exported(make_scan()), expected, 1e-4)


@needs_onnx
def test_export_reads_checkpoints_and_rejects_bad_files(checkpoint, tmp_path, monkeypatch):
    path, _, _ = checkpoint
    out = tmp_path / "o/w.onnx"
    result = CliRunner().invoke(cli, ["export", "onnx", str(path), "--out", str(out)])
    assert result.exit_code == 0 and "v4 compact" in " ".join(result.output.split())
    assert are_equal_detections(
        load_detector(out, "cpu", lower_thresholds())(make_scan()),
        load_detector(path, "cpu", lower_thresholds(engine="torch"))(make_scan()),
        1e-4,
    )
    with pytest.raises(InputError, match="not on 'cuda'"):
        load_detector(out, "cuda")
    with pytest.raises(InputError, match="set amp: off"):
        load_detector(out, "cpu", with_values(lower_thresholds(), {"pointpillars.amp": "bf16"}))
    with pytest.raises(InputError, match="set engine: auto"):
        load_detector(out, "cpu", lower_thresholds(engine="sparse"))
    (tmp_path / "bad.onnx").write_bytes(out.read_bytes()[:-50])
    for name, message in ("bad.onnx", "cannot read"), ("none.onnx", "exported network not found"):
        with pytest.raises(InputError, match=message):
            load_detector(tmp_path / name, "cpu")


@needs_onnx
@pytest.mark.parametrize("name", ["improved", "farthest-ball-density", "pointnet"])
def test_exported_pointnet_gives_the_same_detections(tmp_path, name):
    config = pointnet_samples.make_small_config(name)
    network, clusters = (
        pointnet_samples.make_random_network(config),
        pointnet_samples.make_blobs(np.random.default_rng(0), [1, 5, 30, 100, 7]),
    )
    network.temperature.fill_(1.5)
    network.offsets.copy_(torch.arange(4) / 10)
    weights, out = tmp_path / "w.safetensors", tmp_path / "p.onnx"
    save_checkpoint(weights, network, Header(config, {"steps": 3}))
    result = CliRunner().invoke(cli, ["export", "onnx", str(weights), "--out", str(out)])
    assert result.exit_code == 0 and f"PointNet {name}" in " ".join(result.output.split())
    detector, expected_detector = (
        open_detector(file, "cpu", settings={"pointnet.warm_up": False, "pointnet.engine": "torch"})
        for file in (out, weights)
    )
    assert detector.params == expected_detector.params
    assert detector.classifier.header == expected_detector.classifier.header
    for count in (5, 1):
        subset = clusters.take(np.arange(count))
        predictions, expected = (d.classifier.predict(subset) for d in (detector, expected_detector))
        np.testing.assert_allclose(predictions.probabilities, expected.probabilities, atol=1e-5)
        np.testing.assert_allclose(predictions.boxes, expected.boxes, atol=1e-4)
    with pytest.raises(InputError, match="in ONNX Runtime on the CPU"):
        _load_network(out, "cuda", "auto")


# weights of other projects


def convert_to_project(state, project):
    """Convert our state dict to the names and point inputs of another project."""
    names = {
        "OpenPCDet": (
            "vfe",
            "backbone_2d.blocks",
            "backbone_2d.deblocks",
            "dense_head",
            ("conv_cls", "conv_box", "conv_dir_cls"),
            1,
        ),
        "mmdetection3d": (
            "voxel_encoder",
            "backbone.blocks",
            "neck.deblocks",
            "bbox_head",
            ("conv_cls", "conv_reg", "conv_dir_cls"),
            0,
        ),
    }
    points, blocks, ups, head, convs, first = names[project]
    out = {}
    for name, value in state.items():
        parts = name.split(".")
        if parts[0] == "pillar_net":
            key = f"{points}.pfn_layers.0.{'.'.join(parts[1:])}"
        elif parts[0] == "blocks":
            key = f"{blocks}.{parts[1]}.{first + 3 * int(parts[2]) + int(parts[3])}.{parts[4]}"
        elif parts[0] == "neck":
            key = f"{ups}.{parts[2]}.{parts[3]}.{parts[4]}"
        else:
            conv = convs[["scores", "codes", "directions"].index(parts[1])]
            key = f"{head}.{conv}.{parts[2]}"
        out[key] = value
    return out


@pytest.fixture(scope="module")
def full_state():
    """Return a full-size v0 network with ten inputs per point, as in other projects."""
    return make_random_network(make_config("v0", "full", middle_z=True)).state_dict()


@pytest.mark.parametrize(
    "project, wrap",
    [
        ("OpenPCDet", lambda s: {"epoch": 80, "model_state": {**s, "global_step": torch.tensor([5])}}),
        ("mmdetection3d", lambda s: {"meta": {"epoch": 160}, "state_dict": {f"module.{k}": v for k, v in s.items()}}),
    ],
)
def test_weights_of_other_projects_are_imported(project, wrap, full_state, tmp_path):
    path = tmp_path / "theirs.pth"
    torch.save(wrap(convert_to_project(full_state, project)), path)
    config, network, name = import_weights(path)
    assert name == project and (config.version, config.size) == ("v0", "full")
    state = network.state_dict()
    linear = "pillar_net.linear.weight"
    assert all(torch.equal(state[k], v) for k, v in full_state.items() if k != linear)
    xyz, offsets = torch.randn(50, 3), torch.randn(50, 4)
    centre_offsets = xyz - torch.tensor([3.0, 2.0, -1.0])  # any pillar; z relative to the middle of the range
    position = centre_offsets if project == "mmdetection3d" else xyz  # mmdetection3d overwrites x y z
    torch.testing.assert_close(
        torch.cat([position, offsets, centre_offsets], dim=1) @ full_state[linear].T,
        torch.cat([xyz, offsets, centre_offsets], dim=1) @ state[linear].T,
    )
    car = config.anchors[config.classes.index("Car")]
    assert car.z == pytest.approx(-1.78 + 1.56 / 2) and config.zero_row
    assert config.classes == (
        ("Car", "Pedestrian", "Cyclist") if project == "OpenPCDet" else ("Pedestrian", "Cyclist", "Car")
    )


def test_weights_are_imported_from_the_command_line(full_state, tmp_path):
    torch.save(convert_to_project(full_state, "OpenPCDet"), tmp_path / "a.pth")
    result = CliRunner().invoke(
        cli,
        [
            "import-weights",
            str(tmp_path / "a.pth"),
            "--out",
            str(tmp_path / "a.safetensors"),
            "--classes",
            "Cyclist,Pedestrian,Car",
            "--half",
        ],
    )
    assert result.exit_code == 0, result.output
    header = read_header(tmp_path / "a.safetensors")
    assert header.config.classes == ("Cyclist", "Pedestrian", "Car")
    assert header.training == {"imported from": "OpenPCDet", "file": "a.pth"}


class Code:
    """Object that runs code when it is unpickled, which weights_only must prevent."""

    def __reduce__(self):
        return print, ("run",)


def test_files_with_other_content_are_rejected(full_state, tmp_path, capsys):
    valid_state = convert_to_project(full_state, "OpenPCDet")
    linear_name = "vfe.pfn_layers.0.linear.weight"
    cases = [
        ({**valid_state, "evil": Code()}, (), "weights_only"),
        ({}, (), "no state_dict"),
        ([1], (), "no state_dict"),
        ({"a": torch.zeros(2)}, (), linear_name),
        ({**valid_state, linear_name: valid_state[linear_name][:, :9]}, (), "9 inputs"),
        ({**valid_state, "roi_head.weight": torch.zeros(3)}, (), "roi_head.weight"),
        (valid_state, ("Car", "Pedestrian"), "3 classes"),
        (valid_state, ("Car", "Dog", "Cat"), "Dog"),
        ({k: v for k, v in valid_state.items() if "blocks.2.7" not in k}, (), "blocks.2.7"),
        ({**valid_state, "backbone_2d.blocks.0.1.weight": torch.zeros(64, 32, 3, 3)}, (), "blocks.0.0.0.weight"),
    ]
    for content, classes, message in cases:
        torch.save(content, tmp_path / "x.pth")
        with pytest.raises(InputError, match=message) as error:
            import_weights(tmp_path / "x.pth", classes)
        assert "\n" not in str(error.value)
    (tmp_path / "x.pth").write_bytes(b"no pickle")
    with zipfile.ZipFile(tmp_path / "damaged.pth", "w") as file:  # reads an entry that does not exist
        file.writestr("x/data.pkl", b"\x80\x02R.")
        file.writestr("x/version", "3")
    for name, message in (("x.pth", "weights_only"), ("damaged.pth", "weights_only"), ("none.pth", "file not found")):
        with pytest.raises(InputError, match=message):
            import_weights(tmp_path / name)
    assert capsys.readouterr().out == ""
