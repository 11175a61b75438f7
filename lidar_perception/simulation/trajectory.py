"""Trajectory of the sensor: along x at constant speed, with sinusoidal motion along y."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

DRIVE_SECONDS = 20.0  # duration of a drive
ROBOT_RADIUS_M = 0.35
ROBOT_SPEEDS = 0.5, 1.5  # minimum and maximum speed of a robot, m/s
STOP_CHANCE = 0.15  # probability that a robot stands still


class TrajectoryPoint(NamedTuple):
    """Position, heading and velocity on a trajectory at one time.

    Attributes:
        x, y: Position in the world, m.
        heading: rad.
        velocity: (2,) in the world, m/s.
        yaw_rate: rad/s, counter-clockwise.
    """

    x: float
    y: float
    heading: float
    velocity: tuple[float, float]
    yaw_rate: float


class Trajectory(NamedTuple):
    """Smooth trajectory: x = speed * t, y = sum of amplitude * sin(rate * t + phase).

    Attributes:
        speed: m/s.
        sinusoids: (amplitude in m, rate in rad/s, phase in rad) of each sinusoid along y; empty for
            a straight trajectory.
    """

    speed: float = 0.0
    sinusoids: tuple[tuple[float, float, float], ...] = ()

    def evaluate(self, t: float) -> TrajectoryPoint:
        """Return position, heading and their derivatives after t seconds."""
        y = velocity_y = acceleration_y = 0.0
        for amplitude, rate, phase in self.sinusoids:
            sin, cos = math.sin(rate * t + phase), math.cos(rate * t + phase)
            y, velocity_y = y + amplitude * sin, velocity_y + amplitude * rate * cos
            acceleration_y -= amplitude * rate * rate * sin
        speed_sq = self.speed**2 + velocity_y**2
        yaw_rate = self.speed * acceleration_y / speed_sq if speed_sq else 0.0
        heading = math.atan2(velocity_y, self.speed)
        return TrajectoryPoint(self.speed * t, y, heading, (self.speed, velocity_y), yaw_rate)

    def sample(self, seconds: float, step: float) -> np.ndarray:
        """Sample the trajectory from 0 to `seconds` every `step` seconds: (T, 3) float64 rows [t x y]."""
        times = np.linspace(0.0, seconds, round(seconds / step) + 1)
        return np.array([(t, *self.evaluate(t)[:2]) for t in times])


def draw_trajectory(rng: np.random.Generator, max_heading: float) -> Trajectory:
    """Draw a trajectory of a robot that stands still, or weaves with periods of 8 to 25 s.

    Args:
        max_heading: Maximum deviation of the heading from x, rad.
    """
    if rng.random() < STOP_CHANCE:
        return Trajectory()
    speed, rate = rng.uniform(*ROBOT_SPEEDS), 2 * np.pi / rng.uniform((8.0, 15.0), (15.0, 25.0))
    # The maximum heading of one sinusoid is atan(amplitude * rate / speed); each of the two gets half of it.
    amplitude = 0.5 * speed * np.tan(max_heading * rng.uniform(0.3, 1.0, 2)) / rate
    phase = rng.uniform(-np.pi, np.pi, 2)
    return Trajectory(float(speed), tuple(zip(amplitude.tolist(), rate.tolist(), phase.tolist())))
