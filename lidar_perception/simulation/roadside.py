"""Roadsides: houses, gardens, trees, bushes and street furniture."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from lidar_perception.simulation.actors import Actor, ActorSet, make_prop
from lidar_perception.simulation.places import Side, draw_even_positions, draw_positions_along
from lidar_perception.simulation.shapes import furniture, vegetation
from lidar_perception.simulation.shapes.buildings import make_building
from lidar_perception.simulation.solids import compute_extents
from lidar_perception.simulation.street import CORNER_SIDEWALK_M, Street, StreetKind

PLANT_CLASSES = {70, 71}  # SemanticKITTI classes of plants
BORDERS = (*[vegetation.make_hedge] * 3, *[furniture.make_fence] * 2, furniture.make_wall)
ISLAND_CHANCE = 0.3  # probability that a crossing has traffic islands
# (bushes per 100 m, trees per 100 m, depth of their strip in m) for a forest edge, a hedgerow and fields.
WILD_FRONTS = ((110, 60, 4.0), (130, 12, 1.2), (8, 3, 15.0))
RURAL_CLUTTER = (furniture.make_sign, furniture.make_beacon, furniture.make_bollard, furniture.make_pole)
CLUTTER = (*furniture.PERSON_SIZED, furniture.make_pole, vegetation.make_shrub, vegetation.make_shrub)


def furnish(rng: np.random.Generator, street: Street, actors: ActorSet) -> None:
    """Add the unlabelled objects of a street. Plants may overlap other objects."""
    for side in (*street.blocks, *street.side_curbs):
        for obj in FRONTS[side.front](rng, side):
            actors.admit(obj, gap=-0.8 if is_plant(obj) else 0.1)
    for side in street.blocks:
        actors.admit_each(_place_furniture(rng, side, street.kind), gap=0.3)
    actors.admit_each(_place_islands(rng, street), gap=0.3)


def is_plant(actor: Actor) -> bool:
    """Return True if all parts of an actor are vegetation or trunks."""
    return PLANT_CLASSES.issuperset(actor.obj.parts(0.0)["semantic"].tolist())


def make_clutter(rng, is_rural: bool = False) -> np.ndarray:
    """Make a random roadside object that is as large as a person, or a pole, as (P,) PART."""
    makers = RURAL_CLUTTER if is_rural else CLUTTER
    return makers[rng.integers(len(makers))](rng)


def _make_tree(rng) -> np.ndarray:
    return vegetation.make_conifer(rng) if rng.random() < 0.3 else vegetation.make_tree(rng)


def _build_facade(rng, side: Side) -> Iterator[Actor]:
    """Yield a row of houses with few gaps, bushes in front of them, and trees behind."""
    position, offset = CORNER_SIDEWALK_M, side.sidewalk_width + rng.uniform(0.1, 0.8)
    storeys = rng.integers(2, 6)
    while position < side.length - CORNER_SIDEWALK_M - 5:
        length = min(rng.uniform(8, 22), side.length - CORNER_SIDEWALK_M - position)
        parts = make_building(rng, length, rng.uniform(9, 13), max(storeys + rng.integers(-1, 2), 2))
        yield side.place(parts, position + length / 2, offset + rng.choice([0.0, 0.0, 0.3]))
        position += length + (0.15 if rng.random() < 0.6 else rng.uniform(3, 12))
    for position in draw_positions_along(rng, side.length, 14.0):
        yield side.place(vegetation.make_bush(rng), position, offset - 0.8)
    yield from _build_yard(rng, side, offset + 14)


def _build_yard(rng, side: Side, offset: float) -> Iterator[Actor]:
    """Yield trees and bushes beyond an offset from the side."""
    for position in draw_positions_along(rng, side.length, 22):
        yield side.place(_make_tree(rng), position, offset + rng.uniform(0, 30))
    for position in draw_positions_along(rng, side.length, 15):
        yield side.place(vegetation.make_bush(rng), position, offset + rng.uniform(0, 25), rng.uniform(-3, 3))


def _build_garden(rng, side: Side) -> Iterator[Actor]:
    """Yield houses in gardens behind hedges, fences and walls."""
    position, offset = CORNER_SIDEWALK_M, side.sidewalk_width + 0.3
    border = BORDERS[rng.integers(len(BORDERS))]
    while position < side.length - CORNER_SIDEWALK_M - 9:
        lot = min(rng.uniform(11, 22), side.length - CORNER_SIDEWALK_M - position)
        driveway = 3.2
        if rng.random() < 0.4:
            border = BORDERS[rng.integers(len(BORDERS))]
        if rng.random() < 0.9:
            yield side.place(border(rng, lot - driveway - 0.2), position + driveway + (lot - driveway) / 2, offset)
        house_offset = offset + rng.uniform(2.5, 8)
        house_length = lot - driveway - rng.uniform(0.5, 3)
        yield side.place(
            make_building(rng, house_length, rng.uniform(8, 11), rng.integers(1, 4)),
            position + driveway + house_length / 2,
            house_offset,
        )
        for lot_position in draw_positions_along(rng, lot - driveway, 20):
            yield side.place(
                _make_tree(rng), position + driveway + lot_position, rng.uniform(offset + 1.2, house_offset)
            )
        for lot_position in draw_positions_along(rng, lot - driveway, 70):
            yield side.place(
                vegetation.make_bush(rng),
                position + driveway + lot_position,
                rng.uniform(offset + 1, house_offset),
                rng.uniform(-3, 3),
            )
        position += lot
    yield from _build_yard(rng, side, offset + 19)


def _build_verge(rng, side: Side) -> Iterator[Actor]:
    """Yield rows of trees and bushes on grass, with buildings or hedges behind."""
    strip_depth = rng.uniform(4, 14)
    for position in draw_even_positions(rng, side.length, rng.uniform(7, 14)):
        yield side.place(_make_tree(rng), position, side.sidewalk_width + rng.uniform(1.2, 1.8))
    shrubs, depth = (150, 0.35 * strip_depth) if rng.random() < 0.7 else (rng.uniform(2, 50), strip_depth)
    for position in draw_positions_along(rng, side.length, shrubs):
        yield side.place(
            vegetation.make_bush(rng), position, side.sidewalk_width + rng.uniform(1.0, 1.0 + depth), rng.uniform(-3, 3)
        )
    position = CORNER_SIDEWALK_M
    while position < side.length - 10:
        length = min(rng.uniform(12, 35), side.length - position - 1)
        pick = rng.random()
        if pick < 0.45:
            yield side.place(
                make_building(rng, length, rng.uniform(10, 20), rng.integers(1, 6)),
                position + length / 2,
                side.sidewalk_width + strip_depth + rng.uniform(0, 4),
            )
        elif pick < 0.8:
            border = BORDERS[rng.integers(len(BORDERS))]
            yield side.place(border(rng, length), position + length / 2, side.sidewalk_width + strip_depth)
        position += length + rng.uniform(0.3, 12)
    yield from _build_yard(rng, side, side.sidewalk_width + strip_depth + 2)


def _build_wild(rng, side: Side) -> Iterator[Actor]:
    """Yield a forest edge, a hedgerow or fields behind grass."""
    strip_offset = side.sidewalk_width + rng.uniform(1.5, 4.0)
    bushes, trees, strip_depth = WILD_FRONTS[rng.choice(len(WILD_FRONTS), p=(0.4, 0.4, 0.2))]
    for position in draw_positions_along(rng, side.length, bushes):
        yield side.place(
            vegetation.make_bush(rng), position, strip_offset + rng.exponential(strip_depth), rng.uniform(-3, 3)
        )
    for position in draw_positions_along(rng, side.length, trees):
        yield side.place(_make_tree(rng), position, strip_offset + 1 + rng.gamma(1.5, strip_depth))
    if rng.random() < 0.3:
        for position in np.arange(0, side.length - 12, 12.0):
            yield side.place(furniture.make_fence(rng, 11.7), position + 6, strip_offset - 0.3)
    for position in draw_positions_along(rng, side.length, 0.8):
        yield side.place(
            make_building(rng, rng.uniform(8, 20), rng.uniform(8, 14), rng.integers(1, 3)),
            position,
            strip_offset + rng.uniform(12, 40),
        )


def _build_square(rng, side: Side) -> Iterator[Actor]:
    """Yield a square with trees and clutter, and facades behind it."""
    strip_depth = rng.uniform(5, 14)
    yield from _build_facade(rng, side._replace(sidewalk_width=side.sidewalk_width + strip_depth))
    for position in draw_even_positions(rng, side.length, rng.uniform(6, 10)):
        yield side.place(_make_tree(rng), position, side.sidewalk_width + strip_depth * 0.5)
    for position in draw_positions_along(rng, side.length, 8):
        yield side.place(
            make_clutter(rng), position, side.sidewalk_width + rng.uniform(0, strip_depth), rng.uniform(-3, 3)
        )


FRONTS = {
    "facade": _build_facade,
    "garden": _build_garden,
    "verge": _build_verge,
    "wild": _build_wild,
    "square": _build_square,
}


def _place_furniture(rng, side: Side, kind: StreetKind) -> Iterator[Actor]:
    """Yield street furniture along the curb and against the walls."""
    is_rural = side.sidewalk_width == 0.0
    edge_offset = 1.0 if is_rural else 0.2
    for position in (0.6, side.length - 0.6):  # near both corners
        if not is_rural and rng.random() < 0.5:
            yield side.place(furniture.make_traffic_light(rng), position, edge_offset + 0.3, -np.pi / 2)
    for rate, make in ((kind.lamps, furniture.make_lamp), (kind.trees, _make_street_tree)):
        if rate and rng.random() < 0.8:
            for position in draw_even_positions(rng, side.length, 100 / rate):
                yield side.place(make(rng), position, edge_offset + rng.uniform(0.2, 0.4), -np.pi / 2)
    for position in draw_positions_along(rng, side.length, 2.2 * kind.clutter):
        parts = make_clutter(rng, is_rural)
        low, high = compute_extents(parts)
        half_width = np.abs([low[:, :2], high[:, :2]]).max()  # large enough for any rotation
        at_wall = not is_rural and rng.random() < 0.35
        offset = side.sidewalk_width - half_width if at_wall else edge_offset + half_width + rng.uniform(0, 0.15)
        heading = rng.choice([0.0, np.pi / 2, np.pi, -np.pi / 2]) + rng.normal(0, 0.1)
        yield side.place(parts, position, max(offset, 0.2 + half_width), heading)


def _place_islands(rng, street: Street) -> Iterator[Actor]:
    """Yield beacons and signs on traffic islands in the middle of the road, next to some crossings."""
    centre_y = (street.lanes[0].y + min(lane.y for lane in street.lanes if lane.direction < 0)) / 2
    for crossing in street.ground.crossings:
        if rng.random() >= ISLAND_CHANCE:
            continue
        for x, direction in zip(crossing, (-1, 1)):
            for distance in (rng.uniform(0.5, 2.0), rng.uniform(6.0, 15.0)):
                makers = furniture.make_beacon, furniture.make_beacon, furniture.make_sign
                parts = makers[rng.integers(3)](rng)
                yield Actor(make_prop(parts), x + direction * distance, centre_y, rng.choice([0.0, np.pi]))


def _make_street_tree(rng) -> np.ndarray:
    return vegetation.make_tree(rng, rng.uniform(4.0, 8.0))
