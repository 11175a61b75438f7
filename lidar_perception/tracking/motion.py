"""Batched extended Kalman filters of N objects on the ground.

The state is [x y vx vy heading turn] in metres, seconds and radians in a fixed frame, with a
velocity that turns at a constant rate (coordinated turn with Cartesian velocity; Li and Jilkov,
IEEE TAES 2003, Section V.B). With zero turn rate and turn variance it is the constant velocity
filter. means are (N, 6), covariances (N, 6, 6), both float64; N may be 0.
"""

from __future__ import annotations

import numpy as np

from lidar_perception.geometry import wrap_angle, wrap_line

X, Y, VX, VY, HEADING, TURN = range(6)
MEASURED = np.array([X, Y, HEADING])
MIN_OPPOSING_SCORE = 1.0  # sum of scores of opposite measured headings that flips a heading
MIN_TURN_RAD = 1e-4  # rotation per step below which the series of sin(a) / a is used


def predict(
    means: np.ndarray,
    covariances: np.ndarray,
    seconds: float,
    acceleration: np.ndarray,
    turning: np.ndarray,
    wandering: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Predict means and covariances `seconds` (0 or more) ahead.

    acceleration, turning and wandering (N,) are the noise densities of MotionParams.
    """
    t, count = seconds, len(means)
    _, _, vx, vy, _, turn = means.T
    angle = turn * t
    straight = np.abs(angle) < MIN_TURN_RAD
    safe = np.where(straight, 1.0, turn)
    sin, cos = np.sin(angle), np.cos(angle)
    along = np.where(straight, t, sin / safe)
    across = np.where(straight, angle * t / 2, (1.0 - cos) / safe)
    later = means.copy()
    later[:, X] += along * vx - across * vy
    later[:, Y] += across * vx + along * vy
    later[:, VX], later[:, VY] = cos * vx - sin * vy, sin * vx + cos * vy
    later[:, HEADING] = wrap_angle(means[:, HEADING] + angle)

    along_by_turn = np.where(straight, -angle * t * t / 3, (t * cos - along) / safe)
    across_by_turn = np.where(straight, t * t / 2, (t * sin - across) / safe)
    f = np.tile(np.eye(6), (count, 1, 1))
    f[:, X, VX] = f[:, Y, VY] = along
    f[:, X, VY], f[:, Y, VX] = -across, across
    f[:, VX, VX] = f[:, VY, VY] = cos
    f[:, VX, VY], f[:, VY, VX] = -sin, sin
    f[:, X, TURN] = along_by_turn * vx - across_by_turn * vy
    f[:, Y, TURN] = across_by_turn * vx + along_by_turn * vy
    f[:, VX, TURN], f[:, VY, TURN] = -t * later[:, VY], t * later[:, VX]
    f[:, HEADING, TURN] = t
    predicted = f @ covariances @ f.transpose(0, 2, 1)
    for place, speed, density in ((X, VX, acceleration), (Y, VY, acceleration), (HEADING, TURN, turning)):
        square = density * density
        predicted[:, place, place] += square * t**3 / 3
        predicted[:, place, speed] += square * t * t / 2
        predicted[:, speed, place] += square * t * t / 2
        predicted[:, speed, speed] += square * t
    predicted[:, HEADING, HEADING] += wandering * wandering * t
    return later, predicted


def update(
    means: np.ndarray, covariances: np.ndarray, measured: np.ndarray, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Update with measured (N, 3) [x y heading] of standard deviations noise (N, 3).

    The measured heading or its opposite is used, whichever is nearer to the state's: detectors
    confuse front and rear, which flip_reversed_headings() decides.
    """
    innovation = measured - means[:, MEASURED]
    innovation[:, 2] = wrap_line(innovation[:, 2])
    against = covariances[:, :, MEASURED]
    spread = against[:, MEASURED]
    spread[:, range(3), range(3)] += noise * noise
    gain = np.linalg.solve(spread, against.transpose(0, 2, 1)).transpose(0, 2, 1)
    return _normalize(means + (gain @ innovation[:, :, None])[:, :, 0], covariances - gain @ against.transpose(0, 2, 1))


def constrain_to_heading(means: np.ndarray, covariances: np.ndarray, slip: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Update with a lateral speed of 0, of standard deviations slip (N,).

    Wheels and feet go forward, so this couples the heading and the direction of motion.
    """
    sin, cos = np.sin(means[:, HEADING]), np.cos(means[:, HEADING])
    vx, vy = means[:, VX], means[:, VY]
    slope = np.zeros((len(means), 6))
    slope[:, VX], slope[:, VY], slope[:, HEADING] = -sin, cos, -(cos * vx + sin * vy)
    against = (covariances @ slope[:, :, None])[:, :, 0]
    spread = (slope * against).sum(axis=1) + slip * slip
    gain = against / spread[:, None]
    across = cos * vy - sin * vx
    return _normalize(means - gain * across[:, None], covariances - gain[:, :, None] * against[:, None, :])


def flip_reversed_headings(
    means: np.ndarray, agreement: np.ndarray, backwards: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Reverse the headings that point backwards.

    A heading is reversed if the object moves backwards faster than backwards (N,) m/s, or if it
    does not move forward faster than that and the measured headings oppose it: agreement (N,) is
    the sum of the scores of agreeing headings less that of opposite ones.

    Returns the new means and agreements.
    """
    forward = np.cos(means[:, HEADING]) * means[:, VX] + np.sin(means[:, HEADING]) * means[:, VY]
    wrong = (forward < -backwards) | (agreement < -MIN_OPPOSING_SCORE) & (forward <= backwards)
    flipped = means.copy()
    flipped[:, HEADING] = wrap_angle(means[:, HEADING] + np.pi * wrong)
    return flipped, np.where(wrong, -agreement, agreement)


def _normalize(means: np.ndarray, covariances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Wrap the headings and make the covariances symmetric."""
    means[:, HEADING] = wrap_angle(means[:, HEADING])
    return means, (covariances + covariances.transpose(0, 2, 1)) / 2


def rotate_covariances(covariances: np.ndarray, cos: float, sin: float, side: float = 1.0) -> np.ndarray:
    """Express covariances in axes in which the old x axis is [cos sin].

    The old y axis points to the left of the old x axis, or with side -1, for an upside-down frame,
    to its right.
    """
    r = np.diag([cos, side * cos, cos, side * cos, side, side])
    for a, b in ((X, Y), (VX, VY)):
        r[a, b], r[b, a] = -side * sin, sin
    return r @ covariances @ r.T
