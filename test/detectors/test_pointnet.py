"""PointNet (paper C): inputs, the network, boxes and scores."""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
from pointnet_samples import make_blobs

from lidar_perception.detectors.config_json import parse_config
from lidar_perception.detectors.pointnet import config as config_module
from lidar_perception.detectors.pointnet.box_head import BoxTargets, Outputs, decode, encode
from lidar_perception.detectors.pointnet.calibration import calibrate, compute_calibration_error
from lidar_perception.detectors.pointnet.clusters import (
    RADII_M,
    Clusters,
    find_ground_heights,
    make_clusters,
    make_network_input,
)
from lidar_perception.detectors.pointnet.config import ABLATIONS, NETWORKS, make_pointnet_config
from lidar_perception.detectors.pointnet.losses import compute_cluster_loss
from lidar_perception.detectors.pointnet.network import PointNet, compute_squared_distances, find_nearest, fuse_norms
from lidar_perception.detectors.pointnet.predict import compute_probabilities, predict, select_detections
from lidar_perception.detectors.pointnet.torch_network import TorchPointNet, run_network
from lidar_perception.geometry import wrap_angle
from lidar_perception.types import SENSOR_HEIGHT, InputError, PointCloud

pytestmark = pytest.mark.usefixtures("one_thread")
SMALL = dict(
    points=24,
    centroids=8,
    coarse=4,
    neighbours=(3, 5, 6),
    coarse_neighbours=4,
    point_channels=(6, 8),
    group_channels=(6, 5),
    local_channels=9,
    global_channels=10,
    head_channels=(12, 8),
)


@pytest.fixture
def rng():
    return np.random.default_rng(5)


def make_network(name="improved", **changes):
    """Return a network with random weights and norms, in eval mode."""
    torch.manual_seed(3)
    net = PointNet(make_pointnet_config(name, **{**SMALL, **changes})).eval()
    for buffer_name, buffer in net.named_buffers():
        if "running" in buffer_name:
            buffer.copy_(torch.rand_like(buffer) + 0.1)
    return net


def compute_outputs(net, clusters, **changes):
    inputs = make_network_input(clusters, net.config.points)
    with torch.inference_mode():
        return net(
            *(torch.from_numpy(changes.get(name, getattr(inputs, name))) for name in ("points", "valid", "context"))
        )


# inputs


def test_make_clusters_groups_points_by_id(rng):
    frame = PointCloud(rng.normal(size=(50, 3)).astype(np.float32), rng.random(50, np.float32))
    ids = rng.integers(-2, 6, 50)
    ids[ids == 4] = 5
    ids[:3] = 9, 9, 700
    clusters = make_clusters(frame, ids, 2)
    assert clusters.ids.tolist() == [n for n in np.unique(ids) if n > 0 and (ids == n).sum() > 1]
    for i, cluster_id in enumerate(clusters.ids):
        points = clusters.points[clusters.first[i] : clusters.first[i + 1]]
        assert np.array_equal(points[:, :3], frame.xyz[ids == cluster_id])
        assert np.array_equal(points[:, 3], frame.intensity[ids == cluster_id])
    subset = clusters.take(np.array([2, 0]))
    assert np.array_equal(subset.points[subset.first[1] :], clusters.points[: clusters.first[1]])
    no_clusters = make_clusters(frame, np.zeros(50, int))
    assert len(no_clusters) == 0 and len(make_network_input(no_clusters, 8).points) == 0
    without_intensity = make_clusters(PointCloud(frame.xyz), ids, 2)
    assert np.array_equal(without_intensity.points[:, :3], clusters.points[:, :3])
    assert not without_intensity.points[:, 3].any()


