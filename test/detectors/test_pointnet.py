"""PointNet (paper C): inputs, the network, boxes and scores."""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
from pointnet_samples import blobs

from lidar_perception.detectors.config_json import parse_config
from lidar_perception.detectors.pointnet import config as config_module
from lidar_perception.detectors.pointnet.box_head import BoxTargets, Outputs, decode, encode
from lidar_perception.detectors.pointnet.calibration import calibrate, calibration_error
from lidar_perception.detectors.pointnet.clusters import (
    RADII_M,
    Clusters,
    find_ground_heights,
    make_clusters,
    make_network_input,
)
from lidar_perception.detectors.pointnet.config import ABLATIONS, NETWORKS, make_pointnet_config
from lidar_perception.detectors.pointnet.losses import cluster_loss
from lidar_perception.detectors.pointnet.network import (
    compute_squared_distances,
    find_nearest,
    fuse_norms,
    make_pointnet,
)
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


def network(name="improved", **changes):
    """Return a network with random weights and norms, in eval mode."""
    torch.manual_seed(3)
    net = make_pointnet(make_pointnet_config(name, **{**SMALL, **changes})).eval()
    for buffer_name, buffer in net.named_buffers():
        if "running" in buffer_name:
            buffer.copy_(torch.rand_like(buffer) + 0.1)
    return net


def called(net, clusters, **changes):
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
    for i, number in enumerate(clusters.ids):
        own = clusters.points[clusters.first[i] : clusters.first[i + 1]]
        assert np.array_equal(own[:, :3], frame.xyz[ids == number])
        assert np.array_equal(own[:, 3], frame.intensity[ids == number])
    some = clusters.take(np.array([2, 0]))
    assert np.array_equal(some.points[some.first[1] :], clusters.points[: clusters.first[1]])
    none = make_clusters(frame, np.zeros(50, int))
    assert len(none) == 0 and len(make_network_input(none, 8).points) == 0
    plain = make_clusters(PointCloud(frame.xyz), ids, 2)
    assert np.array_equal(plain.points[:, :3], clusters.points[:, :3])
    assert not plain.points[:, 3].any()


def test_sampled_points_are_unique_and_independent_of_others(rng):
    clusters = blobs(rng, [1, 7, 24, 90, 400])
    inputs = make_network_input(clusters, 24)
    assert inputs.valid.sum(axis=1).tolist() == [1, 7, 24, 24, 24]
    for i in range(len(clusters)):
        own = clusters.points[clusters.first[i] : clusters.first[i + 1], 3]
        drawn = inputs.points[i, inputs.valid[i], 3]
        assert len(np.unique(drawn)) == len(drawn) and np.isin(drawn, own).all()
        assert np.isin(inputs.points[i, :, 3], drawn).all()
        alone = make_network_input(clusters.take(np.array([i])), 24)
        assert np.array_equal(alone.points[0], inputs.points[i])
    other = make_network_input(clusters, 24, seed=1)
    assert not np.array_equal(other.points[4], inputs.points[4])
    assert np.array_equal(other.context, inputs.context)


@pytest.mark.parametrize("size", [1, 3, 20, 60])
def test_farthest_points_come_first(rng, size):
    clusters = blobs(rng, [size, 7])
    plain = make_network_input(clusters, 24)
    inputs = make_network_input(clusters, 24, farthest=10)
    np.testing.assert_array_equal(inputs.valid, plain.valid)
    xyz, drawn = (x.points[0][x.valid[0]] for x in (inputs, plain))
    order = [0]
    while len(order) < min(10, len(drawn)):
        apart = np.linalg.norm(drawn[:, None, :3] - drawn[order, :3], axis=2).min(axis=1)
        order.append(int(apart.argmax()))
    np.testing.assert_array_equal(xyz[: len(order)], drawn[order])
    assert {*map(tuple, xyz)} == {*map(tuple, drawn)}


