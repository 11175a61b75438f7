"""Surroundings of a road: houses, gardens, trees, bushes and street furniture."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from lidar_perception.simulation.actors import Actor, ActorSet, make_prop
from lidar_perception.simulation.places import Side, scatter, space_evenly
from lidar_perception.simulation.shapes import furniture, vegetation
from lidar_perception.simulation.shapes.buildings import make_building
from lidar_perception.simulation.solids import compute_extents
from lidar_perception.simulation.street import CORNER_WALK_M, Street, StreetKind

PLANT_CLASSES = {70, 71}  # SemanticKITTI classes of plants
BORDERS = (*[vegetation.make_hedge] * 3, *[furniture.make_fence] * 2, furniture.make_wall)
# Bushes and trees per 100 m, and the depth of their strip in m, of a forest edge, a hedgerow and fields.
WILD_FRONTS = ((110, 60, 4.0), (130, 12, 1.2), (8, 3, 15.0))
RURAL_CLUTTER = (furniture.make_sign, furniture.make_beacon, furniture.make_bollard, furniture.make_pole)


def furnish(rng: np.random.Generator, street: Street, actors: ActorSet) -> None:
    """Add all objects of a street that have no label. Plants may overlap other objects."""
    for side in (*street.blocks, *street.arms):
        for obj in FRONTS[side.front](rng, side):
            actors.admit(obj, gap=-0.8 if is_plant(obj) else 0.1)
    for side in street.blocks:
        actors.admit_each(_place_furniture(rng, side, street.kind), gap=0.3)
    actors.admit_each(_place_islands(rng, street), gap=0.3)


def is_plant(actor: Actor) -> bool:
    """Return True if an actor consists only of leaves and wood."""
    return PLANT_CLASSES.issuperset(actor.obj.parts(0.0)["semantic"].tolist())


def make_clutter(rng, rural: bool = False) -> np.ndarray:
    """Make a random roadside object of a person's size, or a bare pole, as (P,) PART."""
    choice = RURAL_CLUTTER if rural else (*furniture.PERSON_SIZED, furniture.make_pole)
    return choice[rng.integers(len(choice))](rng)


def _make_tree(rng) -> np.ndarray:
    return vegetation.make_conifer(rng) if rng.random() < 0.3 else vegetation.make_tree(rng)


def _build_facade(rng, side: Side) -> Iterator[Actor]:
    """Yield a row of houses with few gaps, bushes in front, and plants behind."""
    along, line = CORNER_WALK_M, side.walk + rng.uniform(0.1, 0.8)
    storeys = rng.integers(2, 6)
    while along < side.length - CORNER_WALK_M - 5:
        length = min(rng.uniform(8, 22), side.length - CORNER_WALK_M - along)
        house = make_building(rng, length, rng.uniform(9, 13), max(storeys + rng.integers(-1, 2), 2))
        yield side.place(house, along + length / 2, line + rng.choice([0.0, 0.0, 0.3]))
        along += length + (0.15 if rng.random() < 0.6 else rng.uniform(3, 12))
    for along in scatter(rng, side.length, 14.0):
        yield side.place(vegetation.make_bush(rng), along, line - 0.8)
    yield from _build_yard(rng, side, line + 14)


def _build_yard(rng, side: Side, line: float) -> Iterator[Actor]:
    """Yield trees and bushes behind a line."""
    for along in scatter(rng, side.length, 22):
        yield side.place(_make_tree(rng), along, line + rng.uniform(0, 30))
    for along in scatter(rng, side.length, 15):
        yield side.place(vegetation.make_bush(rng), along, line + rng.uniform(0, 25), rng.uniform(-3, 3))


def _build_garden(rng, side: Side) -> Iterator[Actor]:
    """Yield houses in gardens behind hedges, fences and walls."""
    along, line = CORNER_WALK_M, side.walk + 0.3
    border = BORDERS[rng.integers(len(BORDERS))]
    while along < side.length - CORNER_WALK_M - 9:
        lot = min(rng.uniform(11, 22), side.length - CORNER_WALK_M - along)
        drive = 3.2
        if rng.random() < 0.4:
            border = BORDERS[rng.integers(len(BORDERS))]
        if rng.random() < 0.9:
            yield side.place(border(rng, lot - drive - 0.2), along + drive + (lot - drive) / 2, line)
        back = line + rng.uniform(2.5, 8)
        house = lot - drive - rng.uniform(0.5, 3)
        yield side.place(
            make_building(rng, house, rng.uniform(8, 11), rng.integers(1, 4)), along + drive + house / 2, back
        )
        for at in scatter(rng, lot - drive, 20):
            yield side.place(_make_tree(rng), along + drive + at, rng.uniform(line + 1.2, back))
        for at in scatter(rng, lot - drive, 70):
            yield side.place(
                vegetation.make_bush(rng), along + drive + at, rng.uniform(line + 1, back), rng.uniform(-3, 3)
            )
        along += lot
    yield from _build_yard(rng, side, line + 19)


