"""Cars and vans: a hollow body with wheels in arches, and a glazed cabin with seats."""

from __future__ import annotations

from math import copysign
from typing import NamedTuple

import numpy as np

from lidar_perception.classes import CAR as CAR_ID
from lidar_perception.classes import CLASSES
from lidar_perception.simulation.shapes.primitives import (
    GLASS,
    PLATE,
    block,
    cylinder,
    disc,
    ellipsoid,
    rod,
    slope,
    upright_pane,
)
from lidar_perception.simulation.shapes.scene_object import SceneObject, draw_size, make_rigid
from lidar_perception.simulation.solids import make_parts

CAR = 10
PILLAR_RADIUS_M = 0.035
TAIL_LIGHT_REFLECTANCE = 0.9
# Distance of the surface from the box on KITTI's cars (medians of 25 to 38 cars up to 40 m away). Boxes may
# include the mirrors.
#   surface                  height / box height    distance in m
#   front, middle third      0.25 to 0.35           0.06
#                            0.45                   0.2
#                            0.52                   0.33
#                            0.62                   0.84
#   front, 0.43 of the width from the middle        0.3 more
#   tail, middle third       up to 0.7              0.06
#   tail, at 0.86 of the half width                 0.15
#   tail, at 0.96 of the half width                 0.4
#   sides                                           0.04
BUMPER = 0.29  # height of the foremost point, as a fraction of the height
BONNET_GAP_M = 0.13  # distance from the front of the box to the middle of the bonnet's front edge
CORNER_GAP_M = 0.3  # distance from the front of the box to the ends of the bonnet's front edge
TAIL_GAP_M = 0.07  # distance from the rear of the box to the flat part of the tail
# Outer ends of the flat and the rounded part of the tail, as fractions of the half width.
TAIL_FLAT, TAIL_SIDE = 0.59, 0.95
TAIL_ROUND_M = 0.45  # length of the rounded part of the tail
TAIL_LOW, TAIL_TOP = 0.22, 0.67  # lower and upper end of the closed part of the tail, as fractions of the height
SIDE_GAP_M = 0.035  # distance from the side of the box to the body
ROOF_RISE_M = 0.09  # height of the middle of the roof above its edges
REFLECTANCE_SPREAD = 0.7  # standard deviation of the log reflectance of the parts of a car
LEG_ROOM_M = 0.5  # minimum distance from a bench to the front seats


class Style(NamedTuple):
    """Side view of a car body.

    Positions are fractions of the length from the tail (0) to the nose (1).

    Attributes:
        screen_low, screen_high: Lower and upper end of the windscreen.
        roof_rear: Rear end of the roof.
        rear_low: Lower end of the rear window.
        bonnet, belt: Heights of the bonnet and of the lower edge of the windows, as fractions of
            the height.
        load: Front end of the closed load area of a panel van, or of the bed of a pick-up, 0 for none.
        bed: Height of the floor of the bed of a pick-up as a fraction of the height, 0 for other bodies.
    """

    screen_low: float
    screen_high: float
    roof_rear: float
    rear_low: float
    bonnet: float
    belt: float
    load: float = 0.0
    bed: float = 0.0


HATCHBACK = Style(0.74, 0.55, 0.12, 0.03, 0.60, 0.63)
SEDAN = Style(0.71, 0.53, 0.27, 0.13, 0.60, 0.63)
ESTATE = Style(0.73, 0.55, 0.07, 0.03, 0.59, 0.63)
SUV = Style(0.74, 0.58, 0.06, 0.02, 0.60, 0.62)
MINIBUS = Style(0.85, 0.70, 0.03, 0.01, 0.52, 0.56)
PANEL_VAN = Style(0.85, 0.70, 0.03, 0.01, 0.52, 0.56, 0.55)
PICK_UP = Style(0.72, 0.60, 0.40, 0.38, 0.58, 0.60, 0.38, 0.40)
# Limits of length, width and height in m of large cars and of pick-ups.
LARGE_SIZE = (4.6, 1.78, 1.42), (5.4, 2.0, 1.9)
PICK_UP_SIZE = (5.0, 1.8, 1.7), (5.9, 2.05, 1.98)
LARGE_RATIO, PICK_UP_RATIO = 0.06, 0.06  # fractions of cars; not taken from data


