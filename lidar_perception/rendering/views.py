"""Projections from the LiDAR frame in metres to pixels."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

NEAR = 0.3  # near clipping distance in metres


class View(Protocol):
    """A projection onto an image of width x height pixels."""

    @property
    def width(self) -> int: ...

    @property
    def height(self) -> int: ...

    def project(self, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return pixels (..., 2), column and row, and depths (...) of points (..., 3). Points with
        a depth below NEAR cannot be drawn."""

    def radius(self, depth: np.ndarray) -> np.ndarray:
        """Return the radius in pixels of points at these depths."""


@dataclass(frozen=True)
class Perspective:
    """A pinhole camera.

    Attributes:
        eye, target: position and viewed point in the LiDAR frame, metres.
        fov: horizontal field of view in degrees.
        width, height: pixels.
        point: radius of a point in metres.
    """

    eye: tuple[float, float, float]
    target: tuple[float, float, float]
    fov: float
    width: int
    height: int
    point: float = 0.022

    @property
    def focal(self) -> float:
        """Focal length in pixels."""
        return self.width / 2 / float(np.tan(np.radians(self.fov) / 2))

    @cached_property
    def axes(self) -> np.ndarray:
        """(3, 3) columns right and down, scaled by the focal length, and ahead."""
        ahead = np.subtract(self.target, self.eye)
        ahead /= np.linalg.norm(ahead)
        right = np.cross(ahead, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        return np.stack([right * self.focal, np.cross(ahead, right) * self.focal, ahead], axis=1)

    def project(self, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        axes = self.axes
        camera = xyz @ axes.astype(xyz.dtype) - (self.eye @ axes).astype(xyz.dtype)
        depth = camera[..., 2]
        pixels = camera[..., :2] / np.maximum(depth, NEAR)[..., None]
        pixels += np.array([self.width / 2, self.height / 2], xyz.dtype)
        return pixels, depth

    def radius(self, depth: np.ndarray) -> np.ndarray:
        return np.clip(self.point * self.focal / np.maximum(depth, NEAR), 0.5, 3.0)


@dataclass(frozen=True)
class BirdsEye:
    """Bird's-eye view, x up and y to the left.

    Attributes:
        centre: x and y in the middle of the image, metres.
        scale: pixels per metre.
        above: height of the eye in metres.
    """

    centre: tuple[float, float]
    scale: float
    width: int
    height: int
    above: float = 1000.0

    def project(self, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        middle = [self.width / 2 + self.centre[1] * self.scale, self.height / 2 + self.centre[0] * self.scale]
        pixels = np.array(middle, xyz.dtype) - xyz[..., 1::-1] * xyz.dtype.type(self.scale)
        return pixels, self.above - xyz[..., 2]

    def radius(self, depth: np.ndarray) -> np.ndarray:
        return np.full(np.shape(depth), 0.75)


def project_lines(view: View, lines: np.ndarray) -> np.ndarray:
    """Project lines (S, 2, 3) to segments (S, 2, 2) in pixels, cut where they pass behind the eye;
    NaN for lines behind it."""
    pixels, depth = view.project(lines)
    behind = depth < NEAR
    if behind.any():
        share = (NEAR - depth[:, 0]) / np.where(behind.any(axis=1), depth[:, 1] - depth[:, 0], 1.0)
        cut = lines[:, 0] + share[:, None] * (lines[:, 1] - lines[:, 0])
        pixels = view.project(np.where(behind[..., None], cut[:, None], lines))[0]
        pixels[behind.all(axis=1)] = np.nan
    return pixels
