"""Where the eye is: from metres in the LiDAR frame to pixels."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

NEAR = 0.3  # metres ahead of the eye; nothing nearer is drawn


class View(Protocol):
    """A projection onto an image of width x height pixels."""

    @property
    def width(self) -> int: ...

    @property
    def height(self) -> int: ...

    def project(self, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return pixels (..., 2), column and row, and the depth (...) of points (..., 3). Those
        with a depth below NEAR cannot be drawn."""

    def radius(self, depth: np.ndarray) -> np.ndarray:
        """Return the radius in pixels of points at these depths."""


@dataclass(frozen=True)
class Perspective:
    """A pinhole camera. eye, target: metres in the LiDAR frame; fov: degrees from left to right;
    point: metres, the radius of a point."""

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
        """(3, 3): its columns are right and down, a focal length long, and ahead."""
        ahead = np.subtract(self.target, self.eye)
        ahead /= np.linalg.norm(ahead)
        right = np.cross(ahead, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        return np.stack([right * self.focal, np.cross(ahead, right) * self.focal, ahead], axis=1)

    def project(self, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        axes = self.axes
        seen = xyz @ axes.astype(xyz.dtype) - (self.eye @ axes).astype(xyz.dtype)
        depth = seen[..., 2]
        pixels = seen[..., :2] / np.maximum(depth, NEAR)[..., None]
        pixels += np.array([self.width / 2, self.height / 2], xyz.dtype)
        return pixels, depth

    def radius(self, depth: np.ndarray) -> np.ndarray:
        return np.clip(self.point * self.focal / np.maximum(depth, NEAR), 0.5, 3.0)


@dataclass(frozen=True)
class BirdsEye:
    """From above, x up and y to the left. centre: metres, in the middle; scale: pixels a metre."""

    centre: tuple[float, float]
    scale: float
    width: int
    height: int
    above: float = 1000.0  # metres, of the eye

    def project(self, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        middle = [self.width / 2 + self.centre[1] * self.scale,
                  self.height / 2 + self.centre[0] * self.scale]
        pixels = np.array(middle, xyz.dtype) - xyz[..., 1::-1] * xyz.dtype.type(self.scale)
        return pixels, self.above - xyz[..., 2]

    def radius(self, depth: np.ndarray) -> np.ndarray:
        return np.full(np.shape(depth), 0.75)


def before_eye(view: View, lines: np.ndarray) -> np.ndarray:
    """Return segments (S, 2, 2) in pixels of the parts of lines (S, 2, 3) that lie before the eye;
    NaN for lines behind it."""
    pixels, depth = view.project(lines)
    behind = depth < NEAR
    if behind.any():
        share = (NEAR - depth[:, 0]) / np.where(behind.any(axis=1), depth[:, 1] - depth[:, 0], 1.0)
        cut = lines[:, 0] + share[:, None] * (lines[:, 1] - lines[:, 0])
        pixels = view.project(np.where(behind[..., None], cut[:, None], lines))[0]
        pixels[behind.all(axis=1)] = np.nan
    return pixels