def make_car(rng: np.random.Generator, driver: bool = True) -> SceneObject:
    """Make a car of random size, body and paint."""
    size, pick = draw_size(rng, CLASSES[CAR_ID]), rng.random()
    if pick < LARGE_RATIO + PICK_UP_RATIO:
        length, width, height = rng.uniform(*(PICK_UP_SIZE if pick < PICK_UP_RATIO else LARGE_SIZE))
        size = float(length), float(width), float(height)
    if pick < PICK_UP_RATIO:
        style = PICK_UP
    elif size[2] > 1.62:
        style = SUV
    elif size[0] > 4.2:
        style = (SEDAN, SEDAN, ESTATE)[rng.integers(3)]
    else:
        style = (HATCHBACK, HATCHBACK, HATCHBACK, ESTATE, SEDAN)[rng.integers(5)]
    parts = make_body(size, style, draw_paint(rng), rng.uniform(0.6, 0.92), driver)
    return make_rigid(_vary_reflectance(parts, rng), size, CLASSES[CAR_ID])


def make_van(rng: np.random.Generator, driver: bool = True) -> SceneObject:
    """Make a minibus or panel van of random size and paint."""
    size = draw_size(rng, "Van")
    style = PANEL_VAN if rng.random() < 0.6 else MINIBUS
    coat = max(draw_paint(rng), draw_paint(rng))
    parts = make_body(size, style, coat, rng.uniform(0.6, 0.9), driver)
    return make_rigid(_vary_reflectance(parts, rng), size, "Van")


def draw_paint(rng: np.random.Generator) -> float:
    """Draw the reflectance of a car's paint.

    In KITTI, half of the points on cars have an intensity below 0.03, and a tenth above 0.4. Dark
    cars have returns up to at least 40 m.
    """
    dark, middle, light = (0.02, 0.05), (0.04, 0.35), (0.25, 0.6)
    return float(rng.uniform(*(dark, middle, light)[rng.choice(3, p=(0.5, 0.25, 0.25))]))