def test_sampled_points_are_unique_and_independent_of_others(rng):
    clusters = make_blobs(rng, [1, 7, 24, 90, 400])
    inputs = make_network_input(clusters, 24)
    assert inputs.valid.sum(axis=1).tolist() == [1, 7, 24, 24, 24]
    for i in range(len(clusters)):
        intensities = clusters.points[clusters.first[i] : clusters.first[i + 1], 3]
        sample = inputs.points[i, inputs.valid[i], 3]
        assert len(np.unique(sample)) == len(sample) and np.isin(sample, intensities).all()
        assert np.isin(inputs.points[i, :, 3], sample).all()
        single = make_network_input(clusters.take(np.array([i])), 24)
        assert np.array_equal(single.points[0], inputs.points[i])
    other_seed = make_network_input(clusters, 24, seed=1)
    assert not np.array_equal(other_seed.points[4], inputs.points[4])
    assert np.array_equal(other_seed.context, inputs.context)


@pytest.mark.parametrize("size", [1, 3, 20, 60])
def test_farthest_points_come_first(rng, size):
    clusters = make_blobs(rng, [size, 7])
    random_inputs = make_network_input(clusters, 24)
    inputs = make_network_input(clusters, 24, farthest_count=10)
    np.testing.assert_array_equal(inputs.valid, random_inputs.valid)
    xyz, points = (x.points[0][x.valid[0]] for x in (inputs, random_inputs))
    order = [0]
    while len(order) < min(10, len(points)):
        distances = np.linalg.norm(points[:, None, :3] - points[order, :3], axis=2).min(axis=1)
        order.append(int(distances.argmax()))
    np.testing.assert_array_equal(xyz[: len(order)], points[order])
    assert {*map(tuple, xyz)} == {*map(tuple, points)}


def test_ground_height_follows_slopes(rng):
    ground = rng.uniform(-40, 40, (20_000, 3))
    ground[:, 2] = 0.05 * ground[:, 0] - 1.7
    ground = ground[np.hypot(ground[:, 0] - 10, ground[:, 1]) > 4]  # no ground nearby, but farther away
    positions = np.array([[10.0, 0], [-20, 5], [30, -30], [39, 39], [500, 0], [9e4, 9e4]])
    heights = find_ground_heights(ground.astype(np.float32), positions)
    for position, height in zip(positions, heights):
        distances = np.hypot(*(ground[:, :2] - position).T)
        radius = next((r for r in RADII_M if (distances <= r).sum() >= 3), None)
        expected = -SENSOR_HEIGHT if radius is None else ground[distances <= radius, 2].mean()
        assert height == pytest.approx(expected, abs=1e-5)
    assert heights[0] == pytest.approx(-1.2, abs=0.02) and heights[4] == heights[5] == -SENSOR_HEIGHT
    assert len(find_ground_heights(ground, np.zeros((0, 2)))) == 0
    assert (find_ground_heights(ground[:0], positions) == -SENSOR_HEIGHT).all()
    # heights are relative to the ground, so a hill changes nothing
    clusters = replace(make_blobs(rng, [20, 30]), ground=np.array([-1.7, -1.5]))
    lifted = replace(clusters, points=clusters.points + np.float32([0, 0, 3, 0]), ground=clusters.ground + 3)
    inputs, lifted_inputs = make_network_input(clusters, 24), make_network_input(lifted, 24)
    assert np.allclose(inputs.context, lifted_inputs.context, atol=1e-5)
    assert np.allclose(inputs.points, lifted_inputs.points, atol=1e-5)
    assert np.allclose(make_network_input(clusters.take(np.array([1])), 24).context[0], inputs.context[1])


