"""Batched extended Kalman filters of N objects on the ground.

The state is [x y vx vy heading turn_rate] in metres, seconds and radians in a fixed frame. The
motion model is a coordinated turn with Cartesian velocity (Li and Jilkov, IEEE TAES 2003, Section
V.B); with zero turn rate and turn rate variance it is the constant velocity model. means are
(N, 6), covariances (N, 6, 6), both float64; N may be 0.
"""

from __future__ import annotations

import numpy as np

from lidar_perception.classes import UNKNOWN_YAW_RAD
from lidar_perception.geometry import wrap_angle, wrap_line

X, Y, VX, VY, HEADING, TURN_RATE = range(6)
MEASURED_INDICES = np.array([X, Y, HEADING])  # elements of the state that are measured
MIN_OPPOSING_SCORE = 1.0  # sum of the scores of opposite headings at which a heading is reversed
MIN_TURN_RAD = 1e-4  # rotation per step below which sin(a) / a is computed as a series


def predict(
    means: np.ndarray,
    covariances: np.ndarray,
    seconds: float,
    acceleration: np.ndarray,
    turning: np.ndarray,
    wandering: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Predict means and covariances `seconds` (0 or more) ahead.

    Args:
        acceleration, turning, wandering: (N,) noise densities, see MotionParams.
    """
    t, count = seconds, len(means)
    _, _, vx, vy, _, turn_rate = means.T
    angle = turn_rate * t
    is_straight = np.abs(angle) < MIN_TURN_RAD
    divisor = np.where(is_straight, 1.0, turn_rate)
    sin, cos = np.sin(angle), np.cos(angle)
    forward_factor = np.where(is_straight, t, sin / divisor)
    lateral_factor = np.where(is_straight, angle * t / 2, (1.0 - cos) / divisor)
    predicted_means = means.copy()
    predicted_means[:, X] += forward_factor * vx - lateral_factor * vy
    predicted_means[:, Y] += lateral_factor * vx + forward_factor * vy
    predicted_means[:, VX], predicted_means[:, VY] = cos * vx - sin * vy, sin * vx + cos * vy
    predicted_means[:, HEADING] = wrap_angle(means[:, HEADING] + angle)

    forward_derivative = np.where(is_straight, -angle * t * t / 3, (t * cos - forward_factor) / divisor)
    lateral_derivative = np.where(is_straight, t * t / 2, (t * sin - lateral_factor) / divisor)
    f = np.tile(np.eye(6), (count, 1, 1))
    f[:, X, VX] = f[:, Y, VY] = forward_factor
    f[:, X, VY], f[:, Y, VX] = -lateral_factor, lateral_factor
    f[:, VX, VX] = f[:, VY, VY] = cos
    f[:, VX, VY], f[:, VY, VX] = -sin, sin
    f[:, X, TURN_RATE] = forward_derivative * vx - lateral_derivative * vy
    f[:, Y, TURN_RATE] = lateral_derivative * vx + forward_derivative * vy
    f[:, VX, TURN_RATE], f[:, VY, TURN_RATE] = -t * predicted_means[:, VY], t * predicted_means[:, VX]
    f[:, HEADING, TURN_RATE] = t
    predicted_covariances = f @ covariances @ f.transpose(0, 2, 1)
    for value, rate, density in ((X, VX, acceleration), (Y, VY, acceleration), (HEADING, TURN_RATE, turning)):
        variance_density = density * density
        predicted_covariances[:, value, value] += variance_density * t**3 / 3
        predicted_covariances[:, value, rate] += variance_density * t * t / 2
        predicted_covariances[:, rate, value] += variance_density * t * t / 2
        predicted_covariances[:, rate, rate] += variance_density * t
    predicted_covariances[:, HEADING, HEADING] += wandering * wandering * t
    return predicted_means, predicted_covariances


def update(
    means: np.ndarray, covariances: np.ndarray, measurements: np.ndarray, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Update the states with measured positions and headings.

    Detectors confuse front and rear, so the measured heading or its opposite is used, whichever is
    closer to the heading of the state. flip_reversed_headings() determines the front.

    Args:
        measurements: (N, 3) [x y heading].
        noise: (N, 3) standard deviations of the measurements.
    """
    innovation = measurements - means[:, MEASURED_INDICES]
    innovation[:, 2] = wrap_line(innovation[:, 2])
    cross_covariances = covariances[:, :, MEASURED_INDICES]
    innovation_covariances = cross_covariances[:, MEASURED_INDICES]
    innovation_covariances[:, range(3), range(3)] += noise * noise
    gain = np.linalg.solve(innovation_covariances, cross_covariances.transpose(0, 2, 1)).transpose(0, 2, 1)
    return _normalize(
        means + (gain @ innovation[:, :, None])[:, :, 0], covariances - gain @ cross_covariances.transpose(0, 2, 1)
    )


def constrain_to_heading(means: np.ndarray, covariances: np.ndarray, slip: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Update the states with the assumption that objects move along their heading.

    The lateral speed is treated as a measurement of 0, which couples the heading with the direction
    of motion.

    Args:
        slip: (N,) standard deviation of the lateral speed, m/s.
    """
    sin, cos = np.sin(means[:, HEADING]), np.cos(means[:, HEADING])
    vx, vy = means[:, VX], means[:, VY]
    jacobian = np.zeros((len(means), 6))
    jacobian[:, VX], jacobian[:, VY], jacobian[:, HEADING] = -sin, cos, -(cos * vx + sin * vy)
    cross_covariances = (covariances @ jacobian[:, :, None])[:, :, 0]
    variances = (jacobian * cross_covariances).sum(axis=1) + slip * slip
    gain = cross_covariances / variances[:, None]
    lateral_speed = cos * vy - sin * vx
    return _normalize(
        means - gain * lateral_speed[:, None], covariances - gain[:, :, None] * cross_covariances[:, None, :]
    )


def flip_reversed_headings(
    means: np.ndarray, agreement: np.ndarray, max_reverse_speed: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Reverse the headings that point backwards.

    A heading is reversed if the object moves backwards faster than max_reverse_speed, or if the
    measured headings oppose it and the object does not move forward faster than max_reverse_speed.

    Args:
        means: (N, 6) states.
        agreement: (N,) sum of the scores of measured headings that agree with the state, minus the
            sum of those that oppose it.
        max_reverse_speed: (N,) m/s.

    Returns:
        The new means and agreements.
    """
    forward_speed = np.cos(means[:, HEADING]) * means[:, VX] + np.sin(means[:, HEADING]) * means[:, VY]
    is_reversed = (forward_speed < -max_reverse_speed) | (agreement < -MIN_OPPOSING_SCORE) & (
        forward_speed <= max_reverse_speed
    )
    new_means = means.copy()
    new_means[:, HEADING] = wrap_angle(means[:, HEADING] + np.pi * is_reversed)
    return new_means, np.where(is_reversed, -agreement, agreement)


def _normalize(means: np.ndarray, covariances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Wrap the headings and make the covariances symmetric."""
    means[:, HEADING] = wrap_angle(means[:, HEADING])
    return means, (covariances + covariances.transpose(0, 2, 1)) / 2


def rotate_covariances(covariances: np.ndarray, cos: float, sin: float, side: float = 1.0) -> np.ndarray:
    """Transform covariances to a frame in which the old x axis is [cos sin].

    Args:
        side: 1 if the old y axis is to the left of the old x axis in the new frame, -1 if it is to
            the right because one of the frames is upside down.
    """
    rotation = np.diag([cos, side * cos, cos, side * cos, side, side])
    for a, b in ((X, Y), (VX, VY)):
        rotation[a, b], rotation[b, a] = -side * sin, sin
    return rotation @ covariances @ rotation.T


def forget_headings(covariances: np.ndarray, is_unknown: np.ndarray) -> np.ndarray:
    """Return the covariances with an unknown heading, without correlations, where is_unknown (N,) is True."""
    result = covariances.copy()
    result[is_unknown, HEADING, :] = 0.0
    result[is_unknown, :, HEADING] = 0.0
    result[is_unknown, HEADING, HEADING] = UNKNOWN_YAW_RAD**2
    return result
