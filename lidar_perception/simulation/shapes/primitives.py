"""Primitives of scene objects: rows of PART for boxes, ellipsoids, cylinders and thin boards.

Positions are (x, y, z) in metres. `surface` is passed on to solids.make_part_row.
"""

from __future__ import annotations

from math import atan2, hypot, pi

from lidar_perception.simulation.solids import BOX, CYLINDER, ELLIPSOID, RETROREFLECTOR, make_part_row

RUBBER, METAL, SKIN, GLASS, PLATE = 0.06, 0.3, 0.4, 0.04, RETROREFLECTOR  # reflectances
PANE_THICKNESS_M = 0.01


def box(centre: tuple, half_size: tuple, reflectance: float, **surface) -> tuple:
    """Return a box with these half sizes along its axes."""
    return make_part_row(BOX, centre, half_size, reflectance, **surface)


def ellipsoid(centre: tuple, half_size: tuple, reflectance: float, **surface) -> tuple:
    """Return an ellipsoid with these half axes."""
    return make_part_row(ELLIPSOID, centre, half_size, reflectance, **surface)


def cylinder(centre: tuple, half_size: tuple, reflectance: float, **surface) -> tuple:
    """Return a cylinder along z. Its half sizes are two half axes and half of its height."""
    return make_part_row(CYLINDER, centre, half_size, reflectance, **surface)


def block(corner: tuple, opposite: tuple, reflectance: float, **surface) -> tuple:
    """Return an upright box between two opposite corners."""
    (a, b, c), (x, y, z) = corner, opposite
    half_size = (abs(x - a) / 2, abs(y - b) / 2, abs(z - c) / 2)
    return box(_compute_midpoint(corner, opposite), half_size, reflectance, **surface)


def rod(start: tuple, end: tuple, radius: float, reflectance: float, **surface) -> tuple:
    """Return a cylinder with its axis from start to end."""
    x, y, z = end[0] - start[0], end[1] - start[1], end[2] - start[2]
    horizontal = hypot(x, y)
    half_size, yaw, pitch = (radius, radius, hypot(horizontal, z) / 2), atan2(y, x), atan2(horizontal, z)
    return cylinder(_compute_midpoint(start, end), half_size, reflectance, yaw=yaw, pitch=pitch, **surface)


def disc(centre: tuple, radius: float, half_width: float, reflectance: float, **surface) -> tuple:
    """Return a cylinder along y, such as a wheel."""
    return cylinder(centre, (radius, radius, half_width), reflectance, pitch=pi / 2, yaw=pi / 2, **surface)


def slope(
    front: tuple, back: tuple, half_width: float, reflectance: float, thickness: float = PANE_THICKNESS_M, **surface
) -> tuple:
    """Return a thin board across y from front (x, z) to back (x, z), such as a windscreen."""
    (x0, z0), (x1, z1) = front, back
    half_size = (hypot(x0 - x1, z0 - z1) / 2, half_width, thickness / 2)
    return box(((x0 + x1) / 2, 0.0, (z0 + z1) / 2), half_size, reflectance, pitch=atan2(z1 - z0, x0 - x1), **surface)


def upright_pane(x: tuple, low: tuple, high: tuple, reflectance: float, **surface) -> tuple:
    """Return a thin board along x, such as a side window.

    Args:
        x: Rear and front end.
        low, high: Lower and upper edge, (y, z) each.
    """
    (y0, z0), (y1, z1) = low, high
    centre = ((x[0] + x[1]) / 2, (y0 + y1) / 2, (z0 + z1) / 2)
    half_size = (PANE_THICKNESS_M / 2, (x[1] - x[0]) / 2, hypot(y1 - y0, z1 - z0) / 2)
    return box(centre, half_size, reflectance, yaw=pi / 2, pitch=atan2(y1 - y0, z1 - z0), **surface)


def _compute_midpoint(start: tuple, end: tuple) -> tuple:
    return (start[0] + end[0]) / 2, (start[1] + end[1]) / 2, (start[2] + end[2]) / 2