def test_network_input_does_not_depend_on_azimuth(rng):
    clusters, angle = make_blobs(rng, [30, 40]), 2.0
    rotated_points = clusters.points.copy()
    cos, sin = np.cos(angle), np.sin(angle)
    rotated_points[:, 0] = cos * clusters.points[:, 0] - sin * clusters.points[:, 1]
    rotated_points[:, 1] = sin * clusters.points[:, 0] + cos * clusters.points[:, 1]
    inputs, rotated_inputs = (
        make_network_input(c, 24) for c in (clusters, Clusters(rotated_points, clusters.first, clusters.ids))
    )
    assert np.allclose(inputs.points, rotated_inputs.points, atol=1e-5)
    assert np.allclose(inputs.context, rotated_inputs.context, atol=1e-5)
    assert np.allclose(wrap_angle(rotated_inputs.azimuths - inputs.azimuths - angle), 0, atol=1e-6)
    # so its box is rotated as well
    net = TorchPointNet(make_network())
    boxes = predict(net, clusters).boxes
    rotated_boxes = predict(net, Clusters(rotated_points, clusters.first, clusters.ids)).boxes
    assert np.allclose(rotated_boxes[:, 0], cos * boxes[:, 0] - sin * boxes[:, 1], atol=1e-3)
    assert np.allclose(wrap_angle(rotated_boxes[:, 6] - boxes[:, 6] - angle), 0, atol=1e-3)


# the network


def test_nearest_neighbours_equal_brute_force(rng):
    xyz = torch.from_numpy(rng.normal(size=(3, 20, 3)))
    valid = torch.from_numpy(rng.random((3, 20)) < 0.7)
    valid[:, :5] = True
    squared, indices = find_nearest(compute_squared_distances(xyz[:, :5], xyz, valid), 4)
    for b in range(3):
        for c in range(5):
            distances = ((xyz[b] - xyz[b, c]) ** 2).sum(-1)
            distances[~valid[b]] = torch.inf
            assert torch.allclose(squared[b, c], distances.sort().values[:4], atol=1e-9)
            assert torch.equal(distances[indices[b, c]].sort().values, distances.sort().values[:4])


@pytest.mark.parametrize("name", ["improved", "ball-density"])
def test_groups_equal_plain_loops(rng, name):
    net = make_network(name)
    inputs = make_network_input(make_blobs(rng, [60, 5]), net.config.points)
    points, valid = torch.from_numpy(inputs.points), torch.from_numpy(inputs.valid)
    with torch.inference_mode():
        features = net.points(points)
        local = net.local(points, features, valid, net.config.centroids)
        for b in range(2):
            for c in range(net.config.centroids):
                centre = points[b, c, :3]
                distances = (points[b, :, :3] - centre).norm(dim=-1)
                valid_indices = torch.nonzero(valid[b])[:, 0]
                order = valid_indices[distances[valid_indices].argsort(stable=True)]
                scales, density = [], []
                for (radius, k), layers in zip(net.config.groups, net.local.nets):
                    neighbours = [i for i in order[:k] if distances[i] <= radius]
                    rows = torch.stack(
                        [torch.cat([(points[b, i, :3] - centre) / radius, points[b, i, 3:]]) for i in neighbours]
                    )
                    scales.append(layers(rows).amax(dim=0))
                    density.append(
                        len(neighbours) / (k * radius)
                        if name == "improved"
                        else (distances[valid_indices] <= radius).sum() / radius**3
                    )
                scales = [scale * weight * 3 / sum(density) for scale, weight in zip(scales, density)]
                expected = net.local.join(torch.cat([*scales, features[b, c]])[None])[0]
                assert torch.allclose(local[b, c], expected, atol=1e-4)


@pytest.mark.parametrize("name", NETWORKS)
def test_padding_points_do_not_change_the_output(rng, name):
    net = make_network(name)
    clusters = make_blobs(rng, [10, 12, 2, 24, 6, 7, 40])
    inputs = make_network_input(clusters, net.config.points)
    changed_points = inputs.points.copy()
    for i in range(len(clusters)):
        valid_indices = np.flatnonzero(inputs.valid[i])
        changed_points[i, len(valid_indices) :] = inputs.points[
            i, rng.choice(valid_indices, net.config.points - len(valid_indices))
        ]
    for output, expected in zip(compute_outputs(net, clusters), compute_outputs(net, clusters, points=changed_points)):
        assert torch.allclose(output, expected, atol=1e-5)
    for output, expected in zip(run_network(net, inputs, chunk=2), compute_outputs(net, clusters)):  # padding removed
        assert torch.allclose(output, expected, atol=1e-5)
    engine = TorchPointNet(net)
    predictions = predict(engine, clusters.take(np.array([2, 0])))
    assert np.allclose(predictions.boxes, predict(engine, clusters).boxes[[2, 0]], atol=1e-4)


