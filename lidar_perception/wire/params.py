"""Parameters for reading the fields of a cloud."""

from __future__ import annotations

from dataclasses import dataclass

from lidar_perception.param_fields import Params, param


@dataclass(frozen=True)
class InputParams(Params):
    """Parameters that describe the fields of a cloud."""

    intensity_max: float = param(
        0.0,
        "Intensity of a full reflection: 1 for KITTI, 255 for "
        "Velodyne and nuScenes. 0: 255 for 8-bit fields; otherwise "
        "the smallest of 1 (floats), 100 (floats with fractions), 255, "
        "1023, 4095 and 65535 that no cloud has exceeded so far.",
        low=0.0,
        high=1e9,
    )


@dataclass(frozen=True)
class ViewParams(Params):
    """Parameters of the crop to the camera's field of view (paper A, Section 3.2)."""

    enabled: bool = param(
        False,
        "Keep only points in the camera's view. Requires the camera's "
        "calibration: CameraInfo and the transform from the LiDAR.",
    )
