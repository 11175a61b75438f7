"""Cars and vans: a hollow body with wheels in arches, and a glazed cabin with seats."""

from __future__ import annotations

from math import copysign
from typing import NamedTuple

import numpy as np

from lidar_perception.classes import CAR as CAR_ID
from lidar_perception.classes import CLASSES
from lidar_perception.simulation.shapes.thing import (
    GLASS,
    PLATE,
    Thing,
    block,
    disc,
    draw_size,
    make_rigid,
    rod,
    slope,
    upright_pane,
)
from lidar_perception.simulation.solids import CYLINDER, ELLIPSOID, Surface, part, parts

CAR = 10
PILLAR = 0.035  # radius of a roof pillar, m
LIGHTS = 0.9  # reflectance
# Only the middle of a bumper reaches the end of the box. On KITTI's cars seen from the front,
# points of the middle third are 0.06 m behind the end of the box at 0.25 to 0.35 of the height,
# 0.2 m at 0.45, 0.33 m at 0.52 and 0.84 m at 0.62; points 0.43 of the width from the middle are
# 0.3 m further behind (medians of 25 to 38 cars up to 40 m away). Tails are upright: 0.06 m in the
# middle third up to 0.7 of the height; round at their corners: 0.15 m at 0.86 of the half width,
# 0.4 m at 0.96. Sides are 0.04 m inside the box, which may be as wide as the mirrors.
BUMPER = 0.29  # height of the foremost point, as a fraction of the vehicle's height
BONNET = 0.13  # distance from the front of the box to the middle of the bonnet's edge, m
CORNER = 0.3  # distance from the front of the box to the sides of that edge, m
TAIL = 0.07  # distance from the rear of the box to the flat part of the tail, m
TAIL_FLAT, TAIL_SIDE = 0.59, 0.95  # ends of the flat and the round part, as fractions of the half width
TAIL_ROUND = 0.45  # length of the round part, m
TAIL_LOW, TAIL_TOP = 0.22, 0.67  # ends of the closed part of the tail, as fractions of the height
SIDE = 0.035  # distance from the side of the box to the body, m
DOME = 0.09  # rise of the roof in the middle, m
MOTTLE = 0.7  # standard deviation of the log reflectance among parts of one body
LEGS = 0.5  # minimum distance from a bench to the front seats, m


class Style(NamedTuple):
    """Outline of a body from the side.

    Positions along the body are shares of its length from the tail (0) to the nose (1).

    Attributes:
        screen_low, screen_high: Windscreen at the bonnet and at the roof.
        roof_rear: Rear end of the roof.
        rear_low: Lower end of the rear window.
        bonnet, belt: Heights of the bonnet and the lower edge of the windows, as shares of the
            height.
        load: The body is closed up to the roof from the tail to here, as a panel van's.
    """

    screen_low: float
    screen_high: float
    roof_rear: float
    rear_low: float
    bonnet: float
    belt: float
    load: float = 0.0


HATCHBACK = Style(0.74, 0.55, 0.12, 0.03, 0.60, 0.63)
SEDAN = Style(0.71, 0.53, 0.27, 0.13, 0.60, 0.63)
ESTATE = Style(0.73, 0.55, 0.07, 0.03, 0.59, 0.63)
SUV = Style(0.74, 0.58, 0.06, 0.02, 0.60, 0.62)
MINIBUS = Style(0.85, 0.70, 0.03, 0.01, 0.52, 0.56)
PANEL_VAN = Style(0.85, 0.70, 0.03, 0.01, 0.52, 0.56, 0.55)


def make_car(rng: np.random.Generator, driver: bool = True) -> Thing:
    """Make a car of random size, body and paint."""
    size = draw_size(rng, CLASSES[CAR_ID])
    if size[2] > 1.62:
        style = SUV
    elif size[0] > 4.2:
        style = (SEDAN, SEDAN, ESTATE)[rng.integers(3)]
    else:
        style = (HATCHBACK, HATCHBACK, HATCHBACK, ESTATE, SEDAN)[rng.integers(5)]
    made = make_body(size, style, draw_paint(rng), rng.uniform(0.6, 0.92), driver)
    return make_rigid(_vary_reflectance(made, rng), size, CLASSES[CAR_ID])