def test_batch_norms_are_folded_into_the_layers_before_them(rng):
    clusters = make_blobs(rng, [40, 9, 3])
    expected = compute_outputs(make_network(), clusters)
    for output, folded_output in zip(expected, compute_outputs(fuse_norms(make_network()), clusters)):
        assert torch.allclose(output, folded_output, atol=1e-4)


def test_ablations_are_distinct_networks():
    configs = {name: make_pointnet_config(name) for name in ABLATIONS}
    variants = {(c.clustering, c.groups, c.mrg, c.skip) for c in configs.values()}
    assert len(variants) == len(ABLATIONS)
    sizes = {name: sum(p.numel() for p in PointNet(config).parameters()) for name, config in configs.items()}
    assert sizes["base"] == sizes["dynamic-threshold"] < sizes["skip"] < sizes["msg-skip"] < (sizes["improved"])
    assert make_pointnet_config("pointnet").groups == ()
    assert len(make_pointnet_config("pointnet2").groups) == 1
    assert configs["base"].clustering.euclidean.threshold == "fixed"


def test_config_survives_json_and_rejects_invalid_values():
    config = make_pointnet_config("pointnet2", points=64)
    assert parse_config(config_module.PointNetConfig, asdict(config), "") == config
    with pytest.raises(InputError, match="unknown network 'resnet'"):
        make_pointnet_config("resnet")
    with pytest.raises(InputError, match="Bus"):
        make_pointnet_config(classes=("Bus",), sizes=((1, 1, 1),))
    with pytest.raises(InputError, match="length"):
        make_pointnet_config(classes=("Car",))
    with pytest.raises(InputError, match="later version"):
        parse_config(config_module.PointNetConfig, {"wings": 2}, "")
    for changes in (
        dict(radii=(0.4, 0.2, 0.1)),
        dict(centroids=500),
        dict(neighbours=(1, 2)),
        dict(sampling="nearest"),
        dict(density=""),
    ):
        with pytest.raises(InputError):
            make_pointnet_config(**changes)


# boxes and scores


def make_outputs(targets: BoxTargets, bins: int) -> Outputs:
    count = len(targets.yaw_bins)
    bin_scores = torch.zeros(count, bins)
    bin_scores[torch.arange(count), torch.from_numpy(targets.yaw_bins)] = 1
    residuals = torch.from_numpy(targets.yaw_residuals)[:, None].expand(count, bins)
    return Outputs(
        torch.zeros(count, 4), torch.from_numpy(targets.centres), torch.from_numpy(targets.sizes), bin_scores, residuals
    )


def test_decoding_undoes_encoding(rng):
    config, count = make_pointnet_config(), 200
    clusters = make_blobs(rng, [5] * count)
    inputs = make_network_input(clusters, 8)
    labels = rng.integers(0, 3, count)
    sizes = np.array(config.sizes)[labels] * np.exp(rng.uniform(-1.5, 1.5, (count, 3)))
    boxes = np.column_stack([inputs.centres + rng.normal(size=(count, 3)), sizes, rng.uniform(-np.pi, np.pi, count)])
    targets = encode(boxes, labels, inputs.centres, inputs.azimuths, config)
    assert np.abs(targets.yaw_residuals).max() <= 1 + 1e-6
    outputs = Outputs(*(x.numpy() for x in make_outputs(targets, config.yaw_bins)))
    decoded = decode(outputs, inputs, config, labels)
    assert np.allclose(decoded[:, :6], boxes[:, :6], atol=1e-4)
    assert np.allclose(wrap_angle(decoded[:, 6] - boxes[:, 6]), 0, atol=1e-5)


