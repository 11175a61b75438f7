"""How the fields of a cloud are read."""

from __future__ import annotations

from dataclasses import dataclass

from lidar_perception.param_fields import Params, param


@dataclass(frozen=True)
class InputParams(Params):
    """How to read the fields of a cloud."""

    intensity_max: float = param(
        0.0, "The intensity of a full reflection: 1 for KITTI, 255 for Velodyne and nuScenes. 0: "
        "the largest value of the type for integer fields; for float fields 1, 255 or 65535, "
        "whichever fits the greatest value of the cloud.",
        low=0.0, high=1e9)


@dataclass(frozen=True)
class ViewParams(Params):
    """Crop to the camera's field of view (paper A, Section 3.2)."""

    enabled: bool = param(
        False, "Keep only the points that the camera sees. Needs the camera's calibration: "
        "CameraInfo and the transform from the LiDAR, both latched.")
