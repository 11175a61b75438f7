"""Projections from the LiDAR frame in metres to pixels."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

NEAR = 0.3  # distance of the near clipping plane in metres
EYE_HEIGHT = 1000.0  # z of the eye of the bird's-eye view in metres


@dataclass(frozen=True)
class Perspective:
    """Pinhole camera.

    Attributes:
        eye: Position of the camera in the LiDAR frame, metres.
        target: Point at the centre of the image, in the LiDAR frame, metres.
        fov: Horizontal field of view in degrees.
        width, height: Size of the image in pixels.
        point_radius: Radius of a point in metres.
    """

    eye: tuple[float, float, float]
    target: tuple[float, float, float]
    fov: float
    width: int
    height: int
    point_radius: float = 0.022

    @property
    def focal(self) -> float:
        """Focal length in pixels."""
        return self.width / 2 / float(np.tan(np.radians(self.fov) / 2))

    @cached_property
    def axes(self) -> np.ndarray:
        """Camera axes (3, 3) as columns: right and down, scaled by the focal length, and forward."""
        forward = np.subtract(self.target, self.eye)
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        return np.stack([right * self.focal, np.cross(forward, right) * self.focal, forward], axis=1)

    def project(self, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project points (..., 3) to pixels (..., 2) [column row] and depths (...).

        Points with a depth below NEAR must not be drawn.
        """
        axes = self.axes
        camera_points = xyz @ axes.astype(xyz.dtype) - (self.eye @ axes).astype(xyz.dtype)
        depth = camera_points[..., 2]
        pixels = camera_points[..., :2] / np.maximum(depth, NEAR)[..., None]
        pixels += np.array([self.width / 2, self.height / 2], xyz.dtype)
        return pixels, depth

    def find_radii(self, depth: np.ndarray) -> np.ndarray:
        """Return the radius in pixels of points at these depths (N,)."""
        return np.clip(self.point_radius * self.focal / np.maximum(depth, NEAR), 0.5, 3.0)


@dataclass(frozen=True)
class BirdsEye:
    """Bird's-eye view with x up and y to the left.

    Attributes:
        centre: x and y at the centre of the image, metres.
        scale: Pixels per metre.
        width, height: Size of the image in pixels.
    """

    centre: tuple[float, float]
    scale: float
    width: int
    height: int

    def project(self, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project points (..., 3) to pixels (..., 2) [column row] and depths (...)."""
        origin_pixel = [self.width / 2 + self.centre[1] * self.scale, self.height / 2 + self.centre[0] * self.scale]
        pixels = np.array(origin_pixel, xyz.dtype) - xyz[..., 1::-1] * xyz.dtype.type(self.scale)
        return pixels, EYE_HEIGHT - xyz[..., 2]

    def find_radii(self, depth: np.ndarray) -> np.ndarray:
        """Return the radius in pixels of points at these depths (N,)."""
        return np.full(np.shape(depth), 0.75)


View = Perspective | BirdsEye


def project_lines(view: View, lines: np.ndarray) -> np.ndarray:
    """Project lines (S, 2, 3) to segments (S, 2, 2) in pixels.

    Lines that pass behind the eye are clipped; lines that are completely behind it become NaN.
    """
    pixels, depth = view.project(lines)
    is_behind = depth < NEAR
    if is_behind.any():
        fraction = (NEAR - depth[:, 0]) / np.where(is_behind.any(axis=1), depth[:, 1] - depth[:, 0], 1.0)
        near_points = lines[:, 0] + fraction[:, None] * (lines[:, 1] - lines[:, 0])
        pixels = view.project(np.where(is_behind[..., None], near_points[:, None], lines))[0]
        pixels[is_behind.all(axis=1)] = np.nan
    return pixels
