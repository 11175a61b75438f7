"""Trajectory of the sensor: ahead along x at constant speed, swaying to both sides."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

DRIVE_SECONDS = 20.0  # time during which nothing collides
ROBOT_RADIUS_M = 0.35  # radius of a robot off the road


class TrajectoryPoint(NamedTuple):
    """A trajectory at one time: x, y in the world (m), heading (rad), velocity (2,) in the world
    (m/s) and yaw_rate (rad/s, counter-clockwise)."""

    x: float
    y: float
    heading: float
    velocity: tuple[float, float]
    yaw_rate: float


class Trajectory(NamedTuple):
    """x = speed * t and y = sum of reach * sin(rate * t + phase) over the sways (m, rad/s, rad).

    Heading, velocity and yaw rate are exact derivatives. Without sways it is straight.
    """

    speed: float = 0.0
    sways: tuple[tuple[float, float, float], ...] = ()

    def at(self, t: float) -> TrajectoryPoint:
        """Return the point after t seconds."""
        y = aside = turning = 0.0
        for reach, rate, phase in self.sways:
            sin, cos = math.sin(rate * t + phase), math.cos(rate * t + phase)
            y, aside = y + reach * sin, aside + reach * rate * cos
            turning -= reach * rate * rate * sin
        square = self.speed**2 + aside**2
        yaw_rate = self.speed * turning / square if square else 0.0
        return TrajectoryPoint(self.speed * t, y, math.atan2(aside, self.speed), (self.speed, aside), yaw_rate)

    def sampled(self, seconds: float, step: float) -> np.ndarray:
        """Return (T, 3) float64 rows [t x y] from 0 to seconds, every step seconds."""
        times = np.linspace(0.0, seconds, round(seconds / step) + 1)
        return np.array([(t, *self.at(t)[:2]) for t in times])


def draw_trajectory(rng: np.random.Generator, speed: tuple[float, float], stands: float, turn: float) -> Trajectory:
    """Draw a trajectory that stands still or sways in 8 to 25 s.

    Args:
        speed: Range of the speed, m/s.
        stands: Probability of standing still.
        turn: Largest heading to both sides, rad.
    """
    if rng.random() < stands:
        return Trajectory()
    pace, long = rng.uniform(*speed), 2 * np.pi / rng.uniform((8.0, 15.0), (15.0, 25.0))
    # One sinusoid turns by at most atan(reach * rate / speed); two share the angle.
    reach = 0.5 * pace * np.tan(turn * rng.uniform(0.3, 1.0, 2)) / long
    phase = rng.uniform(-np.pi, np.pi, 2)
    return Trajectory(float(pace), tuple(zip(reach.tolist(), long.tolist(), phase.tolist())))
