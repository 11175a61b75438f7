"""The default detectors do not load torch, which takes seconds and 190 MB."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import torch
from detection_samples import make_random_network, make_tiny_config

from lidar_perception.detectors.checkpoint import Header, read_arrays, save_checkpoint
from lidar_perception.detectors.layer_weights import LayerWeights, WeightsMismatch, to_arrays
from lidar_perception.detectors.matrix_kernel import LANES
from lidar_perception.detectors.open import open_detector
from lidar_perception.detectors.pointpillars.config import NetworkConfig
from lidar_perception.detectors.pointpillars.sparse import SparseNetwork

DETECT = """
import sys
import numpy as np
import lidar_perception
cloud = np.random.default_rng(0).uniform([2, -5, -1, 0], [9, 5, 0, 1], (300, 4))
for name in {names}:
    lidar_perception.load_detector(name, device="{device}")(cloud.astype(np.float32))
assert "torch" not in sys.modules
"""

needs_kernels = pytest.mark.skipif(not LANES, reason="Numba compiles for a processor without AVX2")


@needs_kernels
def test_detection_does_not_load_torch():
    code = DETECT.format(names=["fused", "pointpillars", "pointnet"], device="cpu")
    subprocess.run([sys.executable, "-c", code], check=True)


@needs_kernels
@pytest.mark.parametrize(
    "change",
    [
        lambda tensors: tensors.pop("blocks.1.0.1.running_var"),
        lambda tensors: tensors.pop("head.codes.bias"),
        lambda tensors: tensors.pop("pillar_net.norm.num_batches_tracked"),
        lambda tensors: tensors.update(more=np.zeros(1, np.float32)),
        lambda tensors: tensors.update({"neck.laterals.0.bias": np.zeros(9, np.float32)}),
        lambda tensors: tensors.update({"head.scores.bias": np.zeros(18, np.int64)}),
    ],
)
def test_tensors_of_another_network_are_rejected(change):
    config = make_tiny_config("v4")
    tensors = to_arrays(make_random_network(config))
    SparseNetwork(config, tensors)
    change(tensors)
    with pytest.raises(WeightsMismatch):
        SparseNetwork(config, tensors)


def test_folded_norm_equals_layer_and_norm():
    rng = np.random.default_rng(0)
    layer, norm = torch.nn.Conv2d(5, 7, 3, bias=False), torch.nn.BatchNorm2d(7, eps=0.01).eval()
    for values in norm.weight, norm.bias, norm.running_mean, norm.running_var:
        values.data.uniform_(0.5, 2)
    weight, bias = LayerWeights(to_arrays(torch.nn.Sequential(layer, norm)), 0.01).take("0", (7, 5, 3, 3), "1")
    image = torch.from_numpy(rng.normal(size=(1, 5, 6, 6)).astype(np.float32))
    torch.testing.assert_close(
        torch.nn.functional.conv2d(image, torch.from_numpy(weight), torch.from_numpy(bias)), norm(layer(image))
    )


@needs_kernels
def test_bf16_weights_are_read_by_torch(tmp_path):
    config = make_tiny_config("v4")
    path = tmp_path / "w.safetensors"
    from safetensors.torch import save_file

    tensors = {
        name: value.bfloat16() if value.ndim > 1 else value
        for name, value in make_random_network(config).state_dict().items()
    }
    save_file(
        {name: value.contiguous() for name, value in tensors.items()},
        path,
        {"lidar_perception": Header(config).to_json()},
    )
    detector = open_detector(path, "cpu", settings={"pointpillars.warm_up": False})
    assert isinstance(detector.proposer.network, SparseNetwork)


def test_checkpoint_arrays_equal_the_saved_ones(tmp_path):
    network = make_random_network(make_tiny_config("v4"))
    save_checkpoint(tmp_path / "w", network, Header(make_tiny_config("v4")))
    header, tensors = read_arrays(tmp_path / "w", NetworkConfig)
    assert header.config == make_tiny_config("v4")
    assert {*tensors} == {*network.state_dict()}
    for name, value in network.state_dict().items():
        np.testing.assert_array_equal(tensors[name], value.numpy())