def test_ground_height_follows_slopes(rng):
    flat = rng.uniform(-40, 40, (20_000, 3))
    flat[:, 2] = 0.05 * flat[:, 0] - 1.7
    flat = flat[np.hypot(flat[:, 0] - 10, flat[:, 1]) > 4]  # no ground nearby, but farther away
    indices = np.array([[10.0, 0], [-20, 5], [30, -30], [39, 39], [500, 0], [9e4, 9e4]])
    found = find_ground_heights(flat.astype(np.float32), indices)
    for place, height in zip(indices, found):
        apart = np.hypot(*(flat[:, :2] - place).T)
        near = next((r for r in RADII_M if (apart <= r).sum() >= 3), None)
        wanted = -SENSOR_HEIGHT if near is None else flat[apart <= near, 2].mean()
        assert height == pytest.approx(wanted, abs=1e-5)
    assert found[0] == pytest.approx(-1.2, abs=0.02) and found[4] == found[5] == -SENSOR_HEIGHT
    assert len(find_ground_heights(flat, np.zeros((0, 2)))) == 0
    assert (find_ground_heights(flat[:0], indices) == -SENSOR_HEIGHT).all()
    # heights are relative to the ground, so a hill changes nothing
    clusters = replace(blobs(rng, [20, 30]), ground=np.array([-1.7, -1.5]))
    lifted = replace(clusters, points=clusters.points + np.float32([0, 0, 3, 0]), ground=clusters.ground + 3)
    here, there = make_network_input(clusters, 24), make_network_input(lifted, 24)
    assert np.allclose(here.context, there.context, atol=1e-5)
    assert np.allclose(here.points, there.points, atol=1e-5)
    assert np.allclose(make_network_input(clusters.take(np.array([1])), 24).context[0], here.context[1])


def test_network_input_does_not_depend_on_azimuth(rng):
    clusters, turn = blobs(rng, [30, 40]), 2.0
    turned = clusters.points.copy()
    cos, sin = np.cos(turn), np.sin(turn)
    turned[:, 0] = cos * clusters.points[:, 0] - sin * clusters.points[:, 1]
    turned[:, 1] = sin * clusters.points[:, 0] + cos * clusters.points[:, 1]
    here, there = (make_network_input(c, 24) for c in (clusters, Clusters(turned, clusters.first, clusters.ids)))
    assert np.allclose(here.points, there.points, atol=1e-5)
    assert np.allclose(here.context, there.context, atol=1e-5)
    assert np.allclose(wrap_angle(there.azimuths - here.azimuths - turn), 0, atol=1e-6)
    # so its box is rotated as well
    net = TorchPointNet(network())
    first = predict(net, clusters).boxes
    second = predict(net, Clusters(turned, clusters.first, clusters.ids)).boxes
    assert np.allclose(second[:, 0], cos * first[:, 0] - sin * first[:, 1], atol=1e-3)
    assert np.allclose(wrap_angle(second[:, 6] - first[:, 6] - turn), 0, atol=1e-3)


# the network


def test_nearest_neighbours_equal_brute_force(rng):
    xyz = torch.from_numpy(rng.normal(size=(3, 20, 3)))
    valid = torch.from_numpy(rng.random((3, 20)) < 0.7)
    valid[:, :5] = True
    squared, indices = find_nearest(compute_squared_distances(xyz[:, :5], xyz, valid), 4)
    for b in range(3):
        for c in range(5):
            apart = ((xyz[b] - xyz[b, c]) ** 2).sum(-1)
            apart[~valid[b]] = torch.inf
            assert torch.allclose(squared[b, c], apart.sort().values[:4], atol=1e-9)
            assert torch.equal(apart[indices[b, c]].sort().values, apart.sort().values[:4])


@pytest.mark.parametrize("name", ["improved", "ball-density"])
def test_groups_equal_plain_loops(rng, name):
    net = network(name)
    inputs = make_network_input(blobs(rng, [60, 5]), net.config.points)
    points, valid = torch.from_numpy(inputs.points), torch.from_numpy(inputs.valid)
    with torch.inference_mode():
        features = net.points(points)
        local = net.local(points, features, valid, net.config.centroids)
        for b in range(2):
            for c in range(net.config.centroids):
                middle = points[b, c, :3]
                apart = (points[b, :, :3] - middle).norm(dim=-1)
                real = torch.nonzero(valid[b])[:, 0]
                order = real[apart[real].argsort(stable=True)]
                scales, density = [], []
                for (radius, k), part in zip(net.config.groups, net.local.nets):
                    near = [i for i in order[:k] if apart[i] <= radius]
                    rows = torch.stack(
                        [torch.cat([(points[b, i, :3] - middle) / radius, points[b, i, 3:]]) for i in near]
                    )
                    scales.append(part(rows).amax(dim=0))
                    density.append(
                        len(near) / (k * radius) if name == "improved" else (apart[real] <= radius).sum() / radius**3
                    )
                scales = [scale * d * 3 / sum(density) for scale, d in zip(scales, density)]
                wanted = net.local.join(torch.cat([*scales, features[b, c]])[None])[0]
                assert torch.allclose(local[b, c], wanted, atol=1e-4)


