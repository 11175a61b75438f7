"""Trees, bushes and hedges with partly transparent foliage."""

from __future__ import annotations

from math import cos, pi, sin

import numpy as np

from lidar_perception.simulation.shapes.primitives import box, ellipsoid, rod
from lidar_perception.simulation.solids import make_parts

VEGETATION, TRUNK = 70, 71
BARK, LEAVES = 0.31, 0.34  # reflectances: medians of trunks and vegetation in a scan of SemanticKITTI


def make_tree(rng: np.random.Generator, height: float | None = None) -> np.ndarray:
    """Make a broad-leaved tree as (P,) PART: trunk, boughs, a crown, and three smaller ellipsoids of leaves.

    The lowest third has no leaves. The trunk begins 0.3 m below the ground.

    Args:
        height: Height in m; None draws one.
    """
    height = rng.uniform(4.0, 11.0) if height is None else height
    fork, radius = height * rng.uniform(0.33, 0.42), height * rng.uniform(0.016, 0.026)
    top = (*rng.uniform(-0.03, 0.03, 2) * height, 0.75 * height)
    rows = [
        rod((0, 0, -0.3), (0, 0, fork), radius, BARK, semantic=TRUNK),
        rod((0, 0, fork), top, 0.6 * radius, BARK, semantic=TRUNK),
    ]
    bough_angle, spread = rng.uniform(0, 2 * np.pi), height * rng.uniform(0.1, 0.2)
    for angle in (bough_angle, bough_angle + pi):
        end = (spread * cos(angle), spread * sin(angle), 0.62 * height)
        rows.append(rod((0, 0, fork), end, 0.4 * radius, BARK, semantic=TRUNK))
    crown_radius, crown_height = height * rng.uniform(0.2, 0.3), height - fork
    leaves = [
        _draw_foliage(
            rng, (0, 0, fork + 0.55 * crown_height), (crown_radius, crown_radius, 0.45 * crown_height), (0.4, 1.0)
        )
    ]
    for i, (a, b, c, z, *rest) in enumerate(rng.random((3, 7)).tolist()):
        angle = bough_angle + 1.0 + 2.1 * i
        centre = (
            0.7 * crown_radius * cos(angle),
            0.7 * crown_radius * sin(angle),
            fork + crown_height * _interpolate(z, 0.25, 0.7),
        )
        half_size = (
            height * _interpolate(a, 0.12, 0.2),
            height * _interpolate(b, 0.12, 0.2),
            height * _interpolate(c, 0.1, 0.16),
        )
        leaves.append(_make_foliage(rest, centre, half_size, (0.6, 2.0)))
    return make_parts(rows + leaves, VEGETATION)


def make_conifer(rng: np.random.Generator) -> np.ndarray:
    """Make a conifer as (P,) PART, with boughs down to the ground."""
    height = rng.uniform(2.5, 9.0)
    stem = rod((0, 0, -0.3), (0, 0, 0.8 * height), 0.015 * height, BARK, semantic=TRUNK)
    half_height = 0.2 * height
    rows = [
        _draw_foliage(
            rng, (0, 0, max(z * height, half_height + 0.1)), (r * height, r * height, half_height), (1.0, 2.0)
        )
        for z, r in ((0.2, 0.2), (0.4, 0.16), (0.6, 0.11), (0.8, 0.06))
    ]
    return make_parts([stem, *rows], VEGETATION)


def make_bush(rng: np.random.Generator) -> np.ndarray:
    """Make a bush, 0.6 to 2 m high, as (P,) PART: three overlapping ellipsoids of leaves."""
    half_height = rng.uniform(0.3, 1.0)
    rows = []
    for x, y, a, b, c, *rest in rng.random((3, 8)).tolist():
        half_size = (
            half_height * _interpolate(a, 0.6, 1.1),
            half_height * _interpolate(b, 0.6, 1.1),
            half_height * _interpolate(c, 0.8, 1.2),
        )
        rows.append(
            _make_foliage(
                rest, ((x - 0.5) * half_height, (y - 0.5) * half_height, 0.8 * half_height), half_size, (1.5, 5.0)
            )
        )
    return make_parts(rows, VEGETATION)


def make_shrub(rng: np.random.Generator) -> np.ndarray:
    """Make a clipped shrub or a short hedge as large as a person, as (P,) PART."""
    x, y, height = rng.uniform((0.2, 0.2, 0.8), (0.8, 0.4, 2.0))
    half_size, density = (x, y, height / 2 + 0.1), rng.uniform(4.0, 10.0)
    make = box if rng.random() < 0.4 else ellipsoid
    return make_parts([make((0, 0, height / 2 - 0.1), half_size, LEAVES, density=density)], VEGETATION)


def make_hedge(rng: np.random.Generator, length: float) -> np.ndarray:
    """Make a hedge as (P,) PART, centred along x, with an uneven top. It begins 0.3 m below the ground."""
    height, half_width = rng.uniform(0.8, 2.0), rng.uniform(0.25, 0.5)
    rows = [
        box((0, 0, height / 2 - 0.15), (length / 2, half_width, height / 2 + 0.15), LEAVES, density=rng.uniform(4, 10))
    ]
    rows += [
        _draw_foliage(rng, (x, 0, height), (length / 8, 1.1 * half_width, rng.uniform(0.08, 0.2)), (2, 6))
        for x in np.linspace(-0.38, 0.38, 4) * length
    ]
    return make_parts(rows, VEGETATION)


def _draw_foliage(rng: np.random.Generator, centre: tuple, half_size: tuple, density: tuple) -> tuple:
    return _make_foliage(rng.random(3).tolist(), centre, half_size, density)


def _make_foliage(samples: list[float], centre: tuple, half_size: tuple, density: tuple) -> tuple:
    """Return an ellipsoid of leaves from samples of U(0, 1) for its yaw, reflectance and density."""
    yaw, tone, leafiness = samples
    return ellipsoid(
        centre,
        half_size,
        LEAVES * _interpolate(tone, 0.8, 1.25),
        yaw=yaw * pi,
        density=_interpolate(leafiness, *density),
    )


def _interpolate(fraction: float, low: float, high: float) -> float:
    """Return low + fraction * (high - low). Faster than rng.uniform for numbers that are drawn together."""
    return low + (high - low) * fraction