def _vary_reflectance(solids: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Vary the reflectance between parts (P,) PART, in place, as on KITTI's cars.

    The numbers come from a child of rng, so that they do not change the layout of a street.
    """
    factor = rng.spawn(1)[0].lognormal(0.0, REFLECTANCE_SPREAD, len(solids))
    is_dull = solids["reflectance"] < PLATE
    solids["reflectance"][is_dull] = np.minimum(solids["reflectance"] * factor, 0.95)[is_dull]
    return solids


def make_body(
    size: tuple[float, float, float], style: Style, colour: float, glass: float, driver: bool = True
) -> np.ndarray:
    """Make a car body with wheels, windows and seats, as (P,) PART.

    Args:
        size: Length, width, height in m, without the mirrors.
        style: Side view of the body.
        colour: Reflectance of the paint.
        glass: Fraction of the beams that pass through a window.
        driver: True if a person sits in the car.
    """
    length, width, height = size
    x, y = length / 2, width / 2 - SIDE_GAP_M
    radius = min(0.205 * height, 0.34)
    arch, clearance = 2 * radius, 0.13 * height
    axle = max(0.305 * length, x - 0.95)
    front, rear = axle - radius - 0.03, radius + 0.03 - axle
    belt, bonnet = style.belt * height, style.bonnet * height
    screen_low_x, screen_high_x, roof_rear_x, rear_low_x = ((fraction - 0.5) * length for fraction in style[:4])
    load = (style.load - 0.5) * length if style.load else rear - radius
    deck = style.bed * height if style.bed else height if style.load else TAIL_TOP * height
    is_van = style.load and not style.bed
    top, roof_half_width = height - ROOF_RISE_M, 0.92 * y if is_van else 0.86 * y
    rows = [
        block((rear, -0.98 * y, clearance), (front, 0.98 * y, arch), colour),
        *_make_bonnet_parts((screen_low_x, bonnet), x, 0.97 * y, height, colour),
        block((TAIL_GAP_M - x, -TAIL_FLAT * y, TAIL_LOW * height), (load, TAIL_FLAT * y, deck - 0.02), colour),
        block((TAIL_GAP_M + TAIL_ROUND_M - x, -TAIL_SIDE * y, clearance), (load, TAIL_SIDE * y, deck - 0.02), colour),
        *_make_corner_parts(TAIL_GAP_M - x, y, (TAIL_LOW * height, deck - 0.02), colour),
        _make_bumper_part(x, 0.97 * y, height, colour),
        _make_bumper_part(-x, 0.97 * y, height, colour),
        block(
            (roof_rear_x, -roof_half_width, height - 0.13),
            (screen_high_x, roof_half_width, height - ROOF_RISE_M),
            colour,
        ),
        ellipsoid(
            ((roof_rear_x + screen_high_x) / 2, 0.0, height - ROOF_RISE_M),
            ((screen_high_x - roof_rear_x) / 2, roof_half_width, ROOF_RISE_M),
            0.25 * colour,
        ),
        slope((screen_low_x, bonnet), (screen_high_x, top), 0.9 * y, GLASS, transmission=glass),
    ]
    if is_van:
        rows.append(block((0.02 - x, -0.95 * y, belt), (0.2 - x, 0.95 * y, top), colour))
    else:
        window_foot = belt if style.bed else deck
        rows.append(slope((roof_rear_x, top), (rear_low_x, window_foot), 0.88 * y, GLASS, transmission=glass))
    if style.bed:  # the tailgate and the rear wall of the cab
        rows += [
            block((wall_x, -0.93 * y, deck - 0.1), (wall_x + 0.08, 0.93 * y, belt), colour)
            for wall_x in (TAIL_GAP_M - x, rear_low_x)
        ]
    for side in (-1, 1):
        start, end = (load if is_van else (roof_rear_x + rear_low_x) / 2), (screen_low_x + screen_high_x) / 2
        rows += [
            block((0.15 - x, side * y, arch), (screen_low_x + 0.02, side * (y - 0.05), belt), colour),
            upright_pane(
                (start, end), (side * 0.97 * y, belt), (side * roof_half_width, top), GLASS, transmission=glass
            ),
            rod(
                (screen_low_x, side * 0.94 * y, bonnet),
                (screen_high_x, side * roof_half_width, top),
                PILLAR_RADIUS_M,
                colour,
            ),
            disc((axle, side * (y - 0.1), radius), radius, 0.1, 0.2),
            disc((-axle, side * (y - 0.1), radius), radius, 0.1, 0.2),
            ellipsoid((screen_low_x - 0.1, side * (y + 0.08), belt + 0.05), (0.07, 0.1, 0.08), colour),
        ]
        if not is_van:
            rows.append(
                rod(
                    (max(rear_low_x, 0.06 - x), side * 0.9 * y, belt),
                    (max(roof_rear_x, 0.06 - x), side * roof_half_width, top - 0.02),
                    0.06,
                    colour,
                )
            )
    plate_height = BUMPER * height
    rows += [  # front and rear plates, and tail lights
        block((x - 0.05, -0.26, plate_height - 0.055), (x, 0.26, plate_height + 0.055), PLATE),
        block((TAIL_GAP_M - 0.02 - x, -0.26, 0.4 * height), (TAIL_GAP_M - x, 0.26, 0.4 * height + 0.11), PLATE),
        *_make_corner_parts(TAIL_GAP_M - 0.005 - x, y + 0.005, (0.38 * height, 0.44 * height), TAIL_LIGHT_REFLECTANCE),
    ]
    rows += _make_seat_parts(
        0.5 * (screen_low_x + screen_high_x) - 0.75, load, 0.75 * y, arch, 0.45 * belt + 0.55 * top, driver
    )
    return make_parts(rows, CAR)


def _make_bumper_part(x: float, y: float, height: float, colour: float) -> tuple:
    """Return a bumper with a rounded outline that extends to x in its middle."""
    return ellipsoid((x - copysign(0.5, x), 0.0, BUMPER * height), (0.5, y, 0.17 * height), colour)


def _make_corner_parts(x: float, y: float, heights: tuple, colour: float) -> list[tuple]:
    """Return the two rounded corners of a tail at x, between the lower and upper end `heights`."""
    low, high = heights
    return [
        cylinder(
            (x + TAIL_ROUND_M, side * TAIL_FLAT * y, (low + high) / 2),
            (TAIL_ROUND_M, (TAIL_SIDE - TAIL_FLAT) * y, (high - low) / 2),
            colour,
        )
        for side in (-1, 1)
    ]


def _make_bonnet_parts(windscreen_foot: tuple, x: float, y: float, height: float, colour: float) -> list[tuple]:
    """Return a bonnet and its domed top, from the foot (x, z) of the windscreen to the nose at x."""
    low, top = windscreen_foot
    return [
        slope((x - CORNER_GAP_M, 0.44 * height - 0.08), (low, top - 0.08), y, colour, thickness=0.2),
        ellipsoid((low, 0.0, 0.4 * height), (x - BONNET_GAP_M - low, y, top - 0.36 * height), colour),
    ]


def _make_seat_parts(x: float, rear: float, y: float, low: float, high: float, driver: bool) -> list[tuple]:
    """Return the backrests of the front seats at x and of a rear bench, if there is room, and the driver.

    Backrests are mostly transparent, because returns through two panes are weak: in KITTI, 2 % of the
    points on cars seen from behind are on the bench, here 1 to 2 %.
    """
    rows = [block((x - 0.08, -y, low), (x + 0.04, y, high), 0.02, transmission=0.75)]
    if x - rear > LEG_ROOM_M:
        rows.append(block((rear + 0.1, -y, low), (rear + 0.25, y, high - 0.05), 0.02, transmission=0.75))
    if driver:
        rows.append(
            ellipsoid((x + 0.18, y / 2 + 0.06, (low + high) / 2 + 0.05), (0.13, 0.2, (high - low) / 2 + 0.08), 0.05)
        )
    return rows