@pytest.mark.parametrize("name", NETWORKS)
def test_padding_points_change_nothing(rng, name):
    net = network(name)
    clusters = blobs(rng, [10, 12, 2, 24, 6, 7, 40])
    inputs = make_network_input(clusters, net.config.points)
    other = inputs.points.copy()
    for i in range(len(clusters)):
        real = np.flatnonzero(inputs.valid[i])
        other[i, len(real) :] = inputs.points[i, rng.choice(real, net.config.points - len(real))]
    for mine, theirs in zip(called(net, clusters), called(net, clusters, points=other)):
        assert torch.allclose(mine, theirs, atol=1e-5)
    for mine, theirs in zip(run_network(net, inputs, chunk=2), called(net, clusters)):  # padding removed
        assert torch.allclose(mine, theirs, atol=1e-5)
    engine = TorchPointNet(net)
    again = predict(engine, clusters.take(np.array([2, 0])))
    assert np.allclose(again.boxes, predict(engine, clusters).boxes[[2, 0]], atol=1e-4)


def test_batch_norms_are_folded_into_the_layers_before_them(rng):
    clusters = blobs(rng, [40, 9, 3])
    before = called(network(), clusters)
    for mine, theirs in zip(before, called(fuse_norms(network()), clusters)):
        assert torch.allclose(mine, theirs, atol=1e-4)


def test_every_ablation_switch_has_an_effect():
    made = {name: make_pointnet_config(name) for name in ABLATIONS}
    known = {(c.clustering, c.groups, c.mrg, c.skip) for c in made.values()}
    assert len(known) == len(ABLATIONS)
    sizes = {name: sum(p.numel() for p in make_pointnet(config).parameters()) for name, config in made.items()}
    assert sizes["base"] == sizes["dynamic-threshold"] < sizes["skip"] < sizes["msg-skip"] < (sizes["improved"])
    assert make_pointnet_config("pointnet").groups == ()
    assert len(make_pointnet_config("pointnet2").groups) == 1
    assert made["base"].clustering.euclidean.threshold == "fixed"


def test_config_round_trip_and_invalid_values():
    config = make_pointnet_config("pointnet2", points=64)
    assert parse_config(config_module.PointNetConfig, asdict(config), "") == config
    with pytest.raises(InputError, match="no network 'resnet'"):
        make_pointnet_config("resnet")
    with pytest.raises(InputError, match="Bus"):
        make_pointnet_config(classes=("Bus",), sizes=((1, 1, 1),))
    with pytest.raises(InputError, match="length"):
        make_pointnet_config(classes=("Car",))
    with pytest.raises(InputError, match="later version"):
        parse_config(config_module.PointNetConfig, {"wings": 2}, "")
    for wrong in (
        dict(radii=(0.4, 0.2, 0.1)),
        dict(centroids=500),
        dict(neighbours=(1, 2)),
        dict(sampling="nearest"),
        dict(density=""),
    ):
        with pytest.raises(InputError):
            make_pointnet_config(**wrong)


# boxes and scores


def outputs_with(targets: BoxTargets, bins: int) -> Outputs:
    count = len(targets.yaw_bins)
    chosen = torch.zeros(count, bins)
    chosen[torch.arange(count), torch.from_numpy(targets.yaw_bins)] = 1
    rest = torch.from_numpy(targets.yaw_residuals)[:, None].expand(count, bins)
    return Outputs(
        torch.zeros(count, 4), torch.from_numpy(targets.centres), torch.from_numpy(targets.sizes), chosen, rest
    )


