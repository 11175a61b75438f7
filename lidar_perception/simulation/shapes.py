"""The things in a street, as solids.

Each function returns (P, 9) float64 rows [kind, x, y, z, half x, half y, half z, pitch,
reflectance] in the object's frame: x forward, y left, z up from the ground below its origin;
metres, radians. A positive pitch turns a part about its own y axis, nose down.
"""

from __future__ import annotations

import numpy as np

from lidar_perception.simulation.raycast import BOX, CYLINDER, ELLIPSOID

RUBBER, METAL, SKIN, BARK, LEAVES, PLASTER = 0.06, 0.35, 0.4, 0.25, 0.3, 0.35


def extents(parts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(P, 3) lower and (P, 3) upper bounds of each part, exact, in the object's frame."""
    cos, sin = np.abs(np.cos(parts[:, 7])), np.abs(np.sin(parts[:, 7]))
    x, y, z = parts[:, 4:7].T
    round_ = parts[:, 0] == ELLIPSOID
    half = np.stack([np.where(round_, np.hypot(cos * x, sin * z), cos * x + sin * z), y,
                     np.where(round_, np.hypot(sin * x, cos * z), sin * x + cos * z)], axis=1)
    return parts[:, 1:4] - half, parts[:, 1:4] + half


def _limb(kind: int, joint: tuple, length: float, radius: float, swing: float,
          reflectance: float) -> tuple:
    """A part that hangs from its joint, swung forward by an angle."""
    x, y, z = joint
    return (kind, x + np.sin(swing) * length / 2, y, z - np.cos(swing) * length / 2,
            radius, radius, length / 2, -swing, reflectance)


def pedestrian(travelled: float, height: float, girth: float, phase: float, stride: float,
               coat: float, trousers: float) -> np.ndarray:
    """A walker after so many metres. stride: metres for two steps; 0 stands still.

    Proportions follow Drillis and Contini (1966); girth 1 is average. The body sinks as far as
    the legs spread, so that the lower foot is always on the ground.
    """
    h, wide = height, height * girth
    turn = phase + (2 * np.pi * travelled / stride if stride else 0.0)
    spread = 0.42 * np.sin(turn) * min(stride / 1.4, 1.0)
    parts = [
        (ELLIPSOID, 0.01 * h, 0, 0.935 * h, 0.055 * h, 0.045 * h, 0.065 * h, 0, SKIN),
        (CYLINDER, 0, 0, 0.85 * h, 0.03 * h, 0.03 * h, 0.05 * h, 0, SKIN),
        (ELLIPSOID, 0, 0, 0.70 * h, 0.07 * wide, 0.125 * wide, 0.16 * h, 0, coat),
        (ELLIPSOID, 0, 0, 0.53 * h, 0.07 * wide, 0.10 * wide, 0.11 * h, 0, trousers)]
    for side in (-1, 1):
        leg, hip = side * spread, (0, side * 0.052 * wide, 0.53 * h)
        parts.append(_limb(CYLINDER, hip, 0.49 * h, 0.042 * wide, leg, trousers))
        parts.append((BOX, np.sin(leg) * 0.49 * h + 0.03 * h, hip[1],
                      hip[2] - np.cos(leg) * 0.49 * h - 0.02 * h,
                      0.072 * h, 0.027 * h, 0.02 * h, -leg / 3, RUBBER))
        parts.append(_limb(CYLINDER, (0, side * 0.145 * wide, 0.81 * h), 0.40 * h, 0.027 * wide,
                           -0.8 * leg, coat))
    parts = np.array(parts, np.float64)
    parts[:, 3] -= extents(parts)[0][:, 2].min()
    return parts


def cyclist(travelled: float, height: float, coat: float, trousers: float) -> np.ndarray:
    """A rider on a bicycle; pedals turn once in 5 m."""
    turn, h = 2 * np.pi * travelled / 5.0, height
    parts = [(ELLIPSOID, x, 0, 0.34, 0.34, 0.025, 0.34, 0, RUBBER) for x in (-0.53, 0.53)]
    parts += [
        (BOX, 0.0, 0, 0.55, 0.5, 0.025, 0.03, 0, METAL),
        (BOX, 0.42, 0, 0.80, 0.03, 0.03, 0.25, 0.2 - np.pi, METAL),
        (BOX, 0.38, 0, 1.03, 0.03, 0.27, 0.02, 0, METAL),
        (ELLIPSOID, -0.02, 0, 0.95 + 0.16 * h, 0.12, 0.20, 0.19 * h, 0.45, coat),
        (ELLIPSOID, 0.22, 0, 0.95 + 0.37 * h, 0.10, 0.08, 0.065 * h, 0, SKIN),
        (ELLIPSOID, -0.18, 0, 0.95, 0.15, 0.17, 0.12, 0, trousers)]
    for side in (-1, 1):
        swing = 0.45 + 0.3 * np.sin(turn) * side
        parts.append(_limb(CYLINDER, (-0.15, side * 0.11, 0.92), 0.44 * h, 0.065, swing, trousers))
        parts.append(_limb(CYLINDER, (0.12, side * 0.21, 0.95 + 0.26 * h), 0.33 * h, 0.045, 0.5,
                           coat))
    return np.array(parts, np.float64)


def car(length: float, width: float, height: float, paint: float) -> np.ndarray:
    """Body, cabin set back, four wheels."""
    x, y, h = length / 2, width / 2, height
    return np.array([
        (BOX, 0, 0, 0.40 * h, x, y, 0.20 * h, 0, paint),
        (BOX, -0.12 * x, 0, 0.70 * h, 0.60 * x, 0.90 * y, 0.10 * h, 0, 0.6 * paint),
        (BOX, -0.15 * x, 0, 0.90 * h, 0.45 * x, 0.82 * y, 0.10 * h, 0, paint),
        *_wheels(0.62 * x, y, 0.32)])


def van(length: float, width: float, height: float, paint: float) -> np.ndarray:
    """A panel van: tall body, short bonnet, four wheels."""
    x, y, h = length / 2, width / 2, height
    return np.array([
        (BOX, -0.12 * x, 0, 0.56 * h, 0.88 * x, y, 0.44 * h, 0, paint),
        (BOX, 0.85 * x, 0, 0.35 * h, 0.15 * x, 0.95 * y, 0.23 * h, 0, paint),
        *_wheels(0.64 * x, y, 0.34)])


def _wheels(axle: float, side: float, radius: float) -> list[tuple]:
    return [(ELLIPSOID, x, y * (side - 0.11), radius, radius, 0.11, radius, 0, RUBBER)
            for x in (-axle, axle) for y in (-1, 1)]


def tree(rng: np.random.Generator) -> np.ndarray:
    """A trunk under three overlapping crowns, no branch below 2.4 m."""
    crowns = [(ELLIPSOID, *rng.uniform(-0.5, 0.5, 2), rng.uniform(3.9, 4.6),
               *rng.uniform(0.9, 1.4, 3), 0, LEAVES) for _ in range(3)]
    return np.array([(CYLINDER, 0, 0, 1.6, *[rng.uniform(0.1, 0.2)] * 2, 1.9, 0, BARK), *crowns])


def bush(rng: np.random.Generator) -> np.ndarray:
    """Two overlapping balls of leaves."""
    return np.array([(ELLIPSOID, x, rng.uniform(-0.1, 0.1), 0.4, *rng.uniform(0.4, 0.6, 3), 0,
                      LEAVES) for x in (-0.4, 0.4)])


def lamp() -> np.ndarray:
    """A street lamp: a pole and an arm."""
    return np.array([(CYLINDER, 0, 0, 2.8, 0.07, 0.07, 3.0, 0, METAL),
                     (BOX, 0.5, 0, 5.8, 0.55, 0.06, 0.05, 0, METAL)])


def clutter(rng: np.random.Generator) -> np.ndarray:
    """What is easily taken for a pedestrian: a post with a sign, a bin, a cabinet, a bollard."""
    grey = rng.uniform(0.15, 0.5)
    x, y, z = rng.uniform((0.2, 0.2, 0.5), (0.35, 0.35, 0.85))
    return np.array((
        [(CYLINDER, 0, 0, 1.0, 0.04, 0.04, 1.2, 0, METAL),
         (BOX, 0, 0, 1.9, 0.02, 0.3, 0.3, 0, 0.9)],
        [(CYLINDER, 0, 0, z, x, x, z, 0, grey), (ELLIPSOID, 0, 0, 2 * z, x, x, 0.15, 0, grey)],
        [(BOX, 0, 0, z, x, y, z, 0, grey)],
        [(CYLINDER, 0, 0, 0.5, 0.09, 0.09, 0.6, 0, grey)])[rng.integers(4)], np.float64)


def building(length: float, depth: float, height: float, reflectance: float) -> np.ndarray:
    """A block whose front is at y = 0, with its foot in the ground and sills that stand out."""
    sills = [(BOX, 0, 0, z, length / 2, 0.08, 0.08, 0, reflectance)
             for z in np.arange(1.0, height, 2.9)]
    return np.array([(BOX, 0, depth / 2, height / 2 - 1, length / 2, depth / 2, height / 2 + 1, 0,
                      reflectance), *sills])
