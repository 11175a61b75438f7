"""Training targets and decoding: anchors, boxes, targets, losses, NMS."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from detection_samples import BOXES, LABELS, anchor_tensors, tiny
from hypothesis import given
from hypothesis import strategies as st

from lidar_perception.detectors.nms import rotated_nms
from lidar_perception.detectors.pointpillars.anchors import decode
from lidar_perception.detectors.pointpillars.config import ANCHORS
from lidar_perception.detectors.pointpillars.losses import detection_loss
from lidar_perception.detectors.pointpillars.network import Outputs
from lidar_perception.detectors.pointpillars.targets import (
    BACKGROUND,
    IGNORED,
    Targets,
    assign,
    encode,
    find_near_anchors,
    nearest_axis_iou,
    to_dense,
    to_sparse,
)
from lidar_perception.geometry import bev_iou

seeds = st.integers(0, 2**32 - 1)
pytestmark = pytest.mark.usefixtures("one_thread")


def some_boxes(seed, count=20, spread=6.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack(
        [rng.uniform(-spread, spread, (count, 3)), rng.uniform(0.4, 5, (count, 3)), rng.uniform(-7, 7, count)]
    )


# anchors and boxes


def test_anchor_order_is_y_x_class_yaw():
    config = tiny("v0")
    anchors, kinds = anchor_tensors(config)
    height, width = config.head_grid
    grid = anchors.view(height, width, 3, 2, 7)
    assert torch.equal(kinds.view(height, width, 3, 2)[2, 3].T, torch.arange(3).expand(2, 3))
    torch.testing.assert_close(grid[0, :, 0, 0, 0], (torch.arange(width) + 0.5) * 0.64)
    torch.testing.assert_close(grid[:, 0, 0, 0, 1], -5.12 + (torch.arange(height) + 0.5) * 0.64)
    for i, spec in enumerate(ANCHORS):
        assert grid[1, 1, i, :, 3:6].tolist() == [pytest.approx(spec.size)] * 2
        assert grid[1, 1, i, 0, 2] - spec.size[2] / 2 == pytest.approx(-1.73)  # on the ground
    ends = anchor_tensors(tiny("v0", anchors_at="ends"))[0].view(height, width, 3, 2, 7)
    assert (ends[0, 0, 0, 0, :2].tolist(), ends[-1, -1, 0, 0, :2].tolist()) == (
        [0.0, pytest.approx(-5.12)],
        [pytest.approx(10.24), pytest.approx(5.12)],
    )


@given(seeds, st.sampled_from([0.0, np.pi / 4, 0.78539, -np.pi / 2]))
def test_decoding_undoes_encoding(seed, offset):
    boxes = torch.from_numpy(some_boxes(seed))
    anchors = torch.from_numpy(some_boxes(seed ^ 1))
    codes, bins = encode(boxes, anchors, offset)
    turned = codes.clone()
    turned[:, 6] += np.pi  # only the direction bins contain the direction
    for given_codes in codes, turned:
        back = torch.from_numpy(decode(given_codes.numpy(), bins.numpy(), anchors.numpy(), offset))
        torch.testing.assert_close(back[:, :6], boxes[:, :6], atol=1e-9, rtol=1e-9)
        away = torch.remainder(back[:, 6] - boxes[:, 6] + np.pi, 2 * np.pi) - np.pi
        assert away.abs().max() < 1e-9 and back[:, 6].abs().max() <= np.pi
    assert torch.equal(encode(anchors, anchors, offset)[0], torch.zeros(20, 7, dtype=torch.float64))


# targets


def test_axis_aligned_iou_equals_textbook_formula():
    a = torch.tensor([[0, 0, 0, 4.0, 2, 1, 0.0]])
    b = torch.tensor([[1, 0, 0, 2.0, 4, 1, np.pi / 2 + 0.1], [9, 0, 0, 1, 1, 1, 0]])
    assert nearest_axis_iou(a, b)[0].tolist() == [pytest.approx(6 / 10), 0.0]


def test_targets_equal_a_plain_implementation():
    config = tiny("v0")
    anchors, classes = anchor_tensors(config)
    rng = np.random.default_rng(3)
    sizes = torch.tensor([a.size for a in config.anchors])
    labels = torch.from_numpy(rng.integers(0, 3, 8))
    boxes = torch.from_numpy(
        np.column_stack(
            [rng.uniform(1, 9, 8), rng.uniform(-4, 4, 8), np.full(8, -1.0), np.zeros((8, 3)), rng.uniform(-4, 4, 8)]
        )
    ).float()
    boxes[:, 3:6] = sizes[labels] * 1.05
    found = assign(anchors, config, boxes, labels)
    overlap = nearest_axis_iou(anchors, boxes).numpy()
    for i in range(len(anchors)):
        spec = config.anchors[classes[i]]
        mine = [j for j in range(8) if labels[j] == classes[i]]
        forced = [
            j for j in mine if overlap[i, j] > 0 and overlap[i, j] == overlap[(classes == labels[j]).numpy(), j].max()
        ]
        best = max(mine, key=lambda j: overlap[i, j], default=None)
        if forced or (best is not None and overlap[i, best] >= spec.matched):
            target = forced[0] if forced else best
            assert found.labels[0, i] == classes[i]
            codes, bins = encode(boxes[target][None], anchors[i][None], config.direction_offset)
            torch.testing.assert_close(found.codes[0, i], codes[0])
            assert found.bins[0, i] == bins[0]
        elif best is not None and overlap[i, best] >= spec.unmatched:
            assert found.labels[0, i] == IGNORED
        else:
            assert found.labels[0, i] == BACKGROUND and not found.codes[0, i].any()
    assert {*found.labels.unique().tolist()} == {IGNORED, BACKGROUND, *labels.tolist()}


@given(seeds)
def test_distant_anchors_overlap_nothing(seed):
    config = tiny()
    anchors, kinds = anchor_tensors(config)
    boxes = torch.from_numpy(some_boxes(seed, 6, 12.0)).float()
    for index in range(len(config.anchors)):
        near = find_near_anchors(anchors, config, boxes, index)
        mine = torch.nonzero(kinds == index)[:, 0]
        assert torch.isin(near, mine).all() and (near.diff() > 0).all()
        others = mine[~torch.isin(mine, near)]
        assert not nearest_axis_iou(anchors[others], boxes).any()
    assert len(find_near_anchors(anchors, config, boxes[:0], 0)) == 0


def test_every_object_has_an_anchor_in_any_order():
    config = tiny("v0")
    anchors = anchor_tensors(config)[0]
    there = assign(anchors, config, BOXES, LABELS)
    back = assign(anchors, config, BOXES.flip(0), LABELS.flip(0))
    for a, b in zip(there, back):
        assert torch.equal(a, b)
    positive = there.labels[0] >= 0
    decoded = torch.from_numpy(
        decode(
            *(values.numpy() for values in (there.codes[0, positive], there.bins[0, positive], anchors[positive])),
            config.direction_offset,
        )
    )
    for box, label in zip(BOXES, LABELS):
        near = (decoded - box).abs().amax(1) < 1e-4
        assert near.any() and (there.labels[0, positive][near] == label).all()


def test_no_valid_objects_give_background_only():
    config = tiny("v0")
    broken = BOXES.clone()
    broken[0, 3], broken[1, 0] = 0, torch.nan
    for boxes, labels in (broken, LABELS), (BOXES[:0], LABELS[:0]):
        assert (assign(anchor_tensors(config)[0], config, boxes, labels).labels == BACKGROUND).all()


# losses


def outputs_of(targets, classes=3, sure=12.0):
    """Return network outputs that equal the targets."""
    logits = torch.full((*targets.labels.shape, classes), -sure)
    directions = torch.nn.functional.one_hot(targets.bins, 2).float() * 2 * sure
    positive = targets.labels >= 0
    logits[positive] += torch.nn.functional.one_hot(targets.labels[positive], classes) * 2 * sure
    return Outputs(logits, targets.codes.clone(), directions)


def test_loss_is_zero_for_targets_and_positive_for_errors():
    config = tiny("v0")
    kinds = anchor_tensors(config)[1]
    targets = assign(anchor_tensors(config)[0], config, BOXES, LABELS)
    right = outputs_of(targets)
    assert detection_loss(right, targets, kinds).total < 1e-4
    turned = right._replace(codes=right.codes + torch.tensor([0, 0, 0, 0, 0, 0, np.pi]))
    assert detection_loss(turned, targets, kinds).boxes < 1e-6  # the direction has its own loss
    wrong = right._replace(directions=-right.directions)
    assert detection_loss(wrong, targets, kinds).directions > 1
    assert detection_loss(right._replace(codes=right.codes + 0.3), targets, kinds).boxes > 0.1
    assert detection_loss(right._replace(logits=-right.logits), targets, kinds).classes > 1


def random_outputs(anchors, clouds=1):
    torch.manual_seed(0)
    return Outputs(*(torch.randn(clouds, len(anchors), n) for n in (3, 7, 2)))


def batch(clouds: list[Targets]) -> Targets:
    return to_dense([to_sparse(cloud) for cloud in clouds], clouds[0].labels.shape[1], torch.device("cpu"))


def test_sparse_targets_round_trip():
    config = tiny("v0")
    anchors = anchor_tensors(config)[0]
    clouds = [assign(anchors, config, BOXES[:n], LABELS[:n]) for n in (2, 0, 1)]
    assert {BACKGROUND, IGNORED, *range(2)} <= set(clouds[0].labels.flatten().tolist())
    for whole, *parts in zip(batch(clouds), *clouds):
        assert torch.equal(whole, torch.cat(parts))


def test_loss_of_doubled_batch_is_equal():
    config = tiny("v0")
    anchors, kinds = anchor_tensors(config)
    targets, out = assign(anchors, config, BOXES, LABELS), random_outputs(anchors)
    once = detection_loss(out, targets, kinds)
    twice = detection_loss(Outputs(*(torch.cat([t, t]) for t in out)), batch([targets, targets]), kinds)
    for a, b in zip(once, twice):
        torch.testing.assert_close(a, b)
    changed = out.logits.clone()
    changed[targets.labels == IGNORED] += 5
    assert (targets.labels == IGNORED).any()
    torch.testing.assert_close(detection_loss(out._replace(logits=changed), targets, kinds).total, once.total)


def test_classes_have_equal_weight_for_any_number_of_anchors():
    config = tiny("v0")
    anchors, kinds = anchor_tensors(config)
    targets, out = assign(anchors, config, BOXES, LABELS), random_outputs(anchors, 2)
    targets = batch([targets, assign(anchors, config, BOXES[:1], LABELS[:1])])
    parts = []
    for kind in range(3):
        mine = kinds == kind
        part = detection_loss(Outputs(*(t[:, mine] for t in out)), Targets(*(t[:, mine] for t in targets)), kinds[mine])
        parts.append(part.classes)
    numbers = [int(((targets.labels >= 0) & (kinds == kind)).sum()) for kind in range(3)]
    assert max(numbers) > 2 * min(numbers)
    torch.testing.assert_close(detection_loss(out, targets, kinds).classes, sum(parts))


# non-maximum suppression


def reference_iou(a, b):
    (one, first), (two, second) = (
        (((box[0], box[1]), (box[3], box[4]), np.degrees(box[6])), box[3] * box[4]) for box in (a, b)
    )
    kind, region = cv2.rotatedRectangleIntersection(one, two)
    shared = cv2.contourArea(cv2.convexHull(region)) if kind else 0.0
    return shared / (first + second - shared)


@given(seeds, st.booleans())
def test_suppression_equals_a_slow_loop(seed, across):
    rng = np.random.default_rng(seed)
    boxes = some_boxes(seed, 30, spread=4)
    scores, labels, limit = rng.permutation(30) / 30, rng.integers(0, 3, 30), 0.2
    kept, sure = [], True
    for i in np.argsort(-scores):
        overlaps = [reference_iou(boxes[i], boxes[j]) for j in kept if across or labels[i] == labels[j]]
        sure &= all(abs(o - limit) > 1e-3 for o in overlaps)  # the reference is in float32
        if all(o <= limit for o in overlaps):
            kept.append(i)
    if sure:
        assert rotated_nms(boxes, scores, labels, limit, across).tolist() == kept
    assert rotated_nms(boxes[:0], scores[:0], labels[:0], limit).tolist() == []


def test_nms_equals_brute_force_over_all_pairs():
    """Boxes without area or position overlap nothing and are kept."""
    rng = np.random.default_rng(0)
    boxes = some_boxes(0, 200, spread=20)
    boxes[:5, 3], boxes[5:8, 4], boxes[8:11, 0], boxes[11, 1] = 30.0, 0.0, np.nan, np.inf
    scores = rng.permutation(200) / 200
    above = bev_iou(boxes, boxes) > 0.05
    kept: list[int] = []
    for i in np.argsort(-scores):
        if not above[i, kept].any():
            kept.append(int(i))
    assert 20 < len(kept) < 190 and {*range(5, 12)} < {*kept}
    assert rotated_nms(boxes, scores, np.zeros(200, int), 0.05).tolist() == kept
