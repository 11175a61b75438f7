"""Parameters of the crop."""

from __future__ import annotations

import math
from dataclasses import dataclass

from lidar_perception.param_fields import Params, param


@dataclass(frozen=True)
class CropParams(Params):
    """Parameters of the crop, which precedes all other processing; by default nothing is removed."""

    body: tuple[float, ...] = param(
        float,
        "Box of the robot's own body, [min x, min y, min z, max x, max y, max z], in which points are dropped. "
        "In the sensor's frame, or in `base_frame` if it is set. Empty: none.",
        unit="m",
    )
    min_range: float = param(0.0, "Points closer to the sensor are dropped.", unit="m", low=0.0, high=1e5)
    max_range: float = param(
        0.0, "Points farther from the sensor are dropped; 0: no limit.", unit="m", low=0.0, high=1e5
    )
    sectors: tuple[float, ...] = param(
        float,
        "Azimuth ranges to drop, seen from the sensor: from, to, from, to ...; 0 is straight ahead (see "
        "`input.ahead`), 90 is left, however the sensor is mounted. 150, 210 is the area behind the sensor.",
        unit="deg",
    )

    @property
    def enabled(self) -> bool:
        """True if any limit is set."""
        return self != CropParams()

    def check(self) -> None:
        if not all(map(math.isfinite, (*self.body, *self.sectors))):
            raise ValueError("body and sectors must be finite")
        if len(self.body) not in (0, 6) or any(low >= high for low, high in zip(self.body[:3], self.body[3:])):
            raise ValueError(
                f"body = {list(self.body)} must be empty or [min x, min y, min z, max x, max y, max z], "
                "each min below its max"
            )
        if len(self.sectors) % 2:
            raise ValueError(f"sectors = {list(self.sectors)} must have an even number of values: from, to, from, to")
        if 0.0 < self.max_range < self.min_range:
            raise ValueError(f"max_range = {self.max_range} must be 0, or at least min_range = {self.min_range}")
