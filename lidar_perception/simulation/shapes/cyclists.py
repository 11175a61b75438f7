"""Bicycles and motorcycles, with and without riders."""

from __future__ import annotations

from functools import partial
from math import cos, pi, sin
from typing import NamedTuple

import numpy as np

from lidar_perception.classes import CLASSES, CYCLIST
from lidar_perception.simulation.shapes.people import find_knee
from lidar_perception.simulation.shapes.primitives import METAL, PLATE, RUBBER, SKIN, block, box, disc, ellipsoid, rod
from lidar_perception.simulation.shapes.scene_object import SceneObject, draw_size, make_rigid
from lidar_perception.simulation.solids import compute_extents, make_parts

BICYCLE, MOTORCYCLE, BICYCLIST, MOTORCYCLIST = 11, 15, 31, 32
CRANK_M = 0.17  # length of a crank
GEAR_M = 5.0  # distance travelled per crank revolution
SPOKE_TRANSMISSION = 0.5  # fraction of beams that pass between the spokes
FRAME_TRANSMISSION = 0.6  # fraction of beams that pass through the rear of the frame, with chain and rack
THIGH, SHANK = 0.26, 0.27  # lengths as fractions of the rider's height


class RiderBuild(NamedTuple):
    """Properties of a cyclist.

    Attributes:
        size: Length, width, height in m.
        lean: Forward tilt of the trunk, rad.
        phase: Initial angle of the cranks, rad.
        frame, coat, trousers, head: Reflectances.
        load: "", "basket", "backpack" or "box".
    """

    size: tuple[float, float, float]
    lean: float
    phase: float
    frame: float
    coat: float
    trousers: float
    head: float
    load: str = ""


def make_cyclist(rng: np.random.Generator) -> SceneObject:
    """Make a riding cyclist. The box is as long as the bicycle and as wide as the handlebar."""
    size = draw_size(rng, CLASSES[CYCLIST])
    rider = RiderBuild(
        size,
        rng.uniform(0.0, 0.7),
        rng.uniform(0, 2 * pi),
        rng.uniform(0.1, 0.8),
        rng.uniform(0.2, 0.85),
        rng.uniform(0.15, 0.75),
        rng.uniform(0.15, 0.75),
        ("", "", "basket", "backpack", "box")[rng.integers(5)],
    )
    return SceneObject(partial(pose_rider, rider=rider), size, CLASSES[CYCLIST])


def pose_rider(distance: float, rider: RiderBuild) -> np.ndarray:
    """Return the parts (P,) PART of a cyclist.

    Args:
        distance: Distance travelled in m, which determines the angle of the cranks.
        rider: Properties of the cyclist.
    """
    length, width, height = rider.size
    seat = 0.53 * height
    rider_height = (height - seat) / (0.31 * cos(rider.lean) + 0.16)
    hip = (-0.13 * length, seat)
    sin_lean, cos_lean = sin(rider.lean), cos(rider.lean)

    def point_on_trunk(fraction: float) -> tuple[float, float]:
        return hip[0] + fraction * rider_height * sin_lean, seat + fraction * rider_height * cos_lean

    shoulder, neck = point_on_trunk(0.27), point_on_trunk(0.31)
    bar_x, bar_z = 0.22 * length, 0.61 * height
    head = (neck[0] + 0.03, 0.0, height - 0.075 * rider_height)
    rows = [
        *_make_bicycle_parts(length, width / 2, (bar_x, bar_z), rider.frame),
        ellipsoid(head, (0.057 * rider_height, 0.047 * rider_height, 0.075 * rider_height), (SKIN + rider.head) / 2),
        ellipsoid(
            (point_on_trunk(0.15)[0], 0.0, point_on_trunk(0.15)[1]),
            (0.08 * rider_height, min(0.125 * rider_height, 0.42 * width), 0.17 * rider_height),
            rider.coat,
            pitch=rider.lean,
        ),
        ellipsoid((hip[0], 0.0, seat + 0.02), (0.16, min(0.17, 0.4 * width), 0.11), rider.trousers),
    ]
    crank_angle = rider.phase + 2 * pi * distance / GEAR_M
    for side, pedal_angle in ((-1, crank_angle), (1, crank_angle + pi)):
        foot = (-0.02 * length + CRANK_M * sin(pedal_angle), 0.17 * height + CRANK_M * cos(pedal_angle))
        thigh, shank = THIGH * rider_height, SHANK * rider_height
        x, z = find_knee(hip, foot, thigh, shank)
        y = side * 0.11
        rows += [
            rod((*hip[:1], y, seat), (x, y, z), 0.085, rider.trousers),
            rod((x, y, z), (foot[0], y, foot[1] + 0.03), 0.06, rider.trousers),
            box((foot[0] + 0.05, y, foot[1]), (0.13, 0.045, 0.03), RUBBER),
            rod(
                (shoulder[0], side * min(0.11 * rider_height, 0.36 * width), shoulder[1]),
                (bar_x, side * (width / 2 - 0.06), bar_z),
                0.05,
                rider.coat,
            ),
        ]
    if rider.load == "basket":
        rows.append(
            block((bar_x + 0.05, -0.16, bar_z - 0.3), (bar_x + 0.33, 0.16, bar_z - 0.05), METAL, transmission=0.4)
        )
    elif rider.load == "box":  # on the carrier
        rows.append(block((-0.47 * length, -0.2, 0.4 * height), (hip[0] - 0.2, 0.2, 0.4 * height + 0.4), 0.3))
    elif rider.load == "backpack":
        x, z = point_on_trunk(0.18)
        rows.append(
            ellipsoid((x - 0.17 * cos_lean, 0.0, z + 0.17 * sin_lean), (0.1, 0.14, 0.22), 0.2, pitch=rider.lean)
        )
    return make_parts(rows, BICYCLIST)


