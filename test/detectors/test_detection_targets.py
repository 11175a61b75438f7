"""Training targets and decoding: anchors, boxes, targets, losses, NMS."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from detection_samples import BOXES, LABELS, make_anchor_tensors, make_tiny_config
from hypothesis import given
from hypothesis import strategies as st

from lidar_perception.detectors.nms import rotated_nms
from lidar_perception.detectors.pointpillars.anchors import decode
from lidar_perception.detectors.pointpillars.config import ANCHORS
from lidar_perception.detectors.pointpillars.losses import compute_detection_loss
from lidar_perception.detectors.pointpillars.network import Outputs
from lidar_perception.detectors.pointpillars.targets import (
    BACKGROUND,
    IGNORED,
    Targets,
    assign_targets,
    encode,
    find_near_anchors,
    nearest_axis_iou,
    to_dense,
    to_sparse,
)
from lidar_perception.geometry import bev_iou

seeds = st.integers(0, 2**32 - 1)
pytestmark = pytest.mark.usefixtures("one_thread")


def make_boxes(seed, count=20, spread=6.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack(
        [rng.uniform(-spread, spread, (count, 3)), rng.uniform(0.4, 5, (count, 3)), rng.uniform(-7, 7, count)]
    )


# anchors and boxes


def test_anchor_order_is_y_x_class_yaw():
    config = make_tiny_config("v0")
    anchors, anchor_classes = make_anchor_tensors(config)
    height, width = config.head_grid
    grid = anchors.view(height, width, 3, 2, 7)
    assert torch.equal(anchor_classes.view(height, width, 3, 2)[2, 3].T, torch.arange(3).expand(2, 3))
    torch.testing.assert_close(grid[0, :, 0, 0, 0], (torch.arange(width) + 0.5) * 0.64)
    torch.testing.assert_close(grid[:, 0, 0, 0, 1], -5.12 + (torch.arange(height) + 0.5) * 0.64)
    for i, spec in enumerate(ANCHORS):
        assert grid[1, 1, i, :, 3:6].tolist() == [pytest.approx(spec.size)] * 2
        assert grid[1, 1, i, 0, 2] - spec.size[2] / 2 == pytest.approx(-1.73)  # on the ground
    ends = make_anchor_tensors(make_tiny_config("v0", anchors_at="ends"))[0].view(height, width, 3, 2, 7)
    assert (ends[0, 0, 0, 0, :2].tolist(), ends[-1, -1, 0, 0, :2].tolist()) == (
        [0.0, pytest.approx(-5.12)],
        [pytest.approx(10.24), pytest.approx(5.12)],
    )


@given(seeds, st.sampled_from([0.0, np.pi / 4, 0.78539, -np.pi / 2]))
def test_decoding_undoes_encoding(seed, offset):
    boxes = torch.from_numpy(make_boxes(seed))
    anchors = torch.from_numpy(make_boxes(seed ^ 1))
    codes, bins = encode(boxes, anchors, offset)
    flipped_codes = codes.clone()
    flipped_codes[:, 6] += np.pi  # only the direction bins contain the direction
    for given_codes in codes, flipped_codes:
        decoded = torch.from_numpy(decode(given_codes.numpy(), bins.numpy(), anchors.numpy(), offset))
        torch.testing.assert_close(decoded[:, :6], boxes[:, :6], atol=1e-9, rtol=1e-9)
        yaw_error = torch.remainder(decoded[:, 6] - boxes[:, 6] + np.pi, 2 * np.pi) - np.pi
        assert yaw_error.abs().max() < 1e-9 and decoded[:, 6].abs().max() <= np.pi
    assert torch.equal(encode(anchors, anchors, offset)[0], torch.zeros(20, 7, dtype=torch.float64))


# targets


def test_axis_aligned_iou_equals_textbook_formula():
    a = torch.tensor([[0, 0, 0, 4.0, 2, 1, 0.0]])
    b = torch.tensor([[1, 0, 0, 2.0, 4, 1, np.pi / 2 + 0.1], [9, 0, 0, 1, 1, 1, 0]])
    assert nearest_axis_iou(a, b)[0].tolist() == [pytest.approx(6 / 10), 0.0]


def test_targets_equal_a_plain_implementation():
    config = make_tiny_config("v0")
    anchors, classes = make_anchor_tensors(config)
    rng = np.random.default_rng(3)
    sizes = torch.tensor([a.size for a in config.anchors])
    labels = torch.from_numpy(rng.integers(0, 3, 8))
    boxes = torch.from_numpy(
        np.column_stack(
            [rng.uniform(1, 9, 8), rng.uniform(-4, 4, 8), np.full(8, -1.0), np.zeros((8, 3)), rng.uniform(-4, 4, 8)]
        )
    ).float()
    boxes[:, 3:6] = sizes[labels] * 1.05
    targets = assign_targets(anchors, config, boxes, labels)
    iou = nearest_axis_iou(anchors, boxes).numpy()
    for i in range(len(anchors)):
        spec = config.anchors[classes[i]]
        candidates = [j for j in range(8) if labels[j] == classes[i]]
        best_matches = [
            j for j in candidates if iou[i, j] > 0 and iou[i, j] == iou[(classes == labels[j]).numpy(), j].max()
        ]
        best_object = max(candidates, key=lambda j: iou[i, j], default=None)
        if best_matches or (best_object is not None and iou[i, best_object] >= spec.matched):
            object_index = best_matches[0] if best_matches else best_object
            assert targets.labels[0, i] == classes[i]
            codes, bins = encode(boxes[object_index][None], anchors[i][None], config.direction_offset)
            torch.testing.assert_close(targets.codes[0, i], codes[0])
            assert targets.bins[0, i] == bins[0]
        elif best_object is not None and iou[i, best_object] >= spec.unmatched:
            assert targets.labels[0, i] == IGNORED
        else:
            assert targets.labels[0, i] == BACKGROUND and not targets.codes[0, i].any()
    assert {*targets.labels.unique().tolist()} == {IGNORED, BACKGROUND, *labels.tolist()}


@given(seeds)
def test_distant_anchors_have_no_overlap(seed):
    config = make_tiny_config()
    anchors, anchor_classes = make_anchor_tensors(config)
    boxes = torch.from_numpy(make_boxes(seed, 6, 12.0)).float()
    for index in range(len(config.anchors)):
        near_anchors = find_near_anchors(anchors, config, boxes, index)
        class_anchors = torch.nonzero(anchor_classes == index)[:, 0]
        assert torch.isin(near_anchors, class_anchors).all() and (near_anchors.diff() > 0).all()
        distant_anchors = class_anchors[~torch.isin(class_anchors, near_anchors)]
        assert not nearest_axis_iou(anchors[distant_anchors], boxes).any()
    assert len(find_near_anchors(anchors, config, boxes[:0], 0)) == 0


def test_every_object_has_an_anchor_in_any_order():
    config = make_tiny_config("v0")
    anchors = make_anchor_tensors(config)[0]
    targets = assign_targets(anchors, config, BOXES, LABELS)
    reversed_targets = assign_targets(anchors, config, BOXES.flip(0), LABELS.flip(0))
    for a, b in zip(targets, reversed_targets):
        assert torch.equal(a, b)
    is_positive = targets.labels[0] >= 0
    decoded = torch.from_numpy(
        decode(
            *(
                values.numpy()
                for values in (targets.codes[0, is_positive], targets.bins[0, is_positive], anchors[is_positive])
            ),
            config.direction_offset,
        )
    )
    for box, label in zip(BOXES, LABELS):
        is_match = (decoded - box).abs().amax(1) < 1e-4
        assert is_match.any() and (targets.labels[0, is_positive][is_match] == label).all()


def test_targets_without_valid_objects_are_background():
    config = make_tiny_config("v0")
    invalid_boxes = BOXES.clone()
    invalid_boxes[0, 3], invalid_boxes[1, 0] = 0, torch.nan
    for boxes, labels in (invalid_boxes, LABELS), (BOXES[:0], LABELS[:0]):
        assert (assign_targets(make_anchor_tensors(config)[0], config, boxes, labels).labels == BACKGROUND).all()


# losses


def make_outputs(targets, classes=3, margin=12.0):
    """Return network outputs that equal the targets."""
    logits = torch.full((*targets.labels.shape, classes), -margin)
    directions = torch.nn.functional.one_hot(targets.bins, 2).float() * 2 * margin
    is_positive = targets.labels >= 0
    logits[is_positive] += torch.nn.functional.one_hot(targets.labels[is_positive], classes) * 2 * margin
    return Outputs(logits, targets.codes.clone(), directions)


def test_loss_is_zero_for_targets_and_positive_for_errors():
    config = make_tiny_config("v0")
    anchor_classes = make_anchor_tensors(config)[1]
    targets = assign_targets(make_anchor_tensors(config)[0], config, BOXES, LABELS)
    exact_outputs = make_outputs(targets)
    assert compute_detection_loss(exact_outputs, targets, anchor_classes).total < 1e-4
    flipped_outputs = exact_outputs._replace(codes=exact_outputs.codes + torch.tensor([0, 0, 0, 0, 0, 0, np.pi]))
    assert (
        compute_detection_loss(flipped_outputs, targets, anchor_classes).boxes < 1e-6
    )  # the direction has its own loss
    wrong_directions = exact_outputs._replace(directions=-exact_outputs.directions)
    assert compute_detection_loss(wrong_directions, targets, anchor_classes).directions > 1
    assert (
        compute_detection_loss(exact_outputs._replace(codes=exact_outputs.codes + 0.3), targets, anchor_classes).boxes
        > 0.1
    )
    assert (
        compute_detection_loss(exact_outputs._replace(logits=-exact_outputs.logits), targets, anchor_classes).classes
        > 1
    )


def make_random_outputs(anchors, clouds=1):
    torch.manual_seed(0)
    return Outputs(*(torch.randn(clouds, len(anchors), n) for n in (3, 7, 2)))


def make_batch(clouds: list[Targets]) -> Targets:
    return to_dense([to_sparse(cloud) for cloud in clouds], clouds[0].labels.shape[1], torch.device("cpu"))


def test_sparse_targets_survive_conversion_to_dense():
    config = make_tiny_config("v0")
    anchors = make_anchor_tensors(config)[0]
    clouds = [assign_targets(anchors, config, BOXES[:n], LABELS[:n]) for n in (2, 0, 1)]
    assert {BACKGROUND, IGNORED, *range(2)} <= set(clouds[0].labels.flatten().tolist())
    for dense, *single_clouds in zip(make_batch(clouds), *clouds):
        assert torch.equal(dense, torch.cat(single_clouds))


def test_doubling_the_batch_keeps_the_loss():
    config = make_tiny_config("v0")
    anchors, anchor_classes = make_anchor_tensors(config)
    targets, outputs = assign_targets(anchors, config, BOXES, LABELS), make_random_outputs(anchors)
    single_loss = compute_detection_loss(outputs, targets, anchor_classes)
    double_loss = compute_detection_loss(
        Outputs(*(torch.cat([t, t]) for t in outputs)), make_batch([targets, targets]), anchor_classes
    )
    for a, b in zip(single_loss, double_loss):
        torch.testing.assert_close(a, b)
    changed_logits = outputs.logits.clone()
    changed_logits[targets.labels == IGNORED] += 5
    assert (targets.labels == IGNORED).any()
    torch.testing.assert_close(
        compute_detection_loss(outputs._replace(logits=changed_logits), targets, anchor_classes).total,
        single_loss.total,
    )


def test_classes_have_equal_weight_for_any_number_of_anchors():
    config = make_tiny_config("v0")
    anchors, anchor_classes = make_anchor_tensors(config)
    targets, outputs = assign_targets(anchors, config, BOXES, LABELS), make_random_outputs(anchors, 2)
    targets = make_batch([targets, assign_targets(anchors, config, BOXES[:1], LABELS[:1])])
    class_losses = []
    for label in range(3):
        in_class = anchor_classes == label
        losses = compute_detection_loss(
            Outputs(*(t[:, in_class] for t in outputs)),
            Targets(*(t[:, in_class] for t in targets)),
            anchor_classes[in_class],
        )
        class_losses.append(losses.classes)
    positive_counts = [int(((targets.labels >= 0) & (anchor_classes == label)).sum()) for label in range(3)]
    assert max(positive_counts) > 2 * min(positive_counts)
    torch.testing.assert_close(compute_detection_loss(outputs, targets, anchor_classes).classes, sum(class_losses))


# non-maximum suppression


def compute_reference_iou(a, b):
    (rectangle_a, area_a), (rectangle_b, area_b) = (
        (((box[0], box[1]), (box[3], box[4]), np.degrees(box[6])), box[3] * box[4]) for box in (a, b)
    )
    status, region = cv2.rotatedRectangleIntersection(rectangle_a, rectangle_b)
    intersection = cv2.contourArea(cv2.convexHull(region)) if status else 0.0
    return intersection / (area_a + area_b - intersection)


@given(seeds, st.booleans())
def test_nms_equals_a_plain_loop(seed, across):
    rng = np.random.default_rng(seed)
    boxes = make_boxes(seed, 30, spread=4)
    scores, labels, limit = rng.permutation(30) / 30, rng.integers(0, 3, 30), 0.2
    remaining, is_unambiguous = [], True
    for i in np.argsort(-scores):
        overlaps = [compute_reference_iou(boxes[i], boxes[j]) for j in remaining if across or labels[i] == labels[j]]
        is_unambiguous &= all(abs(o - limit) > 1e-3 for o in overlaps)  # the reference is in float32
        if all(o <= limit for o in overlaps):
            remaining.append(i)
    if is_unambiguous:
        assert rotated_nms(boxes, scores, labels, limit, across).tolist() == remaining
    assert rotated_nms(boxes[:0], scores[:0], labels[:0], limit).tolist() == []


def test_nms_equals_brute_force_over_all_pairs():
    """Boxes without area or position overlap nothing and are kept."""
    rng = np.random.default_rng(0)
    boxes = make_boxes(0, 200, spread=20)
    boxes[:5, 3], boxes[5:8, 4], boxes[8:11, 0], boxes[11, 1] = 30.0, 0.0, np.nan, np.inf
    scores = rng.permutation(200) / 200
    is_duplicate = bev_iou(boxes, boxes) > 0.05
    remaining: list[int] = []
    for i in np.argsort(-scores):
        if not is_duplicate[i, remaining].any():
            remaining.append(int(i))
    assert 20 < len(remaining) < 190 and {*range(5, 12)} < {*remaining}
    assert rotated_nms(boxes, scores, np.zeros(200, int), 0.05).tolist() == remaining
