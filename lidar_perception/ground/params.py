"""Parameters of the ground methods and of the sensor's mounting."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

from lidar_perception.param_fields import MAX_INT, Params, param, with_values
from lidar_perception.types import SENSOR_HEIGHT


@dataclass(frozen=True)
class SensorPoseParams(Params):
    """Parameters of the sensor's mounting.

    Algorithms use a levelled copy of the cloud; published points keep their coordinates.
    """

    height: float = param(
        SENSOR_HEIGHT,
        "Height of the sensor above the ground. If the height measured in the first clouds differs, a warning reports "
        "it.",
        unit="m",
        low=0.0,
        high=50.0,
    )
    roll: float = param(
        0.0,
        "Rotation of the sensor about its x axis, as in a URDF's rpy; pi is upside down.",
        unit="rad",
        low=-3.1416,
        high=3.1416,
    )
    pitch: float = param(
        0.0,
        "Rotation of the sensor about its y axis, as in a URDF's rpy; positive values tilt it down.",
        unit="rad",
        low=-1.58,
        high=1.58,
    )


@dataclass(frozen=True)
class ThresholdParams(Params):
    """Parameters of the height threshold and RANSAC plane (paper A, Sections 3.2 and 3.4, Table 2)."""

    max_height: float = param(
        0.43,
        "Maximum height, above the ground at the sensor, of the points to which the plane is fitted. For a sensor at "
        "1.73 m, 0.43 m is the paper's z < -1.3.",
        unit="m",
        low=-10.0,
        high=100.0,
    )
    inlier_distance: float = param(
        0.1, "Maximum vertical distance of ground points from the plane.", unit="m", low=0.001, high=2.0
    )
    separate: str = param(
        "plane",
        "plane: points near the plane are ground. height: all points below max_height are, as in the STM-CPA paper.",
        choices=("plane", "height"),
    )
    max_iterations: int = param(
        2000,
        "Maximum number of RANSAC trials; the search stops early once the best plane is unlikely to improve.",
        low=1,
        high=100_000,
    )
    max_slope: float = param(30.0, "Maximum slope of the plane.", unit="deg", low=0.0, high=89.0)
    seed: int = param(0, "Seed of the random trials.", low=0, high=MAX_INT)


@dataclass(frozen=True)
class PatchworkParams(Params):
    """Parameters of Patchwork++, which fits a plane in each sector of concentric zones (Lee et al., IROS 2022)."""

    min_range: float = param(2.7, "Points nearer than this are not ground.", unit="m", low=0.0, high=50.0)
    max_range: float = param(80.0, "Points farther than this are not ground.", unit="m", low=5.0, high=1000.0)
    inlier_distance: float = param(
        0.125, "Maximum distance of ground points from the plane of their sector.", unit="m", low=0.001, high=2.0
    )
    seed_distance: float = param(
        0.125,
        "Maximum height above the lowest points of the points that initialize the plane of a sector.",
        unit="m",
        low=0.001,
        high=2.0,
    )
    uprightness: float = param(
        0.707, "Minimum z component of the normal of a ground plane; 0.707 is 45 degrees.", low=0.0, high=1.0
    )
    remove_reflections: bool = param(True, "Drop points below the ground caused by reflections (RNR). Needs intensity.")

    def check(self) -> None:
        if self.max_range <= self.min_range:
            raise ValueError(f"max_range = {self.max_range} must be above min_range = {self.min_range}")


@dataclass(frozen=True)
class ClothParams(Params):
    """Parameters of the cloth simulation (paper C, Eq. 2 and 3; Zhang et al., Remote Sensing 2016)."""

    resolution: float = param(0.5, "Distance between the cloth's particles.", unit="m", low=0.1, high=10.0)
    max_range: float = param(
        100.0, "Half the side of the cloth; points beyond it are not ground.", unit="m", low=1.0, high=500.0
    )
    class_threshold: float = param(
        0.2, "Maximum vertical distance of ground points from the cloth.", unit="m", low=0.001, high=5.0
    )
    curvature: float = param(
        0.1,
        "Curvature of the unsupported cloth under gravity; a lower value makes the cloth stiffer.",
        unit="1/m",
        low=0.0001,
        high=10.0,
    )

    slope: float = param(
        0.08,
        "Maximum slope by which the ground is extended where a road rises faster than the cloth can bend; 0: off.",
        low=0.0,
        high=2.0,
    )

    def check(self) -> None:
        if (cells := (2 * self.max_range / self.resolution) ** 2) > 4_000_000:
            raise ValueError(
                f"resolution = {self.resolution} m and max_range = {self.max_range} m need {cells:.0f} particles, more "
                "than the maximum of 4 million; increase resolution or decrease max_range"
            )


GROUND_METHODS = ("threshold", "patchwork", "cloth")


@dataclass(frozen=True)
class GroundParams(Params):
    """Parameters of ground segmentation."""

    method: str = param(
        "threshold",
        "threshold: one plane (STM-CPA paper). patchwork: Patchwork++ (EG-PointPillars paper). cloth: cloth "
        "simulation (improved-PointNet paper).",
        choices=GROUND_METHODS,
    )
    sensor_pose: SensorPoseParams = SensorPoseParams()
    threshold: ThresholdParams = ThresholdParams()
    patchwork: PatchworkParams = PatchworkParams()
    cloth: ClothParams = ClothParams()


@dataclass(frozen=True)
class ObstacleParams(Params):
    """Parameters of the selection of obstacles by height above the ground."""

    min_height: float = param(
        0.0,
        "Minimum height of obstacles above the ground around them; 0: no limit, points below the ground are obstacles.",
        unit="m",
        low=0.0,
        high=100.0,
    )
    max_height: float = param(
        0.0,
        "Maximum height of obstacles above the ground around them, so that a robot passes under branches and bridges; "
        "0: no limit.",
        unit="m",
        low=0.0,
        high=100.0,
    )

    def check(self) -> None:
        if 0.0 < self.max_height < self.min_height:
            raise ValueError(f"max_height = {self.max_height} must not be below min_height = {self.min_height}, or 0")


P = TypeVar("P")  # any parameter dataclass with a group `ground`


def set_sensor_height(params: P, height: float) -> P:
    """Return the parameters for a sensor mounted `height` metres above the ground."""
    return with_values(params, {"ground.sensor_pose.height": height})
