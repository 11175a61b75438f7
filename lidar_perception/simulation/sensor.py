"""What a spinning LiDAR is, as numbers, and where its rays go."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Sensor:
    """A LiDAR that turns about its z axis; angles in radians, lengths in metres."""

    elevations: tuple[float, ...]  # one per laser, descending
    azimuth_step: float            # between firings; rounded to a whole number in a turn
    height: float = 1.73           # above the road
    min_range: float = 0.9
    max_range: float = 120.0
    range_noise: float = 0.02      # standard deviation
    rate: float = 10.0             # turns per second
    dropout: float = 0.8           # share of returns lost at max_range; proportional to range

    @property
    def columns(self) -> int:
        """Firings in a turn."""
        return round(2 * np.pi / self.azimuth_step)

    def directions(self) -> np.ndarray:
        """(columns, lasers, 3) float64 unit vectors, counter-clockwise from straight ahead."""
        azimuth = np.arange(self.columns)[:, None] * (2 * np.pi / self.columns)
        elevation = np.asarray(self.elevations)
        flat = np.cos(elevation)
        return np.stack(np.broadcast_arrays(
            np.cos(azimuth) * flat, np.sin(azimuth) * flat, np.sin(elevation)), axis=-1)


# Velodyne HDL-64E S2: 32 upper lasers 1/3 degree apart, 32 lower ones 1/2 degree apart.
HDL64E = Sensor(
    elevations=tuple(np.radians(np.concatenate([2.0 - np.arange(32) / 3,
                                                -8.83 - np.arange(32) / 2])).tolist()),
    azimuth_step=float(np.radians(0.17)))