def test_loss_is_lowest_at_targets_and_ignores_background(rng):
    config = make_pointnet_config()
    inputs = make_network_input(make_blobs(rng, [5] * 6), 8)
    boxes = np.column_stack([inputs.centres, np.full((6, 3), 1.5), np.linspace(-3, 3, 6)])
    targets = encode(boxes, np.zeros(6, int), inputs.centres, inputs.azimuths, config)
    labels = torch.tensor([0, 0, 0, 0, 3, -1])
    has_box = labels == 0
    exact_outputs = make_outputs(targets, config.yaw_bins)
    exact_outputs.logits[torch.arange(6), labels.clamp(min=0)] = 30.0
    exact_outputs = exact_outputs._replace(yaw_bins=exact_outputs.yaw_bins * 60)
    tensors = BoxTargets(*map(torch.from_numpy, targets))
    assert compute_cluster_loss(exact_outputs, labels, tensors, has_box).total < 1e-4
    for name in ("logits", "centres", "sizes", "yaw_bins", "yaw_residuals"):
        wrong_values = getattr(exact_outputs, name).clone()
        wrong_values[0] = wrong_values[0].roll(1) if name in ("logits", "yaw_bins") else wrong_values[0] + 0.5
        assert (
            compute_cluster_loss(exact_outputs._replace(**{name: wrong_values}), labels, tensors, has_box).total > 0.01
        )
    shifted_centres = exact_outputs.centres.clone()
    shifted_centres[4:] += 9
    assert compute_cluster_loss(exact_outputs._replace(centres=shifted_centres), labels, tensors, has_box).total < 1e-4
    loss_without_boxes = compute_cluster_loss(exact_outputs, labels, tensors, has_box & False)
    assert loss_without_boxes.boxes == 0 and torch.isfinite(loss_without_boxes.total)


def test_calibration_makes_scores_match_accuracy(rng):
    net = make_network()
    truth = torch.from_numpy(rng.normal(size=(4000, 4)))
    labels = torch.distributions.Categorical(logits=truth).sample()
    logits = truth * 4 + torch.tensor([2.0, 0, 0, 0])  # overconfident and biased to one class
    initial_error = compute_calibration_error(torch.softmax(logits, 1).numpy(), labels.numpy())
    calibrate(net, logits, labels)
    final_error = compute_calibration_error(
        compute_probabilities(*(x.numpy() for x in (logits, net.temperature, net.offsets))), labels.numpy()
    )
    assert final_error < 0.03 < 0.1 < initial_error
    assert net.temperature.item() == pytest.approx(4, rel=0.1)
    temperature = net.temperature.clone()
    calibrate(net, logits, torch.full_like(labels, -1))
    assert torch.equal(net.temperature, temperature)
    assert compute_calibration_error(np.eye(3), np.arange(3)) == 0.0
    assert compute_calibration_error(np.eye(3), np.array([1, 2, 0])) == 1.0


def test_best_of_overlapping_boxes_is_kept(rng):
    config = make_pointnet_config()
    predictions = predict(TorchPointNet(make_network()), make_blobs(rng, [20] * 4))
    boxes = np.tile(np.array([5, 5, 0, 4, 2, 1.5, 0.3], np.float32), (4, 1))
    boxes[3, 0] += 20
    probabilities = np.array([[0.6, 0, 0, 0.4], [0.9, 0, 0, 0.1], [0.1, 0, 0, 0.9], [0.5, 0, 0, 0.5]], np.float32)
    overlapping = predictions.__class__(probabilities, np.zeros(4, int), boxes)
    detections = select_detections(overlapping, config, (0.3, 0.3, 0.3))
    assert detections.scores.tolist() == pytest.approx([0.9, 0.5])
    assert len(select_detections(overlapping, config, (0.95, 0, 0))) == 0
