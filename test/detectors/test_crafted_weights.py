"""Crafted weight files are used or rejected with a one-line reason."""

from __future__ import annotations

import copy
import json
import math
import random

import numpy as np
import pytest
import torch
from detection_samples import (
    are_equal_detections,
    lower_thresholds,
    make_detector,
    make_random_network,
    make_scan,
    make_tiny_config,
)
from safetensors.torch import save

from lidar_perception.detectors.checkpoint import KEY, Header, read_header
from lidar_perception.detectors.pointnet.config import make_pointnet_config
from lidar_perception.detectors.pointnet.detector import load_pointnet_detector
from lidar_perception.detectors.pointnet.network import PointNet
from lidar_perception.detectors.pointnet.params import PointNetDetectorParams
from lidar_perception.detectors.pointpillars.detector import load_detector
from lidar_perception.detectors.pointpillars.torch_network import TorchNetwork
from lidar_perception.param_fields import with_values
from lidar_perception.types import InputError

# covered by other tests
pytestmark = [pytest.mark.no_cover, pytest.mark.usefixtures("one_thread")]

ODD = [
    None,
    True,
    0,
    1,
    -1,
    2,
    3,
    63,
    64,
    1e-9,
    0.5,
    -1e308,
    1e308,
    math.nan,
    math.inf,
    2**31,
    2**63,
    10**400,
    "",
    "1",
    "Car",
    "v9",
    "\x00",
    "x" * 10_000,
    [],
    [1],
    [1, 2, 3],
    [0] * 1000,
    [[[]]],
    [None],
    ["Car", "Car"],
    [[1, 2, 3]] * 3,
    {},
    {"size": [1]},
    [{}],
    {"x": {"y": []}},
]


def write_checkpoint(path, tensors, header):
    """Write a checkpoint with any text as its header."""
    path.write_bytes(save({name: value.contiguous() for name, value in tensors.items()}, {KEY: header}))


def list_key_paths(value, path=()):
    """Return the key paths of all values in a JSON object."""
    yield path
    if isinstance(value, dict | list):
        for key, part in value.items() if isinstance(value, dict) else enumerate(value):
            yield from list_key_paths(part, (*path, key))


def mutate(header, rng):
    """Return a header with a few values changed, removed, added or nested deeper."""
    header = {"": copy.deepcopy(header)}
    for _ in range(rng.choice([1, 1, 1, 2, 5])):
        *path, last = rng.choice([*list_key_paths(header)][1:])
        parent = header
        for key in path:
            parent = parent[key]
        mutation = rng.randrange(4)
        if mutation == 0:
            parent[last] = copy.deepcopy(rng.choice(ODD))
        elif mutation == 1 and path:
            del parent[last]
        elif mutation == 2 and isinstance(parent, dict) and path:
            parent[rng.choice(["", "size", "format", "a" * 99])] = copy.deepcopy(parent[last])
        else:
            parent[last] = rng.choice([[parent[last]], {"": parent[last]}])
    return header[""]


SMALL = {
    "pointpillars": (
        lambda: Header(make_tiny_config("v4"), {"steps": 1}, {"map": 0.5}, "abc"),
        make_random_network,
        load_detector,
        lower_thresholds(),
    ),
    "pointnet": (
        lambda: Header(
            make_pointnet_config(points=16, centroids=8, coarse=4, neighbours=(4, 4, 4), coarse_neighbours=4)
        ),
        PointNet,
        load_pointnet_detector,
        with_values(PointNetDetectorParams(), {"pointnet.warm_up": False}),
    ),
}


@pytest.mark.parametrize("network_name", SMALL)
def test_mutated_header_is_accepted_or_rejected_in_one_line(network_name, tmp_path):
    """Accepted headers match the shapes of the tensors, so the size of the file bounds the memory."""
    make_header, make, load, params = SMALL[network_name]
    header = make_header()
    tensors = make(header.config).state_dict()
    path, text, rng = tmp_path / "w.safetensors", json.loads(header.to_json()), random.Random(7)
    scan, rejected_count = make_scan(), 0
    texts = [json.dumps(mutate(text, rng)) for _ in range(60)]
    texts += [
        "[" * 100_000,
        '{"format":' * 50_000,
        "1" * 5000,
        "",
        "null",
        "\ud83d".encode("utf-8", "replace").decode(),
        json.dumps({**text, "format": [1]}),
    ]
    for header_text in texts:
        write_checkpoint(path, tensors, header_text)
        try:
            read_header(path)
            result = load(path, "cpu", params)(scan)
            assert np.isfinite(result.detections.boxes).all()
        except InputError as error:
            rejected_count += 1
            assert str(path) in str(error) and "\n" not in str(error) and len(str(error)) < 400
    assert 25 < rejected_count < len(texts)


