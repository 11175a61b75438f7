"""The sparse engine of PointPillars agrees with torch."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
import torch
from detection_samples import (
    are_equal_detections,
    make_detector,
    make_random_detector,
    make_random_network,
    make_tiny_config,
)

from lidar_perception.data.open import open_recording
from lidar_perception.detectors.checkpoint import Header, save_checkpoint
from lidar_perception.detectors.layer_weights import to_arrays
from lidar_perception.detectors.matrix_kernel import LANES
from lidar_perception.detectors.open import open_detector
from lidar_perception.detectors.parallel import run_in_parts
from lidar_perception.detectors.params import NmsParams
from lidar_perception.detectors.pointpillars import sparse
from lidar_perception.detectors.pointpillars.config import make_config
from lidar_perception.detectors.pointpillars.expert import NetworkInput
from lidar_perception.detectors.pointpillars.pillars import Pillars, make_pillars
from lidar_perception.detectors.pointpillars.sparse_layers import dilate, shrink
from lidar_perception.detectors.pointpillars.torch_network import TorchNetwork
from lidar_perception.param_fields import with_values
from lidar_perception.runs.threads import set_thread_count
from lidar_perception.simulation.drive import simulate_scan
from lidar_perception.simulation.sensor import HDL64E
from lidar_perception.types import InputError

pytestmark = [
    pytest.mark.usefixtures("one_thread"),
    pytest.mark.skipif(not LANES, reason="Numba compiles for a processor without AVX2"),
]

TOLERANCE = 1e-4  # for features and logits of about 1 to 30
WIDE = dict(low=(-12.8, -14.08, -3.0), high=(12.8, 14.08, 1.0))  # 176 x 160 pillars


def make_strong_network(config, seed=0):
    """Return a network in which each point affects the outputs of the last layer."""
    network = make_random_network(config, seed)
    for module in network.modules():
        if isinstance(module, torch.nn.Conv2d) and module.kernel_size == (3, 3):
            module.weight.mul_(2.0)
    return network


def make_sparse_network(network):
    return sparse.SparseNetwork(network.pillar_net.config, to_arrays(network))


def make_inputs(config, points, map_fraction, seed=0, range_fraction=1.0):
    """Return pillars of random points, and a cluster map.

    Args:
        map_fraction: fraction of the cells that are filled in the map.
        range_fraction: fraction of each axis that contains points and filled cells.
    """
    rng = np.random.default_rng(seed)
    cloud = rng.uniform([*config.low, 0], [*config.high, 1], (points, 4))
    cloud[:, :2] = config.low[:2] + range_fraction * (cloud[:, :2] - config.low[:2])
    if config.cluster_ids:
        cloud = np.column_stack([cloud, rng.integers(0, 60, points)])
    maps = (rng.random((1, 3, *config.grid)) < map_fraction).astype(np.uint8)
    for axis in 2, 3:
        maps.swapaxes(2, axis)[:, :, int(range_fraction * maps.shape[axis]) :] = 0
    return (make_pillars(cloud.astype(np.float32), config), maps if config.pseudo_map else None)


def run_torch(network, torch_pillars, maps):
    """Return features and logits (H * W, C) of all cells."""
    torch_pillars = Pillars(*map(torch.from_numpy, torch_pillars[:3]), *torch_pillars[3:])
    features = network.compute_features(torch_pillars, None if maps is None else torch.from_numpy(maps))
    return [x[0].flatten(1).T.numpy() for x in (features, network.head.scores(features))]


def assert_equal(config, points, map_fraction, reach=None, seed=0, range_fraction=1.0):
    network = make_strong_network(config, seed)
    pillars, maps = make_inputs(config, points, map_fraction, seed, range_fraction)
    with torch.inference_mode():
        expected = run_torch(network, pillars, maps)
    cells, features, logits = make_sparse_network(network).evaluate(pillars, maps, reach)
    assert len(cells) == len(expected[0]) or reach is not None
    values = features.get_features(cells)[:, : expected[0].shape[1]]
    for actual, required in (values, expected[0]), (logits, expected[1]):
        np.testing.assert_allclose(actual, required[cells], rtol=0, atol=TOLERANCE)
    return expected[0]


@pytest.mark.parametrize("version", ["v1", "v2", "v4"])
@pytest.mark.parametrize(("points", "map_fraction"), [(0, 0.0), (1, 0.0), (5, 0.01), (20_000, 1.0)])
def test_small_network_equals_torch(version, points, map_fraction):
    assert_equal(make_tiny_config(version), points, map_fraction, seed=points)


@pytest.mark.parametrize(
    ("version", "size", "changes"),
    [
        ("v1", "compact", WIDE),
        ("v2", "compact", WIDE),
        ("v4", "compact", WIDE),
        ("v4", "compact", dict(low=(0.0, -14.08, -3.0), high=(25.6, 14.08, 1.0), cell=0.08)),
        ("v4", "full", dict(low=(0.0, -5.12, -3.0), high=(10.24, 5.12, 1.0))),
        ("v1", "full", dict(low=(-5.12, -5.12, -3.0), high=(5.12, 5.12, 1.0))),
        ("v4", "compact", dict(WIDE, block_strides=(1, 2, 4))),
        (
            "v4",
            "compact",
            dict(low=(0.0, -7.68, -3.0), high=(15.36, 7.68, 1.0), block_strides=(2, 3, 2), classes=("Car",)),
        ),
        (
            "v4",
            "compact",
            dict(
                WIDE,
                block_strides=(2, 2),
                block_channels=(24, 40),
                block_layers=(0, 2),
                map_channels=(6,),
                pillar_channels=10,
            ),
        ),
    ],
)
def test_shipped_sizes_equal_torch_also_at_the_border(version, size, changes):
    config = make_config(version, size, **changes)
    features = assert_equal(config, 12, 0.001, range_fraction=0.1)
    empty_features = assert_equal(config, 0, 0.0)
    max_change = np.abs(features - empty_features).max(axis=1)
    assert max_change.max() > 0.05 and (size == "full" or max_change.min() < 1e-6)


def test_head_is_evaluated_only_near_points():
    config = make_config("v4", "compact", **WIDE)
    assert_equal(config, 10, 0.0, reach=sparse.REACH)
    pillars, maps = make_inputs(config, 10, 0.0)
    network = make_sparse_network(make_strong_network(config))
    prediction = network(pillars, maps)
    occupied = np.zeros(config.grid, bool)
    occupied.ravel()[pillars.cells] = True
    rows, columns = np.nonzero(shrink(occupied, 2))
    height, width = config.head_grid
    distance = np.maximum(
        np.abs(np.arange(height)[:, None, None] - rows), np.abs(np.arange(width)[:, None] - columns)
    ).min(axis=2)
    cells = np.flatnonzero(distance <= 6)
    per_cell = config.anchors_per_cell
    np.testing.assert_array_equal(prediction.anchors, (cells[:, None] * per_cell + np.arange(per_cell)).ravel())
    assert prediction.logits.shape == (len(cells) * per_cell, 3)


def test_boxes_equal_torch_at_any_anchors():
    config = make_tiny_config("v4")
    network, (pillars, maps) = make_strong_network(config), make_inputs(config, 30, 0.02)
    expected, actual = TorchNetwork(network)(pillars, maps), make_sparse_network(network)(pillars, maps)
    rows = np.array([0, 5, 17, len(actual.anchors) - 1])
    for actual_values, expected_values in zip(actual.compute_boxes(rows), expected.compute_boxes(actual.anchors[rows])):
        np.testing.assert_allclose(actual_values, expected_values, rtol=0, atol=TOLERANCE)


def test_result_does_not_depend_on_threads_or_earlier_clouds(monkeypatch):
    monkeypatch.setattr(sparse, "MIN_PER_PART", 1000)
    config = make_config("v4", "compact", **WIDE)
    network = make_sparse_network(make_strong_network(config))
    sparse_inputs, dense_inputs = make_inputs(config, 50, 0.001), make_inputs(config, 3000, 0.05, seed=1)
    expected = network(*sparse_inputs)
    set_thread_count(3)
    dense_result = network(*dense_inputs)
    repeated = network(*sparse_inputs)
    assert np.array_equal(expected.logits, repeated.logits)
    assert np.array_equal(expected.anchors, repeated.anchors)
    rows = np.arange(9)
    assert all(map(np.array_equal, expected.compute_boxes(rows), repeated.compute_boxes(rows)))
    set_thread_count(1)
    assert np.array_equal(dense_result.logits, network(*dense_inputs).logits)


def test_error_in_a_worker_thread_is_raised(monkeypatch):
    def fail(begin, end):
        if begin:
            raise ZeroDivisionError

    set_thread_count(2)
    with pytest.raises(ZeroDivisionError):
        run_in_parts(fail, 100, 4)


@pytest.mark.parametrize("layer", ["pillar_net.linear.weight", "blocks.1.0.0.weight", "neck.laterals.2.weight"])
def test_nan_weights_are_reported(layer):
    config = make_tiny_config("v4")
    network = make_random_network(config)
    network.get_parameter(layer).fill_(torch.nan)
    detector = make_detector(make_sparse_network(network), Header(config))
    rng = np.random.default_rng(0)
    cloud = rng.uniform([2, -3, -1, 0], [6, 3, 0, 1], (200, 4)).astype(np.float32)
    result = detector(cloud, ground=np.zeros(200, bool), cluster_ids=np.zeros(200, int))
    assert len(result.detections) == 0 and result.problem


@pytest.mark.parametrize(
    "config, settings, message",
    [
        (make_tiny_config("v0"), {}, "ground"),
        (make_tiny_config("v3"), {}, "ground"),
        (make_tiny_config("v1", fusion="concat"), {}, "neck"),
        (make_tiny_config("v1", neck="deconv"), {}, "neck"),
        (make_tiny_config("v1", max_points=4, zero_row=True), {}, "padded with zeros"),
        (make_tiny_config("v4"), {"pointpillars.amp": "bf16"}, "16 bits"),
        (make_tiny_config("v4"), {}, "AVX2"),
    ],
)
def test_unsupported_networks_run_in_torch(config, settings, message, tmp_path, monkeypatch):
    path = tmp_path / "a.safetensors"
    save_checkpoint(path, make_random_network(config), Header(config))
    if message == "AVX2":
        monkeypatch.setattr(sparse, "LANES", 0)
    settings = {**settings, "pointpillars.warm_up": False}
    detector = open_detector(path, "cpu", settings=settings)
    assert isinstance(detector.proposer.network, TorchNetwork)
    with pytest.raises(InputError, match=f"{message}.*; set engine: auto or torch"):
        open_detector(path, "cpu", settings={**settings, "pointpillars.engine": "sparse"})


@pytest.mark.parametrize("weights", ["fused", "pointpillars"])
def test_parameter_selects_the_engine(weights):
    base_settings = {f"{weights}.warm_up": False}
    for engine, expected in ("auto", True), ("sparse", True), ("torch", False):
        detector = open_detector(weights, "cpu", settings={**base_settings, f"{weights}.engine": engine})
        assert isinstance(detector.proposer.network, sparse.SparseNetwork) == expected
    with pytest.raises(InputError, match="engine"):
        open_detector(
            "pointpillars",
            "cpu",
            settings={"pointpillars.warm_up": False, "pointpillars.engine": "sparse", "pointpillars.version": "v0"},
        )


@pytest.fixture(scope="module")
def both_engines():
    return [
        open_detector("fused", "cpu", settings={"fused.engine": engine, "fused.warm_up": False})
        for engine in ("torch", "sparse")
    ]


def assert_same_detections(detectors, frames):
    total = 0
    for frame in frames:
        by_torch, by_sparse = (detector(frame).detections for detector in detectors)
        assert np.array_equal(by_torch.class_ids, by_sparse.class_ids)
        np.testing.assert_allclose(by_torch.boxes, by_sparse.boxes, rtol=0, atol=1e-4)
        np.testing.assert_allclose(by_torch.scores, by_sparse.scores, rtol=0, atol=1e-5)
        total += len(by_torch)
    return total


@pytest.mark.parametrize("range", ["ahead", "around"])
def test_detections_of_a_simulated_street_equal_torch(range, both_engines, streets):
    detectors = [detector.with_range(range) for detector in both_engines]
    assert assert_same_detections(detectors, [simulate_scan(0, 0, HDL64E).frame]) > 5


def test_detections_of_kitti_frames_equal_torch(data, both_engines):
    frames = [frame.load() for frame in open_recording(data / "kitti_object").frames[:3]]
    assert assert_same_detections(both_engines, frames) > 3


@pytest.mark.parametrize("version", ["v1", "v2", "v4"])
def test_detector_of_random_weights_equals_torch(version):
    detector = make_random_detector(version)
    detector.params = with_values(detector.params, {"pointpillars.nms.candidates": 5000})
    header = detector.proposer.header
    sparse_detector = make_detector(make_sparse_network(make_random_network(header.config)), header, detector.params)
    rng = np.random.default_rng(3)
    cloud = rng.uniform([0, -5, -1.5, 0], [10, 5, 0.5, 1], (4000, 4)).astype(np.float32)
    columns = dict(ground=np.zeros(4000, bool), cluster_ids=rng.integers(0, 9, 4000))
    result = detector(cloud, **columns)
    assert len(result.detections) > 3
    assert are_equal_detections(sparse_detector(cloud, **columns), result, atol=TOLERANCE)


def test_cloud_without_pillars_has_no_detections():
    detector = make_random_detector("v4")
    proposer, config = detector.proposer, detector.proposer.config
    proposer.network = make_sparse_network(make_random_network(config))
    nan_input = NetworkInput(np.full((10, 4), np.nan, np.float32), np.zeros((3, *config.grid), np.uint8))
    _, predictions = proposer._predict({False: nan_input})
    result = proposer._decode(predictions, [0.5] * 3, NmsParams())
    assert len(result.detections) == 0 and result.best == {} and result.problem is None


KERNEL = """
import numpy as np
from lidar_perception.detectors.pointpillars import sparse_kernels as kernels
from lidar_perception.detectors.matrix_kernel import BLOCK, LANES
assert LANES == 8
rng = np.random.default_rng(0)
rows = rng.normal(size=(50, 12)).astype(np.float32)
rows[0] = 0
index = np.zeros((8, 9), np.int32)
index[1:-1, 1:-1] = rng.integers(0, 50, (6, 7))
weights = rng.normal(size=(2, 9, 12, BLOCK)).astype(np.float32)
cells = np.flatnonzero(rng.random(42) < 0.7).astype(np.int32)
bias = np.ones(2 * BLOCK, np.float32)
sums = np.empty((len(cells), 2 * BLOCK), np.float32)
kernels.convolve(index, rows, cells, 7, 1, weights, bias, sums, np.float32(-2.0), 0, len(cells))
for cell, found in zip(cells, sums):
    y, x = divmod(cell, 7)
    read = rows[index[y:y + 3, x:x + 3].ravel()]
    wanted = 1 + np.einsum("tc,btco->bo", read.astype(float), weights).ravel()
    np.testing.assert_allclose(found, np.maximum(wanted, -2), atol=1e-4)
"""


def test_avx2_kernel_runs_on_avx512_processors():
    if LANES != 16:
        pytest.skip("the other tests have run it")
    features = "+sse,+sse2,+sse3,+ssse3,+sse4.1,+sse4.2,+popcnt,+avx,+avx2,+fma,+bmi,+bmi2,+lzcnt"
    environment = {**os.environ, "NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": features}
    subprocess.run([sys.executable, "-c", KERNEL], env=environment, check=True)


@pytest.mark.parametrize("variable", ["NUMBA_DISABLE_JIT=1", "NUMBA_ENABLE_AVX=0"])
def test_processor_without_vector_kernel_uses_torch(variable):
    name, value = variable.split("=")
    code = "from lidar_perception.detectors.matrix_kernel import LANES; assert LANES == 0"
    subprocess.run([sys.executable, "-c", code], env={**os.environ, name: value}, check=True)


def test_dilation_grows_along_both_axes():
    mask = np.zeros((9, 7), bool)
    mask[0, 6] = mask[5, 2] = True
    expected = np.zeros_like(mask)
    expected[:3, 4:] = expected[3:8, :5] = True
    np.testing.assert_array_equal(dilate(mask, 2), expected)
