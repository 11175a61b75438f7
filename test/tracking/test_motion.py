"""The Kalman filter of the tracker: prediction, updates and heading."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidar_perception.geometry import wrap_angle
from lidar_perception.tracking.motion import (
    constrain_to_heading,
    flip_reversed_headings,
    predict,
    rotate_covariances,
    update,
)

NUMBERS = st.floats(-20, 20)
STATE = st.tuples(NUMBERS, NUMBERS, NUMBERS, NUMBERS, st.floats(-3, 3), st.floats(-1.5, 1.5))
NONE = np.zeros(1)


def draw_covariances(seed=0, count=1):
    parts = np.random.default_rng(seed).normal(size=(count, 6, 6))
    return parts @ parts.transpose(0, 2, 1) + 0.1 * np.eye(6)


@given(STATE, st.floats(0, 2), st.floats(0, 2))
def test_two_predictions_equal_one_long_prediction(state, first, second):
    means, p = np.array([state]), draw_covariances()
    at_once = predict(means, p, first + second, NONE, NONE, NONE)
    twice_predicted = predict(*predict(means, p, first, NONE, NONE, NONE), second, NONE, NONE, NONE)
    np.testing.assert_allclose(twice_predicted[0][:, [0, 1, 2, 3, 5]], at_once[0][:, [0, 1, 2, 3, 5]], atol=1e-6)
    assert wrap_angle(twice_predicted[0][0, 4] - at_once[0][0, 4]) == pytest.approx(0, abs=1e-6)


@given(STATE, st.floats(0.01, 0.5))
def test_covariance_prediction_matches_numeric_jacobian(state, seconds):
    means, p = np.array([state]), draw_covariances(3)
    _, grown = predict(means, p, seconds, NONE, NONE, NONE)
    step, slope = 1e-5, np.zeros((6, 6))
    for k in range(6):
        ends = [predict(means + s * np.eye(6)[k], p, seconds, NONE, NONE, NONE)[0][0] for s in (step, -step)]
        slope[:, k] = ends[0] - ends[1]
        slope[4, k] = wrap_angle(slope[4, k])
    slope /= 2 * step
    np.testing.assert_allclose(grown[0], slope @ p[0] @ slope.T, rtol=1e-3, atol=1e-2)


def test_constant_turn_rate_gives_a_circle():
    circle = np.array([[0.0, 0.0, 2.0, 0.0, 0.0, np.pi / 2]])
    means, _ = predict(circle, draw_covariances(), 4.0, NONE, NONE, NONE)  # a full circle
    np.testing.assert_allclose(means, circle, atol=1e-9)


def test_update_shrinks_covariance_and_moves_to_measurement():
    means, p = np.zeros((4, 6)), draw_covariances(1, 4)
    measurement = np.full((4, 3), 0.3)
    after, narrower = update(means, p, measurement, np.full((4, 3), 0.1))
    assert (np.linalg.eigvalsh(p - narrower) > -1e-9).all()
    assert (np.linalg.eigvalsh(narrower) > 0).all()
    sure, _ = update(means, p, measurement, np.full((4, 3), 1e-5))
    np.testing.assert_allclose(sure[:, [0, 1, 4]], measurement, atol=1e-4)
    assert (np.abs(after[:, :2] - 0.3) < 0.3 + 1e-9).all()


@given(st.floats(-3.1, 3.1), st.floats(-1.4, 1.4))
def test_opposite_headings_give_equal_updates(heading, off):
    means = np.array([[0, 0, 0, 0, heading, 0.0]])
    ends = [
        update(means, draw_covariances(2), np.array([[0.1, 0.2, heading + off + k * np.pi]]), np.full((1, 3), 0.2))[0]
        for k in (0, 1)
    ]
    np.testing.assert_allclose(ends[0][0, :4], ends[1][0, :4], atol=1e-7)
    assert wrap_angle(ends[0][0, 4] - ends[1][0, 4]) == pytest.approx(0, abs=1e-7)


def test_lateral_speed_decays_and_reversed_heading_is_flipped():
    means = np.array([[0.0, 0, 5, 1, 0, 0]])
    constrained_means, p = constrain_to_heading(means, np.eye(6)[None], np.array([0.1]))
    across = [np.cos(m[4]) * m[3] - np.sin(m[4]) * m[2] for m in (means[0], constrained_means[0])]
    assert abs(across[1]) < 0.2 * abs(across[0]) and (np.linalg.eigvalsh(p) > 0).all()
    backwards = np.array([[0.0, 0, -5, 0, 0.2, 0], [0, 0, -0.5, 0, 0.2, 0]])
    flipped, agreement = flip_reversed_headings(backwards, np.array([9.0, 9.0]), np.array([2.0, 2.0]))
    assert flipped[:, 4] == pytest.approx([0.2 - np.pi, 0.2])
    assert agreement.tolist() == [-9, 9]
    flipped_back, _ = flip_reversed_headings(flipped, agreement, np.full(2, 2.0))
    assert flipped_back.tolist() == flipped.tolist()  # the measured headings do not flip it back


def test_covariances_rotate_with_the_axes():
    angle = 0.7
    cos, sin = np.cos(angle), np.sin(angle)
    p = draw_covariances(5)
    rotated = rotate_covariances(p, cos, sin)
    np.testing.assert_allclose(rotate_covariances(rotated, cos, -sin), p, atol=1e-12)
    r = np.array([[cos, -sin], [sin, cos]])
    np.testing.assert_allclose(rotated[0, 2:4, 2:4], r @ p[0, 2:4, 2:4] @ r.T)