def make_van(rng: np.random.Generator, driver: bool = True) -> Thing:
    """Make a minibus or panel van of random size and paint."""
    size = draw_size(rng, "Van")
    style = PANEL_VAN if rng.random() < 0.6 else MINIBUS
    coat = max(draw_paint(rng), draw_paint(rng))
    made = make_body(size, style, coat, rng.uniform(0.6, 0.9), driver)
    return make_rigid(_vary_reflectance(made, rng), size, "Van")


def draw_paint(rng: np.random.Generator) -> float:
    """Draw the reflectance of a coat of paint.

    Half of all points on KITTI's cars are below 0.03 and a tenth is above 0.4, since dark paint
    reflects beams away. Yet dark cars are seen at 40 m.
    """
    dark, middle, light = (0.02, 0.05), (0.04, 0.35), (0.25, 0.6)
    return float(rng.uniform(*(dark, middle, light)[rng.choice(3, p=(0.5, 0.25, 0.25))]))


def _vary_reflectance(solids: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Vary the reflectance of the parts, as on KITTI's cars.

    Nothing is drawn from rng itself, so that streets do not depend on the materials of their cars.
    """
    factor = rng.spawn(1)[0].lognormal(0.0, MOTTLE, len(solids))
    dull = solids["reflectance"] < PLATE
    solids["reflectance"][dull] = np.minimum(solids["reflectance"] * factor, 0.95)[dull]
    return solids


def make_body(
    size: tuple[float, float, float], style: Style, colour: float, glass: float, driver: bool = True
) -> np.ndarray:
    """Make a body (P,) PART.

    Below the belt are door panels, boxes over the axles and a floor with sills between the wheels.

    Args:
        size: Length, width, height in m, without the mirrors.
        style: Outline.
        colour: Reflectance.
        glass: Share of the beams that pass a pane.
        driver: A person sits in the car.
    """
    length, width, height = size
    x, y = length / 2, width / 2 - SIDE
    radius = min(0.205 * height, 0.34)
    arch, clear = 2 * radius, 0.13 * height
    axle = max(0.305 * length, x - 0.95)
    front, rear = axle - radius - 0.03, radius + 0.03 - axle
    belt, bonnet = style.belt * height, style.bonnet * height
    low, high, roof, tail = ((share - 0.5) * length for share in style[:4])
    load = (style.load - 0.5) * length if style.load else rear - radius
    deck = height if style.load else TAIL_TOP * height
    top, narrow = height - DOME, 0.86 * y if not style.load else 0.92 * y
    shell = Surface(reflectance=colour)
    pane = Surface(reflectance=GLASS, transmission=glass)
    rows = [
        block((rear, -0.98 * y, clear), (front, 0.98 * y, arch), **shell),
        *_bonnet_parts((low, bonnet), x, 0.97 * y, height, shell),
        block((TAIL - x, -TAIL_FLAT * y, TAIL_LOW * height), (load, TAIL_FLAT * y, deck - 0.02), **shell),
        block((TAIL + TAIL_ROUND - x, -TAIL_SIDE * y, clear), (load, TAIL_SIDE * y, deck - 0.02), **shell),
        *_corner_parts(TAIL - x, y, (TAIL_LOW * height, deck - 0.02), shell),
        _bumper_part(x, 0.97 * y, height, shell),
        _bumper_part(-x, 0.97 * y, height, shell),
        block((roof, -narrow, height - 0.13), (high, narrow, height - DOME), **shell),
        part(
            ELLIPSOID,
            ((roof + high) / 2, 0.0, height - DOME),
            ((high - roof) / 2, narrow, DOME),
            reflectance=0.25 * colour,
        ),
        slope((low, bonnet), (high, top), 0.9 * y, **pane),
    ]
    if style.load:
        rows.append(block((0.02 - x, -0.95 * y, belt), (0.2 - x, 0.95 * y, top), **shell))
    else:
        rows.append(slope((roof, top), (tail, deck), 0.88 * y, **pane))
    for side in (-1, 1):
        start, end = (load if style.load else (roof + tail) / 2), (low + high) / 2
        rows += [
            block((0.15 - x, side * y, arch), (low + 0.02, side * (y - 0.05), belt), **shell),
            upright_pane((start, end), (side * 0.97 * y, belt), (side * narrow, top), **pane),
            rod((low, side * 0.94 * y, bonnet), (high, side * narrow, top), PILLAR, **shell),
            disc((axle, side * (y - 0.1), radius), radius, 0.1, reflectance=0.2),
            disc((-axle, side * (y - 0.1), radius), radius, 0.1, reflectance=0.2),
            part(ELLIPSOID, (low - 0.1, side * (y + 0.08), belt + 0.05), (0.07, 0.1, 0.08), **shell),
        ]
        if not style.load:
            rows.append(
                rod(
                    (max(tail, 0.06 - x), side * 0.9 * y, belt),
                    (max(roof, 0.06 - x), side * narrow, top - 0.02),
                    0.06,
                    **shell,
                )
            )
    plate = BUMPER * height
    rows += [  # plates in front and behind; the tail lights are at its corners
        block((x - 0.05, -0.26, plate - 0.055), (x, 0.26, plate + 0.055), reflectance=PLATE),
        block((TAIL - 0.02 - x, -0.26, 0.4 * height), (TAIL - x, 0.26, 0.4 * height + 0.11), reflectance=PLATE),
        *_corner_parts(TAIL - 0.005 - x, y + 0.005, (0.38 * height, 0.44 * height), Surface(reflectance=LIGHTS)),
    ]
    rows += _seat_parts(0.5 * (low + high) - 0.75, load, 0.75 * y, arch, 0.45 * belt + 0.55 * top, driver)
    return parts(rows, CAR)


def _bumper_part(x: float, y: float, height: float, surface: Surface) -> tuple:
    """Return a bumper that reaches x in its middle, rounded from above and from the side."""
    return part(ELLIPSOID, (x - copysign(0.5, x), 0.0, BUMPER * height), (0.5, y, 0.17 * height), **surface)


def _corner_parts(x: float, y: float, heights: tuple, surface: Surface) -> list[tuple]:
    """Return the two corners of a tail at x, round from above, between two heights."""
    low, high = heights
    return [
        part(
            CYLINDER,
            (x + TAIL_ROUND, side * TAIL_FLAT * y, (low + high) / 2),
            (TAIL_ROUND, (TAIL_SIDE - TAIL_FLAT) * y, (high - low) / 2),
            **surface,
        )
        for side in (-1, 1)
    ]


def _bonnet_parts(foot: tuple, x: float, y: float, height: float, surface: Surface) -> list[tuple]:
    """Return a bonnet and its crown, from the foot (x, z) of the windscreen to the nose at x.

    Its edge has a step of 0.2 m; the crown is 0.04 of the height above the foot.
    """
    low, top = foot
    return [
        slope((x - CORNER, 0.44 * height - 0.08), (low, top - 0.08), y, 0.2, **surface),
        part(ELLIPSOID, (low, 0.0, 0.4 * height), (x - BONNET - low, y, top - 0.36 * height), **surface),
    ]


def _seat_parts(x: float, rear: float, y: float, low: float, high: float, driver: bool) -> list[tuple]:
    """Return the backs of the front seats at x, of the bench if there is room, and the driver.

    Most beams end on none of them, since returns through two panes are weak. On KITTI's cars seen
    from behind, 2 % of the points are at the bench; with these 1 to 2 %.
    """
    cloth = Surface(reflectance=0.02, transmission=0.75)
    rows = [block((x - 0.08, -y, low), (x + 0.04, y, high), **cloth)]
    if x - rear > LEGS:
        rows.append(block((rear + 0.1, -y, low), (rear + 0.25, y, high - 0.05), **cloth))
    if driver:
        rows.append(
            part(
                ELLIPSOID,
                (x + 0.18, y / 2 + 0.06, (low + high) / 2 + 0.05),
                (0.13, 0.2, (high - low) / 2 + 0.08),
                reflectance=0.05,
            )
        )
    return rows
