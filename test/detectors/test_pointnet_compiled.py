"""The compiled PointNet agrees with torch."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from pointnet_samples import make_blobs, make_random_detector, make_random_network, make_small_config

from lidar_perception.detectors.layer_weights import to_arrays
from lidar_perception.detectors.matrix_kernel import LANES
from lidar_perception.detectors.open import open_detector
from lidar_perception.detectors.pointnet import compiled
from lidar_perception.detectors.pointnet.clusters import make_network_input
from lidar_perception.detectors.pointnet.compiled import CompiledPointNet
from lidar_perception.detectors.pointnet.config import NETWORKS, make_pointnet_config
from lidar_perception.detectors.pointnet.network import fuse_norms
from lidar_perception.detectors.pointnet.predict import predict
from lidar_perception.detectors.pointnet.torch_network import run_network
from lidar_perception.runs.threads import set_thread_count

pytestmark = [
    pytest.mark.usefixtures("one_thread"),
    pytest.mark.skipif(not LANES, reason="Numba compiles for a processor without AVX2"),
]

SIZES = [1, 2, 3, 5, 11, 12, 13, 31, 32, 33, 100, 300, 7]
TOLERANCE = 1e-4  # for values of about 1 to 20


def compile_network(network):
    return CompiledPointNet(network.config, to_arrays(network))


def assert_equal(config, clusters, seed=0):
    network = make_random_network(config, seed)
    inputs = make_network_input(clusters, config.points, farthest_count=config.farthest_count)
    with torch.inference_mode():
        outputs, expected_outputs = compile_network(network)(inputs), run_network(network, inputs)
    for actual, expected in zip(outputs, expected_outputs):
        assert actual.shape == expected.shape
        np.testing.assert_allclose(actual, expected, rtol=0, atol=TOLERANCE)
    assert expected_outputs.logits.std(dim=0).max() > 0.1  # clusters have different outputs


@pytest.mark.parametrize("spread", [0.05, 0.4, 3.0])
@pytest.mark.parametrize("name", NETWORKS)
def test_compiled_networks_equal_torch(name, spread):
    rng = np.random.default_rng(0)
    assert_equal(make_small_config(name), make_blobs(rng, SIZES, spread))


@pytest.mark.parametrize(
    "changes",
    [
        dict(),
        dict(points=200, centroids=40),
        dict(radii=(0.3,), neighbours=(5,)),
        dict(
            point_channels=(20,),
            group_channels=(7, 9, 33),
            local_channels=50,
            global_channels=70,
            head_channels=(5,),
            classes=("Car",),
            sizes=((3.9, 1.6, 1.5),),
            yaw_bins=5,
        ),
    ],
)
def test_networks_of_other_widths_equal_torch(changes):
    rng = np.random.default_rng(1)
    assert_equal(make_pointnet_config(**changes), make_blobs(rng, SIZES))


def test_batching_does_not_change_results(monkeypatch):
    network = compile_network(make_random_network(make_small_config()))
    clusters = make_blobs(np.random.default_rng(2), SIZES * 3)
    predictions = predict(network, clusters)
    indices = np.array([4, 0, 30, 17])
    subset_predictions = predict(network, clusters.take(indices))
    np.testing.assert_array_equal(subset_predictions.probabilities, predictions.probabilities[indices])
    monkeypatch.setattr(compiled, "CHUNK", 2)
    set_thread_count(3)
    threaded_predictions = predict(network, clusters)
    np.testing.assert_array_equal(threaded_predictions.probabilities, predictions.probabilities)
    np.testing.assert_array_equal(threaded_predictions.boxes, predictions.boxes)
    assert len(predict(network, clusters.take(np.zeros(0, int))).boxes) == 0
    empty_input = make_network_input(clusters.take(np.zeros(0, int)), 32)
    assert all(len(x) == 0 for x in network(empty_input))


@pytest.mark.parametrize(
    "name", ["points.0.0.weight", "local.nets.1.0.0.weight", "coarse.net.0.0.weight", "fine.0.0.bias"]
)
def test_nan_weights_give_nan_logits(name):
    network = fuse_norms(make_random_network(make_small_config()))
    network.get_parameter(name).view(-1)[0] = torch.nan
    inputs = make_network_input(make_blobs(np.random.default_rng(3), SIZES), 32)
    assert np.isnan(compile_network(network)(inputs).logits).all()


@pytest.mark.parametrize("weights", ["fused", "pointnet"])
def test_torch_engine_compiles_nothing(weights):
    for engine in "auto", "torch":
        detector = open_detector(weights, "cpu", settings={f"{weights}.warm_up": False, f"{weights}.engine": engine})
        assert isinstance(detector.classifier.network, CompiledPointNet) == (engine == "auto")


def test_compiled_classifier_equals_torch():
    classifier = make_random_detector().classifier
    clusters = make_blobs(np.random.default_rng(4), SIZES)
    predictions = classifier.predict(clusters)
    classifier.network.compiled = None
    expected = classifier.predict(clusters)
    np.testing.assert_allclose(predictions.probabilities, expected.probabilities, rtol=0, atol=1e-5)
    np.testing.assert_allclose(predictions.boxes, expected.boxes, rtol=0, atol=TOLERANCE)
