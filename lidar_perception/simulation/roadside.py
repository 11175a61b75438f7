"""What stands beside a road: houses, gardens, trees, bushes and street furniture."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from lidar_perception.simulation.actors import Actor, Room, prop
from lidar_perception.simulation.places import Side, evenly_spaced, scattered
from lidar_perception.simulation.shapes import furniture, vegetation
from lidar_perception.simulation.shapes.buildings import building
from lidar_perception.simulation.solids import extents
from lidar_perception.simulation.street import CORNER, Kind, Street

PLANTS = {70, 71}  # of SemanticKITTI
BORDERS = (*[vegetation.hedge] * 3, *[furniture.fence] * 2, furniture.wall)
# Of bushes and trees on 100 m, and how deep they stand, m: a wood, a hedgerow, fields.
WILDS = ((110, 60, 4.0), (130, 12, 1.2), (8, 3, 15.0))
ROADSIDE = (furniture.sign, furniture.beacon, furniture.bollard, furniture.pole)  # of the country


def furnish(rng: np.random.Generator, street: Street, room: Room) -> None:
    """Everything that never moves and has no label. Plants may grow into what stands there."""
    for side in (*street.blocks, *street.arms):
        for thing in FRONTS[side.front](rng, side):
            room.admit(thing, gap=-0.8 if is_plant(thing) else 0.1)
    for side in street.blocks:
        for thing in _furniture(rng, side, street.kind):
            room.admit(thing, gap=0.3)
    for thing in _islands(rng, street):
        room.admit(thing, gap=0.3)


def is_plant(actor: Actor) -> bool:
    """Whether an actor is nothing but leaves and wood."""
    return PLANTS.issuperset(actor.thing.parts(0.0)["semantic"].tolist())


def clutter(rng, rural: bool = False) -> np.ndarray:
    """One of the many things beside a road that have the size of a person, or a bare pole."""
    choice = ROADSIDE if rural else (*furniture.PERSON_SIZED, furniture.pole)
    return choice[rng.integers(len(choice))](rng)


def _tree(rng) -> np.ndarray:
    return vegetation.conifer(rng) if rng.random() < 0.3 else vegetation.tree(rng)


def _facade(rng, side: Side) -> Iterator[Actor]:
    """Houses wall to wall, now and then with a passage."""
    along, line = CORNER, side.walk + rng.uniform(0.1, 0.8)
    storeys = rng.integers(2, 6)
    while along < side.length - CORNER - 5:
        length = min(rng.uniform(8, 22), side.length - CORNER - along)
        house = building(rng, length, rng.uniform(9, 13), max(storeys + rng.integers(-1, 2), 2))
        yield side.put(house, along + length / 2, line + rng.choice([0.0, 0.0, 0.3]))
        along += length + (0.15 if rng.random() < 0.6 else rng.uniform(3, 12))
    for along in scattered(rng, side.length, 14.0):
        yield side.put(vegetation.bush(rng), along, line - 0.8)
    yield from _yard(rng, side, line + 14)


def _yard(rng, side: Side, line: float) -> Iterator[Actor]:
    """What one sees between the houses."""
    for along in scattered(rng, side.length, 22):
        yield side.put(_tree(rng), along, line + rng.uniform(0, 30))
    for along in scattered(rng, side.length, 15):
        yield side.put(vegetation.bush(rng), along, line + rng.uniform(0, 25), rng.uniform(-3, 3))


def _garden(rng, side: Side) -> Iterator[Actor]:
    """Houses in gardens behind hedges, fences and walls."""
    along, line = CORNER, side.walk + 0.3
    border = BORDERS[rng.integers(len(BORDERS))]
    while along < side.length - CORNER - 9:
        lot = min(rng.uniform(11, 22), side.length - CORNER - along)
        drive = 3.2
        if rng.random() < 0.4:
            border = BORDERS[rng.integers(len(BORDERS))]
        if rng.random() < 0.9:
            yield side.put(border(rng, lot - drive - 0.2), along + drive + (lot - drive) / 2, line)
        back = line + rng.uniform(2.5, 8)
        house = lot - drive - rng.uniform(0.5, 3)
        yield side.put(building(rng, house, rng.uniform(8, 11), rng.integers(1, 4)),
                       along + drive + house / 2, back)
        for at in scattered(rng, lot - drive, 20):
            yield side.put(_tree(rng), along + drive + at, rng.uniform(line + 1.2, back))
        for at in scattered(rng, lot - drive, 70):
            yield side.put(vegetation.bush(rng), along + drive + at, rng.uniform(line + 1, back),
                           rng.uniform(-3, 3))
        along += lot
    yield from _yard(rng, side, line + 19)


def _verge(rng, side: Side) -> Iterator[Actor]:
    """A strip of grass with rows of trees, and something far behind it."""
    deep = rng.uniform(4, 14)
    for along in evenly_spaced(rng, side.length, rng.uniform(7, 14)):
        yield side.put(_tree(rng), along, side.walk + rng.uniform(1.2, 1.8))
    shrubs, depth = ((150, 0.35 * deep) if rng.random() < 0.7 else (rng.uniform(2, 50), deep))
    for along in scattered(rng, side.length, shrubs):
        yield side.put(vegetation.bush(rng), along, side.walk + rng.uniform(1.0, 1.0 + depth),
                       rng.uniform(-3, 3))
    along = CORNER
    while along < side.length - 10:
        length = min(rng.uniform(12, 35), side.length - along - 1)
        pick = rng.random()
        if pick < 0.45:
            yield side.put(building(rng, length, rng.uniform(10, 20), rng.integers(1, 6)),
                           along + length / 2, side.walk + deep + rng.uniform(0, 4))
        elif pick < 0.8:
            border = BORDERS[rng.integers(len(BORDERS))]
            yield side.put(border(rng, length), along + length / 2, side.walk + deep)
        along += length + rng.uniform(0.3, 12)
    yield from _yard(rng, side, side.walk + deep + 2)


def _wild(rng, side: Side) -> Iterator[Actor]:
    """Grass, and woods, a hedgerow or fields behind."""
    near = side.walk + rng.uniform(1.5, 4.0)
    bushes, trees, deep = WILDS[rng.choice(len(WILDS), p=(0.4, 0.4, 0.2))]
    for along in scattered(rng, side.length, bushes):
        yield side.put(vegetation.bush(rng), along, near + rng.exponential(deep),
                       rng.uniform(-3, 3))
    for along in scattered(rng, side.length, trees):
        yield side.put(_tree(rng), along, near + 1 + rng.gamma(1.5, deep))
    if rng.random() < 0.3:
        for along in np.arange(0, side.length - 12, 12.0):
            yield side.put(furniture.fence(rng, 11.7), along + 6, near - 0.3)
    for along in scattered(rng, side.length, 0.8):
        yield side.put(building(rng, rng.uniform(8, 20), rng.uniform(8, 14),
                                rng.integers(1, 3)), along, near + rng.uniform(12, 40))


def _square(rng, side: Side) -> Iterator[Actor]:
    """Facades that stand back behind trees, planters and bollards."""
    deep = rng.uniform(5, 14)
    yield from _facade(rng, side._replace(walk=side.walk + deep))
    for along in evenly_spaced(rng, side.length, rng.uniform(6, 10)):
        yield side.put(_tree(rng), along, side.walk + deep * 0.5)
    for along in scattered(rng, side.length, 8):
        yield side.put(clutter(rng), along, side.walk + rng.uniform(0, deep),
                       rng.uniform(-3, 3))


FRONTS = {"facade": _facade, "garden": _garden, "verge": _verge, "wild": _wild,
          "square": _square}


def _furniture(rng, side: Side, kind: Kind) -> Iterator[Actor]:
    """What stands along the curb, and against the walls."""
    rural = side.walk == 0.0
    edge = 1.0 if rural else 0.2
    for along in (0.6, side.length - 0.6):  # at the corners
        if not rural and rng.random() < 0.5:
            yield side.put(furniture.traffic_light(rng), along, edge + 0.3, -np.pi / 2)
    for rate, make in ((kind.lamp, furniture.lamp), (kind.tree, _street_tree)):
        if rate and rng.random() < 0.8:
            for along in evenly_spaced(rng, side.length, 100 / rate):
                yield side.put(make(rng), along, edge + rng.uniform(0.2, 0.4), -np.pi / 2)
    for along in scattered(rng, side.length, 2.2 * kind.clutter):
        made = clutter(rng, rural)
        low, high = extents(made)
        wide = np.abs([low[:, :2], high[:, :2]]).max()  # turned anyhow, it stays off the road
        at_wall = not rural and rng.random() < 0.35
        out = side.walk - wide if at_wall else edge + wide + rng.uniform(0, 0.15)
        turn = rng.choice([0.0, np.pi / 2, np.pi, -np.pi / 2]) + rng.normal(0, 0.1)
        yield side.put(made, along, max(out, 0.2 + wide), turn)


def _islands(rng, street: Street) -> Iterator[Actor]:
    """Beacons and signs between the directions, at both ends of some crossings."""
    ours, oncoming = street.lanes[0], [lane.y for lane in street.lanes if lane.direction < 0]
    middle = (ours.y + min(oncoming)) / 2
    for crossing in street.ground.crossings:
        if rng.random() >= street.kind.islands:
            continue
        for x, away in zip(crossing, (-1, 1)):
            for far in (rng.uniform(0.5, 2.0), rng.uniform(6.0, 15.0)):
                made = (furniture.beacon, furniture.beacon, furniture.sign)[rng.integers(3)](rng)
                yield Actor(prop(made), x + away * far, middle, rng.choice([0.0, np.pi]))


def _street_tree(rng) -> np.ndarray:
    return vegetation.tree(rng, rng.uniform(4.0, 8.0))