def _make_bicycle_parts(length: float, half_bar: float, bar: tuple, frame: float) -> list[tuple]:
    """Return the wheels, the frame, and a handlebar at `bar` (x, z) with half of the width half_bar.

    Parts are thicker than in reality, because beams are wide. In KITTI, 46 % of the points on
    cyclists are below 0.42 of their height, and 22 % also more than 0.35 m from the centre (10
    cyclists up to 40 m away).
    """
    radius = 0.19 * length
    axle, crank = length / 2 - radius, (-0.02 * length, 0.0, 0.88 * radius)
    return [
        disc((-axle, 0, radius), radius, 0.03, 0.3, transmission=SPOKE_TRANSMISSION),
        disc((axle, 0, radius), radius, 0.03, 0.3, transmission=SPOKE_TRANSMISSION),
        block(
            (-axle - 0.2, -0.06, 0.5 * radius),
            (crank[0] + 0.1, 0.06, 2 * radius + 0.1),
            frame,
            transmission=FRAME_TRANSMISSION,
        ),
        rod((axle, 0, radius), (bar[0], 0, bar[1]), 0.04, frame),
        rod(crank, (0.85 * bar[0], 0, 0.8 * bar[1]), 0.05, frame),
        rod((bar[0], -half_bar, bar[1]), (bar[0], half_bar, bar[1]), 0.018, METAL),
    ]


def make_bicycle(rng: np.random.Generator) -> np.ndarray:
    """Make a parked bicycle with a reflector, as (P,) PART."""
    length = rng.uniform(1.6, 1.85)
    seat = (-0.15 * length, 0.92)
    rows = [
        *_make_bicycle_parts(length, 0.3, (0.22 * length, 1.02), rng.uniform(0.05, 0.5)),
        ellipsoid((seat[0], 0, seat[1]), (0.13, 0.08, 0.05), RUBBER),
        block((seat[0] - 0.4, -0.04, 0.68), (seat[0] - 0.38, 0.04, 0.74), PLATE),
    ]
    return make_parts(rows, BICYCLE)


def make_motorcycle(rng: np.random.Generator) -> np.ndarray:
    """Make a parked motorcycle or scooter, as (P,) PART."""
    return make_parts(
        _make_motorcycle_parts(rng.uniform(1.8, 2.2), rng.uniform(0.05, 0.5), rng.uniform(0.25, 0.31)), MOTORCYCLE
    )


def _make_motorcycle_parts(length: float, paint: float, radius: float) -> list[tuple]:
    """Return the parts of a motorcycle with this length, reflectance (paint) and wheel radius."""
    axle = length / 2 - radius
    return [
        disc((-axle, 0, radius), radius, 0.07, RUBBER),
        disc((axle, 0, radius), radius, 0.06, RUBBER),
        ellipsoid((0, 0, 0.5), (0.45, 0.18, 0.28), paint),
        ellipsoid((-0.45, 0, 0.78), (0.4, 0.15, 0.09), RUBBER),
        ellipsoid((0.18, 0, 0.85), (0.28, 0.17, 0.14), paint),
        rod((axle, 0, radius), (axle - 0.3, 0, 1.02), 0.06, METAL),
        rod((axle - 0.3, -0.36, 1.02), (axle - 0.3, 0.36, 1.02), 0.02, METAL),
        block((-length / 2 + 0.05, -0.1, 0.55), (-length / 2 + 0.07, 0.1, 0.7), PLATE),
    ]


def make_motorcyclist(rng: np.random.Generator) -> SceneObject:
    """Make a rider on a motorcycle or scooter, labelled Cyclist. Some have a passenger."""
    length, trunk_length = rng.uniform(1.7, 2.15), rng.uniform(0.52, 0.62)
    rows = _make_motorcycle_parts(length, rng.uniform(0.05, 0.6), rng.uniform(0.2, 0.31))
    lean, bar = rng.uniform(0.05, 0.4), length / 2 - 0.55
    hips = [bar - rng.uniform(0.45, 0.6)]
    if rng.random() < 0.2:
        hips.append(hips[0] - 0.38)
    for hip in hips:
        coat, trousers, helmet = rng.uniform((0.15, 0.1, 0.1), (0.85, 0.7, 0.8))
        shoulder = (hip + sin(lean) * trunk_length, 0.82 + cos(lean) * trunk_length)
        head = (shoulder[0] + 0.04, 0.0, shoulder[1] + 0.17)
        rows += [
            ellipsoid(
                ((hip + shoulder[0]) / 2, 0.0, (0.82 + shoulder[1]) / 2),
                (0.14, 0.21, 0.6 * trunk_length),
                coat,
                pitch=lean,
            ),
            ellipsoid(head, (0.14, 0.12, 0.14), helmet),
        ]
        for side in (-1, 1):
            knee_x, foot = hip + 0.42, (hip + 0.3, side * 0.2, 0.3)
            rows += [
                rod((hip, side * 0.1, 0.82), (knee_x, side * 0.2, 0.74), 0.085, trousers),
                rod((knee_x, side * 0.2, 0.74), foot, 0.06, trousers),
                rod(
                    (shoulder[0], side * 0.19, shoulder[1] - 0.05),
                    (min(bar, shoulder[0] + 0.55), side * 0.3, 1.0),
                    0.05,
                    coat,
                ),
            ]
    parts = make_parts(rows, MOTORCYCLIST)
    _, high = compute_extents(parts)
    size = (length, 2 * float(high[:, 1].max()), float(high[:, 2].max()))
    return make_rigid(parts, size, CLASSES[CYCLIST])