def _build_verge(rng, side: Side) -> Iterator[Actor]:
    """Yield rows of trees and bushes on grass, with buildings or hedges behind."""
    strip_depth = rng.uniform(4, 14)
    for along in space_evenly(rng, side.length, rng.uniform(7, 14)):
        yield side.place(_make_tree(rng), along, side.walk + rng.uniform(1.2, 1.8))
    shrubs, depth = (150, 0.35 * strip_depth) if rng.random() < 0.7 else (rng.uniform(2, 50), strip_depth)
    for along in scatter(rng, side.length, shrubs):
        yield side.place(
            vegetation.make_bush(rng), along, side.walk + rng.uniform(1.0, 1.0 + depth), rng.uniform(-3, 3)
        )
    along = CORNER_WALK_M
    while along < side.length - 10:
        length = min(rng.uniform(12, 35), side.length - along - 1)
        pick = rng.random()
        if pick < 0.45:
            yield side.place(
                make_building(rng, length, rng.uniform(10, 20), rng.integers(1, 6)),
                along + length / 2,
                side.walk + strip_depth + rng.uniform(0, 4),
            )
        elif pick < 0.8:
            border = BORDERS[rng.integers(len(BORDERS))]
            yield side.place(border(rng, length), along + length / 2, side.walk + strip_depth)
        along += length + rng.uniform(0.3, 12)
    yield from _build_yard(rng, side, side.walk + strip_depth + 2)


def _build_wild(rng, side: Side) -> Iterator[Actor]:
    """Yield a forest edge, a hedgerow or fields behind grass."""
    near = side.walk + rng.uniform(1.5, 4.0)
    bushes, trees, strip_depth = WILD_FRONTS[rng.choice(len(WILD_FRONTS), p=(0.4, 0.4, 0.2))]
    for along in scatter(rng, side.length, bushes):
        yield side.place(vegetation.make_bush(rng), along, near + rng.exponential(strip_depth), rng.uniform(-3, 3))
    for along in scatter(rng, side.length, trees):
        yield side.place(_make_tree(rng), along, near + 1 + rng.gamma(1.5, strip_depth))
    if rng.random() < 0.3:
        for along in np.arange(0, side.length - 12, 12.0):
            yield side.place(furniture.make_fence(rng, 11.7), along + 6, near - 0.3)
    for along in scatter(rng, side.length, 0.8):
        yield side.place(
            make_building(rng, rng.uniform(8, 20), rng.uniform(8, 14), rng.integers(1, 3)),
            along,
            near + rng.uniform(12, 40),
        )


def _build_square(rng, side: Side) -> Iterator[Actor]:
    """Yield facades behind a square with trees, planters and bollards."""
    strip_depth = rng.uniform(5, 14)
    yield from _build_facade(rng, side._replace(walk=side.walk + strip_depth))
    for along in space_evenly(rng, side.length, rng.uniform(6, 10)):
        yield side.place(_make_tree(rng), along, side.walk + strip_depth * 0.5)
    for along in scatter(rng, side.length, 8):
        yield side.place(make_clutter(rng), along, side.walk + rng.uniform(0, strip_depth), rng.uniform(-3, 3))


FRONTS = {
    "facade": _build_facade,
    "garden": _build_garden,
    "verge": _build_verge,
    "wild": _build_wild,
    "square": _build_square,
}


def _place_furniture(rng, side: Side, kind: StreetKind) -> Iterator[Actor]:
    """Yield street furniture along the curb and against the walls."""
    rural = side.walk == 0.0
    edge = 1.0 if rural else 0.2
    for along in (0.6, side.length - 0.6):  # at the corners
        if not rural and rng.random() < 0.5:
            yield side.place(furniture.make_traffic_light(rng), along, edge + 0.3, -np.pi / 2)
    for rate, make in ((kind.lamp, furniture.make_lamp), (kind.tree, _make_street_tree)):
        if rate and rng.random() < 0.8:
            for along in space_evenly(rng, side.length, 100 / rate):
                yield side.place(make(rng), along, edge + rng.uniform(0.2, 0.4), -np.pi / 2)
    for along in scatter(rng, side.length, 2.2 * kind.clutter):
        parts = make_clutter(rng, rural)
        low, high = compute_extents(parts)
        half_width = np.abs([low[:, :2], high[:, :2]]).max()  # half width that stays off the road at any rotation
        at_wall = not rural and rng.random() < 0.35
        out = side.walk - half_width if at_wall else edge + half_width + rng.uniform(0, 0.15)
        turn = rng.choice([0.0, np.pi / 2, np.pi, -np.pi / 2]) + rng.normal(0, 0.1)
        yield side.place(parts, along, max(out, 0.2 + half_width), turn)


def _place_islands(rng, street: Street) -> Iterator[Actor]:
    """Yield beacons and signs on islands between the directions at both ends of some crossings."""
    middle = (street.lanes[0].y + min(lane.y for lane in street.lanes if lane.direction < 0)) / 2
    for crossing in street.ground.crossings:
        if rng.random() >= street.kind.islands:
            continue
        for x, away in zip(crossing, (-1, 1)):
            for far in (rng.uniform(0.5, 2.0), rng.uniform(6.0, 15.0)):
                makers = furniture.make_beacon, furniture.make_beacon, furniture.make_sign
                parts = makers[rng.integers(3)](rng)
                yield Actor(make_prop(parts), x + away * far, middle, rng.choice([0.0, np.pi]))


def _make_street_tree(rng) -> np.ndarray:
    return vegetation.make_tree(rng, rng.uniform(4.0, 8.0))
