"""Corrections of boxes, and combination of evidence, in the fused detector."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidar_perception.classes import CAR
from lidar_perception.detectors.boxes import (
    FRONT_DEPTH,
    MARGIN_M,
    SIDE_DEPTH,
    move_cars_to_points,
    move_to_ground,
    move_to_points,
    move_towards,
)
from lidar_perception.detectors.fused.detector import remove_duplicates
from lidar_perception.detectors.fused.evidence import (
    MIN_PROBABILITY,
    compute_max_probabilities,
    compute_probabilities,
    to_log_odds,
)
from lidar_perception.detectors.fused.fusion import KNOTS, load_shipped_models
from lidar_perception.detectors.fused.params import FusedParams
from lidar_perception.geometry import bev_iou, points_in_box, points_in_boxes, wrap_angle
from lidar_perception.types import CLASSES, PEDESTRIAN, Detections

# covered by other tests
pytestmark = [pytest.mark.no_cover, pytest.mark.usefixtures("one_thread")]
SEEDS = st.integers(0, 2**32 - 1)


def make_random_boxes(rng, count: int) -> np.ndarray:
    return np.column_stack(
        [
            rng.uniform(-20, 20, (count, 2)),
            rng.uniform(-1.5, 0, count),
            rng.uniform(0.3, 5, (count, 3)),
            rng.uniform(-4, 4, count),
        ]
    )


@given(SEEDS, st.integers(0, 2000), st.integers(0, 30), st.floats(0, 0.5))
def test_points_in_boxes_equals_points_in_each_box(seed, count, boxes, margin):
    rng = np.random.default_rng(seed)
    xyz = rng.uniform([-22, -22, -2], [22, 22, 2], (count, 3)).astype(np.float32)
    xyz[::50, rng.integers(3)] = rng.choice([np.nan, np.inf, -np.inf, 1e30])
    boxes = make_random_boxes(rng, boxes).astype(np.float32)
    indices, first = points_in_boxes(xyz, boxes, margin)
    assert first[0] == 0 and first[-1] == len(indices) and len(first) == len(boxes) + 1
    for k, box in enumerate(boxes):
        np.testing.assert_array_equal(indices[first[k] : first[k + 1]], np.flatnonzero(points_in_box(xyz, box, margin)))


def make_face_points(box: np.ndarray, rng, count: int = 400) -> np.ndarray:
    """Return points on the two faces of a box that a sensor at the origin sees."""
    sensor_xy = np.array([[np.cos(box[6]), np.sin(box[6])], [-np.sin(box[6]), np.cos(box[6])]]) @ (-box[:2])
    points = rng.uniform(-0.5, 0.5, (count, 3)) * box[3:6]
    is_front_face = np.arange(count) < count // 2
    for axis, depth in ((0, FRONT_DEPTH), (1, SIDE_DEPTH)):
        on_face = is_front_face == (axis == 0)
        points[on_face, axis] = np.sign(sensor_xy[axis]) * (box[3 + axis] / 2 - depth)
    cos, sin = np.cos(box[6]), np.sin(box[6])
    return (
        np.column_stack(
            [cos * points[:, 0] - sin * points[:, 1], sin * points[:, 0] + cos * points[:, 1], points[:, 2]]
        )
        + box[:3]
    )


@given(SEEDS)
def test_move_to_points_corrects_only_a_shifted_car(seed):
    rng = np.random.default_rng(seed)
    distance = rng.uniform(8, 30)
    azimuth = rng.uniform(-np.pi, np.pi)
    box = np.array(
        [
            distance * np.cos(azimuth),
            distance * np.sin(azimuth),
            -0.9,
            4.0,
            1.7,
            1.5,
            azimuth + rng.choice([-1, 1]) * rng.uniform(0.6, 0.9),
        ]
    )  # two faces are visible
    points = make_face_points(box, rng)
    shifted = box.copy()
    shifted[:2] += rng.uniform(-0.2, 0.2, 2)
    corrected = move_to_points(np.stack([box, shifted]), points, 1.0)
    np.testing.assert_allclose(corrected, [box, box], atol=0.02)
    half_corrected = move_to_points(shifted[None], points, 0.5)[0]
    np.testing.assert_allclose(half_corrected, (shifted + box) / 2, atol=0.02)
    np.testing.assert_array_equal(move_to_points(shifted[None], points, 0.0)[0], shifted)
    np.testing.assert_array_equal(move_to_points(shifted[None], points[:0], 1.0)[0], shifted)
    cars = move_cars_to_points(np.stack([shifted, shifted]), np.array([CAR, PEDESTRIAN]), points, 1.0)
    np.testing.assert_array_equal(cars, [move_to_points(shifted[None], points, 1.0)[0], shifted])
    # Never farther than the margin, however far the points are.
    corrected_box = move_to_points(shifted[None], points + [0.3, 0, 0], 1.0)
    assert np.hypot(*(corrected_box - shifted)[0, :2]) <= 2 * MARGIN_M


def test_move_to_ground_skips_unknown_heights():
    boxes = make_random_boxes(np.random.default_rng(0), 20)
    floors = np.where(np.arange(20) % 4, boxes[:, 2] - 1, np.nan)
    ground_boxes = move_to_ground(boxes, floors, 1.0)
    is_known = np.isfinite(floors)
    np.testing.assert_allclose((ground_boxes[:, 2] - ground_boxes[:, 5] / 2)[is_known], floors[is_known])
    np.testing.assert_array_equal(ground_boxes[~is_known], boxes[~is_known])
    np.testing.assert_array_equal(move_to_ground(boxes, floors, 0.0), boxes)


@given(SEEDS)
def test_move_towards_interpolates_and_keeps_heading(seed):
    rng = np.random.default_rng(seed)
    boxes, others = make_random_boxes(rng, 20), make_random_boxes(rng, 20)
    is_missing = rng.random(20) < 0.3
    others[is_missing] = np.nan
    full, half, none = (move_towards(boxes, others, weight) for weight in (1.0, 0.5, 0.0))
    np.testing.assert_allclose(none[:, :6], boxes[:, :6])
    np.testing.assert_allclose(wrap_angle(none[:, 6] - boxes[:, 6]), 0, atol=1e-9)
    np.testing.assert_array_equal(half[is_missing], none[is_missing])
    np.testing.assert_allclose(full[~is_missing, :6], others[~is_missing, :6])
    np.testing.assert_allclose(half[:, :6], (none + full)[:, :6] / 2)
    # Headings are interpolated modulo 180 degrees, so they change by at most 90 degrees.
    np.testing.assert_allclose(np.sin(full - others)[~is_missing, 6], 0, atol=1e-9)
    yaw_change, half_yaw_change = (wrap_angle(moved[:, 6] - none[:, 6]) for moved in (full, half))
    assert (np.abs(yaw_change) <= np.pi / 2 + 1e-9).all() and (np.abs(half[:, 6]) <= np.pi).all()
    np.testing.assert_allclose(half_yaw_change, yaw_change / 2, atol=1e-9)


@given(SEEDS)
def test_probability_increases_with_evidence(seed):
    rng = np.random.default_rng(seed)
    class_ids = rng.choice([CLASSES.index(name) for name in load_shipped_models()], 50)
    evidence = {source: to_log_odds(rng.uniform(0, 1, 50)) for source in KNOTS}
    models = load_shipped_models()
    probabilities = compute_probabilities(models, class_ids, evidence)
    assert ((probabilities >= 0) & (probabilities <= 1)).all() and probabilities.dtype == np.float32
    for source in KNOTS:
        stronger_evidence = {**evidence, source: evidence[source] + rng.uniform(0, 3, 50)}
        assert (compute_probabilities(models, class_ids, stronger_evidence) >= probabilities - 1e-6).all()
        missing_evidence = {**evidence, source: np.full(50, np.nan)}
        assert np.isfinite(compute_probabilities(load_shipped_models(), class_ids, missing_evidence)).all()
    unknown_class_ids = np.full(50, CLASSES.index("Tram"))
    assert not compute_probabilities(load_shipped_models(), unknown_class_ids, evidence).any()
    min_log_odds = to_log_odds(MIN_PROBABILITY)
    np.testing.assert_allclose(to_log_odds([0, 0.5, 1]), [min_log_odds, 0, -min_log_odds], atol=1e-9)


@given(st.integers(0, 2**32 - 1))
def test_max_probability_holds_for_any_evidence_and_curve(seed):
    """PointNet skips proposals whose upper bound is below the threshold."""
    rng = np.random.default_rng(seed)
    models = {
        name: {
            "bias": rng.normal(),
            "curves": {
                source: {
                    "knots": [-3.0, -1.0, 1.0, 3.0],
                    "values": rng.normal(0, 2, 4).tolist(),
                    **({"unknown": rng.normal(0, 2)} if rng.random() < 0.5 else {}),
                }
                for source in ("network", "classifier")[: rng.integers(1, 3)]
            },
        }
        for name in CLASSES[:2]
    }
    ids, network = rng.integers(0, 3, 6), rng.normal(0, 3, 6)
    bound = compute_max_probabilities(models, ids, {"network": network}, "classifier")
    probabilities = [
        compute_probabilities(models, ids, {"network": network, "classifier": np.full(6, odds)})
        for odds in (np.nan, -np.inf, np.inf, *np.linspace(-4, 4, 33))
    ]
    np.testing.assert_array_equal(bound, np.max(probabilities, axis=0))


def test_duplicates_are_removed_within_each_class():
    boxes = np.array(
        [
            [10, 0, 0, 0.6, 0.6, 1.8, 0],
            [10.5, 0.2, 0, 0.6, 0.6, 1.8, 0],
            [10, 5, 0, 4, 1.7, 1.5, 0],
            [10, 6.8, 0, 4, 1.7, 1.5, 0],
            [10.3, 5.1, 0, 4, 1.7, 1.5, 0],
            [10.2, 0, 0, 1.7, 0.6, 1.8, 0],
            [14, 5.1, 0, 4, 1.7, 1.5, 0],
            [10.5, 0.85, 0, 0.6, 0.8, 1.8, 0],
        ]
    )
    ids = np.array([PEDESTRIAN] * 2 + [CAR] * 3 + [CLASSES.index("Cyclist"), CAR, PEDESTRIAN])
    detections = Detections.of(boxes, ids, [0.5, 0.8, 0.9, 0.7, 0.95, 0.4, 0.3, 0.2])
    (car, person), (second_car, second_person) = boxes[[4, 1]], boxes[[6, 7]]  # each pair overlaps by 4 %
    assert min(bev_iou(car[None], second_car[None]), bev_iou(person[None], second_person[None])) > 0.03
    assert remove_duplicates(detections, FusedParams()).tolist() == [4, 1, 3, 5, 7]
    assert len(remove_duplicates(detections[:0], FusedParams())) == 0