def test_decoding_undoes_encoding(rng):
    config, count = make_pointnet_config(), 200
    clusters = blobs(rng, [5] * count)
    inputs = make_network_input(clusters, 8)
    kinds = rng.integers(0, 3, count)
    sizes = np.array(config.sizes)[kinds] * np.exp(rng.uniform(-1.5, 1.5, (count, 3)))
    boxes = np.column_stack([inputs.centres + rng.normal(size=(count, 3)), sizes, rng.uniform(-np.pi, np.pi, count)])
    targets = encode(boxes, kinds, inputs.centres, inputs.azimuths, config)
    assert np.abs(targets.yaw_residuals).max() <= 1 + 1e-6
    outputs = Outputs(*(x.numpy() for x in outputs_with(targets, config.yaw_bins)))
    back = decode(outputs, inputs, config, kinds)
    assert np.allclose(back[:, :6], boxes[:, :6], atol=1e-4)
    assert np.allclose(wrap_angle(back[:, 6] - boxes[:, 6]), 0, atol=1e-5)


def test_loss_is_lowest_for_targets_and_ignores_background_boxes(rng):
    config = make_pointnet_config()
    inputs = make_network_input(blobs(rng, [5] * 6), 8)
    boxes = np.column_stack([inputs.centres, np.full((6, 3), 1.5), np.linspace(-3, 3, 6)])
    targets = encode(boxes, np.zeros(6, int), inputs.centres, inputs.azimuths, config)
    labels = torch.tensor([0, 0, 0, 0, 3, -1])
    has_box = labels == 0
    right = outputs_with(targets, config.yaw_bins)
    right.logits[torch.arange(6), labels.clamp(min=0)] = 30.0
    right = right._replace(yaw_bins=right.yaw_bins * 60)
    tensors = BoxTargets(*map(torch.from_numpy, targets))
    assert cluster_loss(right, labels, tensors, has_box).total < 1e-4
    for name in ("logits", "centres", "sizes", "yaw_bins", "yaw_residuals"):
        wrong = getattr(right, name).clone()
        wrong[0] = wrong[0].roll(1) if name in ("logits", "yaw_bins") else wrong[0] + 0.5
        assert cluster_loss(right._replace(**{name: wrong}), labels, tensors, has_box).total > 0.01
    moved = right.centres.clone()
    moved[4:] += 9
    assert cluster_loss(right._replace(centres=moved), labels, tensors, has_box).total < 1e-4
    nothing = cluster_loss(right, labels, tensors, has_box & False)
    assert nothing.boxes == 0 and torch.isfinite(nothing.total)


def test_calibration_makes_scores_match_accuracy(rng):
    net = network()
    truth = torch.from_numpy(rng.normal(size=(4000, 4)))
    labels = torch.distributions.Categorical(logits=truth).sample()
    logits = truth * 4 + torch.tensor([2.0, 0, 0, 0])  # overconfident and biased to one class
    before = calibration_error(torch.softmax(logits, 1).numpy(), labels.numpy())
    calibrate(net, logits, labels)
    after = calibration_error(
        compute_probabilities(*(x.numpy() for x in (logits, net.temperature, net.offsets))), labels.numpy()
    )
    assert after < 0.03 < 0.1 < before
    assert net.temperature.item() == pytest.approx(4, rel=0.1)
    unchanged = net.temperature.clone()
    calibrate(net, logits, torch.full_like(labels, -1))
    assert torch.equal(net.temperature, unchanged)
    assert calibration_error(np.eye(3), np.arange(3)) == 0.0
    assert calibration_error(np.eye(3), np.array([1, 2, 0])) == 1.0


def test_best_of_overlapping_boxes_is_kept(rng):
    config = make_pointnet_config()
    predictions = predict(TorchPointNet(network()), blobs(rng, [20] * 4))
    boxes = np.tile(np.array([5, 5, 0, 4, 2, 1.5, 0.3], np.float32), (4, 1))
    boxes[3, 0] += 20
    probabilities = np.array([[0.6, 0, 0, 0.4], [0.9, 0, 0, 0.1], [0.1, 0, 0, 0.9], [0.5, 0, 0, 0.5]], np.float32)
    made = predictions.__class__(probabilities, np.zeros(4, int), boxes)
    kept = select_detections(made, config, (0.3, 0.3, 0.3))
    assert kept.scores.tolist() == pytest.approx([0.9, 0.5])
    assert len(select_detections(made, config, (0.95, 0, 0))) == 0