def test_large_header_does_not_allocate_memory(tmp_path):
    header = json.loads(SMALL["pointpillars"][0]().to_json())
    header["config"]["block_channels"] = [65_536, 65_536, 65_536]  # 300 GB of weights
    path = tmp_path / "w.safetensors"
    write_checkpoint(path, make_random_network(make_tiny_config("v4")).state_dict(), json.dumps(header))
    with pytest.raises(InputError, match="do not match"):
        load_detector(path, "cpu")
    header["config"].update(low=[-60_000, -60_000, -3], high=[60_000, 60_000, 1], cell=0.01)
    write_checkpoint(path, make_random_network(make_tiny_config("v4")).state_dict(), json.dumps(header))
    with pytest.raises(InputError, match="cells"):
        load_detector(path, "cpu")


def test_constant_scores_are_reported_as_broken_weights():
    config = make_tiny_config("v4")
    for value in 0.0, 1.0:
        network = make_random_network(config)
        for tensor in network.state_dict().values():
            tensor.fill_(0)
        network.head.scores.bias.fill_(value)
        result = make_detector(TorchNetwork(network), Header(config), lower_thresholds(score=0.1))(make_scan())
        assert len(result.detections) == 0 and "scores are the same" in result.problem


def test_onnx_files_with_other_inputs_are_rejected(tmp_path):
    """Inputs are renamed, missing, or of another type or rank."""
    onnx = pytest.importorskip("onnx", reason="needs the extra [onnx]")
    pytest.importorskip("onnxruntime", reason="needs the extra [onnx]")
    from onnx import TensorProto, helper

    text = Header(make_tiny_config("v0")).to_json()

    def model(path, inputs, outputs=("logits", "codes", "directions"), header=text):
        nodes = [
            helper.make_node("Constant", [], [name], value=helper.make_tensor(name, TensorProto.FLOAT, [1], [0.0]))
            for name in outputs
        ]
        graph = helper.make_graph(
            nodes,
            "g",
            [helper.make_tensor_value_info(*i) for i in inputs],
            [helper.make_tensor_value_info(name, TensorProto.FLOAT, [1]) for name in outputs],
        )
        onnx_model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
        helper.set_model_props(onnx_model, {KEY: header} if header else {})
        path.write_bytes(onnx_model.SerializeToString().replace(b"NO UTF-8", b"\xff" * 8))

    valid_inputs = [
        ("points", TensorProto.FLOAT, ["n", 4]),
        ("offsets", TensorProto.FLOAT, ["n", 5]),
        ("cells", TensorProto.INT64, ["n"]),
    ]
    assert onnx
    path = tmp_path / "n.onnx"
    for change, message in (
        (dict(inputs=[("pixels", *valid_inputs[0][1:]), *valid_inputs[1:]]), "do not match its header"),
        (dict(inputs=valid_inputs[:2]), "do not match its header"),
        (dict(inputs=[("points", TensorProto.DOUBLE, ["n", 4]), *valid_inputs[1:]]), "do not match its header"),
        (dict(inputs=[("points", TensorProto.FLOAT, ["n"]), *valid_inputs[1:]]), "do not match its header"),
        (dict(inputs=valid_inputs, outputs=("logits",)), "do not match its header"),
        (dict(inputs=valid_inputs, header="[" * 99_999), "no lidar_perception header"),
        (dict(inputs=valid_inputs, header=""), "no lidar_perception header"),
        (dict(inputs=valid_inputs, header="NO UTF-8"), "cannot read"),
        (dict(inputs=valid_inputs), "n.onnx"),
    ):  # outputs of impossible shapes
        model(path, **change)
        with pytest.raises(InputError, match=message) as error:
            load_detector(path, "cpu")(make_scan())
        assert "\n" not in str(error.value)


def test_tensors_of_other_types_are_rejected(tmp_path):
    config = make_tiny_config("v4")
    path, state = tmp_path / "w.safetensors", make_random_network(config).state_dict()
    for dtype in torch.bool, torch.int8, torch.complex64:
        write_checkpoint(path, {name: value.to(dtype) for name, value in state.items()}, Header(config).to_json())
        with pytest.raises(InputError, match="expected floats of shape"):
            load_detector(path, "cpu", lower_thresholds())
    write_checkpoint(
        path,
        {name: value.double() if value.is_floating_point() else value for name, value in state.items()},
        Header(config).to_json(),
    )
    expected = make_detector(TorchNetwork(make_random_network(config)), Header(config), lower_thresholds())
    assert are_equal_detections(
        load_detector(path, "cpu", lower_thresholds(engine="torch"))(make_scan()), expected(make_scan())
    )
