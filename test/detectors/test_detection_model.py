"""PointPillars: configs, pillars and the network."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from detection_samples import (
    BOXES,
    LABELS,
    make_anchor_tensors,
    make_random_network,
    make_tiny_config,
    make_two_objects,
)
from hypothesis import given
from hypothesis import strategies as st

from lidar_perception.detectors.checkpoint import require_same_config
from lidar_perception.detectors.config_json import parse_config
from lidar_perception.detectors.pointpillars.anchors import decode
from lidar_perception.detectors.pointpillars.config import SIZES, VERSIONS, NetworkConfig, make_config
from lidar_perception.detectors.pointpillars.losses import compute_detection_loss
from lidar_perception.detectors.pointpillars.network import fuse_norms, make_network
from lidar_perception.detectors.pointpillars.pillar_batch import keep_first_per_cell, make_pillar_batch
from lidar_perception.detectors.pointpillars.pillars import make_pillars
from lidar_perception.detectors.pointpillars.targets import assign_targets
from lidar_perception.detectors.pointpillars.torch_network import TorchNetwork
from lidar_perception.geometry import wrap_angle
from lidar_perception.types import InputError

seeds = st.integers(0, 2**32 - 1)
# covered by other tests
pytestmark = [pytest.mark.no_cover, pytest.mark.usefixtures("one_thread")]
each_version = pytest.mark.parametrize("version", VERSIONS)


def make_points(config, count=600, seed=0, margin=0.0) -> torch.Tensor:
    """Return points in the entire range, enlarged by `margin`, a few in each pillar."""
    rng = torch.Generator().manual_seed(seed)
    low, high = torch.tensor(config.low) - margin, torch.tensor(config.high) + margin
    points = torch.rand(count, config.point_columns, generator=rng)
    points[:, :3] = low + points[:, :3] * (high - low)
    pillar_points = points[: count - count // 2, :2]
    points[count // 2 :, :2] = pillar_points + 0.002 * ((low + high)[:2] / 2 - pillar_points)
    return points


def make_map(config, seed=0) -> torch.Tensor | None:
    rng = torch.Generator().manual_seed(seed)
    return torch.randint(0, 2, (1, 3, *config.grid), generator=rng, dtype=torch.uint8) if config.pseudo_map else None


# configs


@each_version
@pytest.mark.parametrize("size", SIZES)
def test_config_survives_json(version, size):
    config = make_config(version, size, classes=("Cyclist", "Car"))
    assert parse_config(NetworkConfig, dataclasses.asdict(config), "") == config
    assert config.classes == ("Cyclist", "Car") and config.grid == (496, 432)


def test_versions_match_the_paper():
    switches = {v: [s[k] for k in ("remove_ground", "cluster_ids", "pseudo_map", "neck")] for v, s in VERSIONS.items()}
    assert switches == {
        "v0": [False, False, False, "deconv"],
        "v1": [True, False, False, "fpn"],
        "v2": [True, True, False, "fpn"],
        "v3": [False, True, False, "fpn"],
        "v4": [True, False, True, "fpn"],
    }


def test_full_v0_has_as_many_weights_as_pointpillars():
    # 4.8 million: Lang et al. with three classes, six anchors and a direction
    count = sum(p.numel() for p in make_network(make_config("v0", "full")).parameters())
    expected = (
        9 * 64
        + 2 * 64  # points
        + sum(
            9 * a * b + n * 9 * b * b + 2 * b * (n + 1)  # blocks
            for a, b, n in ((64, 64, 3), (64, 128, 5), (128, 256, 5))
        )
        + sum(c * 128 * s * s + 2 * 128 for c, s in ((64, 1), (128, 2), (256, 4)))
        + 385 * 6 * (3 + 7 + 2)
    )  # head
    assert count == expected


@pytest.mark.parametrize(
    "change, words",
    [
        (dict(version="v9"), "unknown version 'v9'"),
        (dict(classes=("Dog",)), "Dog"),
        (dict(classes=()), "class"),
        (dict(cell=0.17), "cannot be divided"),
        (dict(zero_row=True), "max_points"),
    ],
)
def test_invalid_config_is_rejected(change, words):
    with pytest.raises(InputError, match=words):
        make_config(**{"version": "v1", **change})


def test_error_for_another_network_shows_both_values():
    with pytest.raises(InputError, match=r"f\.st .*version is v4, expected v2"):
        require_same_config(make_config("v4"), make_config("v2"), "f.st")


# pillars


def test_pillars_contain_their_points():
    config = make_tiny_config("v0")
    points = make_points(config, margin=1.0)
    points[3, 0], points[4, 2], points[5, 3] = torch.nan, torch.inf, torch.nan
    pillars = make_pillar_batch([points], config)
    low, high = torch.tensor(config.low), torch.tensor(config.high)
    in_range = ((points[:, :3] >= low) & (points[:, :3] < high)).all(1) & points.isfinite().all(1)
    assert torch.equal(pillars.points, points[in_range]) and 0 < in_range.sum() < len(points) - 3
    height, width = config.grid
    assert pillars.cells.min() >= 0 and pillars.cells.max() < height * width
    for cell in pillars.cells.unique():
        members = pillars.cells == cell
        xyz, offsets = pillars.points[members][:, :3], pillars.offsets[members]
        centre = low[:2] + (torch.stack([cell % width, cell // width]) + 0.5) * config.cell
        torch.testing.assert_close(offsets[:, :3], xyz - xyz.mean(0), atol=1e-5, rtol=0)
        torch.testing.assert_close(offsets[:, 3:], xyz[:, :2] - centre, atol=1e-5, rtol=0)
        assert offsets[:, 3:].abs().max() <= config.cell / 2 + 1e-5


@given(seeds, st.integers(1, 5))
def test_keep_first_per_cell_equals_a_loop(seed, max_count):
    cells = torch.from_numpy(np.random.default_rng(seed).integers(0, 9, 50))
    counts, indices = {}, []
    for i, cell in enumerate(cells.tolist()):
        counts[cell] = counts.get(cell, 0) + 1
        if counts[cell] <= max_count:
            indices.append(i)
    assert keep_first_per_cell(cells, max_count).tolist() == indices


def test_order_of_the_points_does_not_matter():
    config = make_tiny_config("v0")
    network, points = make_random_network(config), make_points(config)
    image = network.pillar_net(make_pillar_batch([points], config))
    shuffled = network.pillar_net(make_pillar_batch([points[torch.randperm(len(points))]], config))
    torch.testing.assert_close(shuffled, image, atol=1e-5, rtol=1e-5)
    assert image.max() > 0


def test_points_stay_float32_in_mixed_precision():
    config = make_tiny_config()
    network = make_random_network(config)
    pillars = make_pillar_batch([make_points(config)], config)
    expected = network.pillar_net(pillars)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(network.pillar_net(pillars), expected)
        assert network.compute_features(pillars).dtype == torch.bfloat16


def test_bf16_network_agrees_with_float32():
    config = make_tiny_config()
    pillars = make_pillars(make_points(config).numpy(), config)
    outputs = {}
    for amp in ("off", "bf16"):
        logits, compute_boxes, _ = TorchNetwork(make_random_network(config), amp=amp)(pillars, None)
        outputs[amp] = np.column_stack([logits, *compute_boxes(np.arange(len(logits)))])
    assert outputs["bf16"].dtype == np.float32 and not np.array_equal(outputs["bf16"], outputs["off"])
    assert np.abs(outputs["bf16"] - outputs["off"]).max() < 0.05 * np.abs(outputs["off"]).max()


def test_shift_by_one_pillar_shifts_image_by_one_cell():
    config = make_tiny_config("v0", low=(0.0, -4.0, -3.0), high=(8.0, 4.0, 1.0), cell=0.25)
    network = make_random_network(config)
    network.pillar_net.linear.weight[:, :2] = 0  # x and y themselves
    points = (make_points(config) * 64).round() / 64  # so that shifts are exact
    points = points[(points[:, 0] < 7.5) & (points[:, 1] < 3.5)]
    image = network.pillar_net(make_pillar_batch([points], config))
    for axis, (rows, columns) in ((0, (0, 1)), (1, (1, 0))):
        shifted_points = points.clone()
        shifted_points[:, axis] += 0.25
        shifted_image = network.pillar_net(make_pillar_batch([shifted_points], config))
        torch.testing.assert_close(shifted_image, image.roll((rows, columns), (2, 3)), atol=1e-5, rtol=0)


def test_scaled_x_and_y_equal_scaled_weights():
    config = make_tiny_config("v2", xy_scale=1.0)
    network, scaled_network = (
        make_random_network(config),
        make_random_network(dataclasses.replace(config, xy_scale=0.125)),
    )
    scaled_network.load_state_dict(network.state_dict())
    pillars = make_pillar_batch([make_points(config)], config)
    assert not torch.allclose(scaled_network.pillar_net(pillars), network.pillar_net(pillars), atol=0.1)
    scaled_network.pillar_net.linear.weight[:, :2] *= 8
    torch.testing.assert_close(scaled_network.pillar_net(pillars), network.pillar_net(pillars))


@pytest.mark.parametrize("middle_z", [False, True])
def test_removing_padding_pillars_keeps_the_result(middle_z):
    config = make_tiny_config("v0", max_points=2, zero_row=True, middle_z=middle_z, xy_scale=1.0)
    network, points = make_random_network(config), make_points(config, 900)
    net, low = network.pillar_net, torch.tensor(config.low)
    image = net(make_pillar_batch([points], config))[0]
    expected = torch.zeros_like(image)
    cells = ((points[:, :2] - low[:2]) / config.cell).floor().long()
    for column, row in set(map(tuple, cells.tolist())):
        members = points[(cells == torch.tensor([column, row])).all(1)][:2]
        rows = torch.zeros(2, 9 + middle_z)  # padded with zeros, which take part in the maximum
        centre = [*(low[:2] + (torch.tensor([column, row]) + 0.5) * config.cell), -1.0]
        rows[: len(members)] = torch.cat(
            [
                members,
                members[:, :3] - members[:, :3].mean(0),
                (members[:, :3] - torch.tensor(centre))[:, : 2 + middle_z],
            ],
            dim=1,
        )
        expected[:, row, column] = torch.relu(net.norm(net.linear(rows))).max(0).values
    torch.testing.assert_close(image, expected, atol=1e-5, rtol=1e-5)


# the network


@each_version
@pytest.mark.parametrize("changes", [{}, dict(fusion="concat"), dict(block_strides=(1, 2, 2))])
def test_every_version_has_outputs_for_all_anchors(version, changes):
    config = make_tiny_config(version, **changes)
    count = len(make_anchor_tensors(config)[0])
    assert count == config.head_grid[0] * config.head_grid[1] * 6
    pillars = make_pillar_batch([make_points(config), make_points(config, 9)], config)
    outputs = make_network(config)(pillars, torch.cat([make_map(config)] * 2) if config.pseudo_map else None)
    assert [tuple(t.shape) for t in outputs] == [(2, count, 3), (2, count, 7), (2, count, 2)]
    assert torch.sigmoid(outputs.logits).mean().item() == pytest.approx(0.01, rel=0.2)  # untrained


@each_version
def test_batch_of_two_equals_two_single_clouds(version):
    config = make_tiny_config(version)
    network = make_random_network(config)
    clouds = [make_points(config, 300, 1), make_points(config, 500, 2)]
    maps = [make_map(config, 1), make_map(config, 2)]
    batch_outputs = network(make_pillar_batch(clouds, config), torch.cat(maps) if config.pseudo_map else None)
    for i in range(2):
        single_outputs = network(make_pillar_batch(clouds[i : i + 1], config), maps[i])
        for single, batch in zip(single_outputs, batch_outputs):
            torch.testing.assert_close(single[0], batch[i], atol=2e-5, rtol=1e-4)
    assert not torch.allclose(batch_outputs.logits[0], batch_outputs.logits[1], atol=1e-3)


@each_version
def test_folded_norms_give_equal_outputs(version):
    config = make_tiny_config(version)
    network = make_random_network(config)
    pillars, cluster_map = make_pillar_batch([make_points(config)], config), make_map(config)
    folded = fuse_norms(network)
    for a, b in zip(network(pillars, cluster_map), folded(pillars, cluster_map)):
        torch.testing.assert_close(a, b, atol=2e-5, rtol=1e-4)
    assert not [m for m in folded.modules() if isinstance(m, torch.nn.BatchNorm2d)]


def test_boxes_of_selected_anchors_equal_those_of_all():
    config = make_tiny_config("v1")
    network = make_random_network(config)
    features = network.compute_features(make_pillar_batch([make_points(config)], config))
    outputs, indices = network.head(features), torch.tensor([0, 5, 17, 100, 1535])
    codes, directions = network.head.compute_boxes(features, indices)
    torch.testing.assert_close(codes, outputs.codes[0, indices], atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(directions, outputs.directions[0, indices], atol=1e-5, rtol=1e-4)
    assert torch.equal(network.head.compute_logits(features), outputs.logits)


def test_tiny_network_learns_two_objects():
    config = make_tiny_config("v0", block_channels=(16, 24, 24), deconv_channels=16, pillar_channels=16)
    torch.manual_seed(0)
    network = make_network(config)
    for module in network.modules():
        if isinstance(module, torch.nn.BatchNorm1d | torch.nn.BatchNorm2d):
            module.momentum = 0.1
    anchors, anchor_classes = make_anchor_tensors(config)
    targets = assign_targets(anchors, config, BOXES, LABELS)
    points = torch.from_numpy(make_two_objects())
    optimizer = torch.optim.AdamW(network.parameters())
    scheduler = torch.optim.lr_scheduler.OneCycleLR(optimizer, 0.02, total_steps=200)
    for _ in range(200):
        losses = compute_detection_loss(network(make_pillar_batch([points], config)), targets, anchor_classes)
        optimizer.zero_grad()
        losses.total.backward()
        optimizer.step()
        scheduler.step()
    with torch.no_grad():
        outputs = fuse_norms(network)(make_pillar_batch([points], config))
    scores = torch.sigmoid(outputs.logits[0])
    for box, label in zip(BOXES, LABELS):
        best_anchor = scores[:, label].argmax()
        decoded = torch.from_numpy(
            decode(
                *(
                    values[None].numpy()
                    for values in (
                        outputs.codes[0, best_anchor],
                        outputs.directions[0, best_anchor].argmax(),
                        anchors[best_anchor],
                    )
                ),
                config.direction_offset,
            )[0]
        )
        assert scores[best_anchor, label] > 0.9
        torch.testing.assert_close(decoded[:6], box[:6], atol=0.2, rtol=0)
        assert abs(wrap_angle((decoded[6] - box[6]).item())) < 0.2
    assert (scores.amax(1) > 0.5).sum() <= 2 * (targets.labels >= 0).sum()


@pytest.mark.parametrize("changes", [{}, dict(version="v2"), dict(max_points=3, middle_z=True)])
def test_pillars_of_single_and_batched_clouds_are_equal(changes):
    config = make_tiny_config(**changes)
    rng = np.random.default_rng(0)
    low, high = np.array(config.low), np.array(config.high)
    points = rng.uniform([*(low - 0.5), 0], [*(high + 0.5), 1], (5000, 4)).astype(np.float32)
    points[:4, 0] = np.nan, np.inf, config.high[0], config.low[0]
    points[4, 3] = np.nan
    points = np.column_stack([points, rng.integers(0, 9, 5000)]).astype(np.float32)
    cloud = torch.from_numpy(points[:, : config.point_columns].copy())
    single = make_pillars(cloud.numpy(), config)
    several = make_pillar_batch([cloud, cloud[:0]], config)
    assert 0 < len(single.points) < 5000
    for ours, theirs in zip(single[:3], several[:3]):
        assert np.array_equal(ours, theirs)
