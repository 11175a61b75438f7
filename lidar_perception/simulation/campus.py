"""Outside, where no cars drive or few and slowly: forecourts, squares and paths around the way of a
robot."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from lidar_perception.simulation import crowd
from lidar_perception.simulation.actors import Actor, Room, prop
from lidar_perception.simulation.places import Court, Side, against, evenly_spaced, scattered
from lidar_perception.simulation.roadside import FRONTS, clutter, is_plant
from lidar_perception.simulation.shapes import furniture, vegetation
from lidar_perception.simulation.shapes.buildings import glass_hall
from lidar_perception.simulation.shapes.cyclists import cyclist, parked_bicycle
from lidar_perception.simulation.shapes.people import sitting
from lidar_perception.simulation.shapes.vehicles import car, van
from lidar_perception.simulation.terrain import PAVEMENT, Ground
from lidar_perception.simulation.way import ROBOT, SECONDS, Way, swaying

SHOULDER = 0.6  # m that benches and lamps stand beside a path


@dataclass(frozen=True)
class Kind:
    """Ranges (low, high) are drawn from uniformly; lengths in metres; shares and chances are in
    0 .. 1. What comes first is laid out around the way of the robot."""

    share: float                    # how often it is drawn
    left: tuple[float, float]       # from the way to what lines the court
    right: tuple[float, float]
    fronts: dict[str, float]        # that (FRONTS and HERE), and how often
    turn: float                     # how far the robot turns to both sides at most, rad
    lane: float = 0.0               # chance of a lane for cars to the right
    path: bool = False              # a path through grass
    things: float = 0.5             # on 100 square metres
    edge: float = 18.0              # things along the edges, on 100 m
    seats: float = 5.0              # benches along the edges, on 100 m
    racks: float = 1.5              # rows of bicycles along the edges, on 100 m
    along: float = 0.0              # groups who walk along x, on 100 m
    across: float = 0.0             # groups who walk anywhere, on 100 square metres
    standers: float = 8.0           # groups who stand, on 100 m
    riders: float = 3.0             # cyclists on 100 m
    ends: tuple[float, float] = (25.0, 60.0)  # court behind and ahead of the way
    stands: float = 0.15            # chance that the robot stands
    speed: tuple[float, float] = (0.5, 1.5)


KINDS = {
    "forecourt": Kind(0.4, (4.0, 16.0), (3.0, 12.0), {
        "entrance": 0.5, "facade": 0.25, "verge": 0.15, "square": 0.1}, 0.5, lane=0.8,
        along=10.0, across=0.9, standers=14.0),
    "square": Kind(0.25, (8.0, 25.0), (8.0, 25.0), {
        "facade": 0.4, "square": 0.3, "entrance": 0.3}, 0.7, things=0.7, across=0.8,
        standers=22.0),
    "path": Kind(0.35, (1.0, 2.6), (1.0, 2.6), {
        "verge": 0.55, "garden": 0.15, "hedge": 0.3}, 0.15, path=True, things=0.0, along=26.0,
        standers=5.0, riders=4.0, seats=3.0, edge=6.0),
}


def make(rng: np.random.Generator, kind: Kind,
         people: float) -> tuple[Ground, tuple[Actor, ...], Way]:
    """A court, what lines it, stands and moves in it, and a robot's way through it."""
    way = swaying(rng, kind.speed, kind.stands, kind.turn)
    court = Court.around(way.sampled(SECONDS, 1.0)[:, 1:], rng.uniform(*kind.ends, 2),
                         np.array([rng.uniform(*kind.right), rng.uniform(*kind.left)]))
    lane = rng.uniform(5.0, 7.0) if rng.random() < kind.lane else 0.0
    ground = _ground(rng, kind, court, lane)
    room = Room(SECONDS, way=way, radius=ROBOT)
    names, shares = list(kind.fronts), list(kind.fronts.values())
    left, _, right, _ = sides = court.sides()
    for side in sides:
        walk = lane + 3.0 if lane and side == right else SHOULDER if kind.path else 0.0
        front = {**FRONTS, **HERE}[str(rng.choice(names, p=shares))]
        for thing in front(rng, side._replace(walk=walk)):
            room.admit(thing, gap=-0.8 if is_plant(thing) else 0.1)
    if lane:
        for actor in _lane(rng, right, lane):
            room.admit(actor, gap=0.3)
    for side in (left, right):
        for thing in _edge(rng, side, kind, kerb=lane > 0 and side == right):
            room.admit(thing, gap=0.25)
        for along in scattered(rng, side.length, kind.seats):
            out = SHOULDER if kind.path else -rng.uniform(0.5, 1.5)
            seat, *sitters = crowd.bench(rng, side, along, out, people)
            if room.admit(seat, gap=0.5):
                room.add(*sitters)
        for along in scattered(rng, side.length, kind.racks):
            for actor in _rack(rng, side, along, SHOULDER + 0.5 if kind.path else -1.4):
                room.admit(actor, gap=0.0)
    for first, *others in _standing_about(rng, court.inner(1.5), kind, people):
        if room.admit(first, gap=0.3):
            room.add(*others)
    for along in scattered(rng, court.floor.length, kind.riders * people):
        room.admit(court.floor.put(
            cyclist(rng), along, rng.uniform(0.6, max(court.floor.walk - 0.6, 0.7)),
            np.pi * rng.integers(2) + rng.normal(0, 0.03), speed=rng.uniform(2.0, 4.5)), gap=0.2)
    crowd.fill(rng, room, court, people, kind.along, kind.across, kind.standers)
    return ground, tuple(room.actors), way


def _ground(rng, kind: Kind, court: Court, lane: float) -> Ground:
    """Pavement, with a lane beyond its edge, or a path through grass. Grass is mown."""
    slopes = np.tan(np.radians(rng.normal(0.0, 0.7, 2))).tolist()
    look = dict(slope_x=slopes[0], slope_y=slopes[1], wave=rng.uniform(0.0, 0.06),
                wavelength=rng.uniform(15, 40), road=rng.uniform(0.23, 0.38),
                sidewalk=rng.uniform(0.3, 0.5), grass=rng.uniform(0.3, 0.4),
                curb_height=rng.uniform(0.0, 0.15), rough=rng.uniform(0.05, 0.25))
    if kind.path:
        return Ground(**{**look, "curb_height": rng.uniform(0.0, 0.04)}, curb_left=court.y1,
                      curb_right=court.y0, walk=0.0, camber=rng.uniform(0.0, 0.02))
    if lane:
        return Ground(**look, curb_left=court.y0, curb_right=court.y0 - lane,
                      camber=rng.uniform(0.0, 0.02))
    return PAVEMENT._replace(**{**look, "curb_height": 0.0})


def _entrance(rng, side: Side) -> Iterator[Actor]:
    """A hall behind glass with stairs before it, between houses or trees."""
    along, line = rng.uniform(0, 8), side.walk + 2.5
    while along < side.length - 8:
        long = min(rng.uniform(12, 35), side.length - along)
        if rng.random() < 0.75:
            yield side.put(glass_hall(rng, long, rng.uniform(8, 15)), along + long / 2, line)
            if rng.random() < 0.6:
                wide = rng.uniform(3.0, 0.7 * long)
                yield side.put(furniture.stairs(rng, wide), along + long / 2, line - 2.4)
        else:
            yield from FRONTS["square"](rng, side._replace(
                x=side.x + np.cos(side.heading) * along, y=side.y + np.sin(side.heading) * along,
                length=long))
        along += long + rng.uniform(0.5, 6)


def _hedge(rng, side: Side) -> Iterator[Actor]:
    """A hedge or a low wall beside the way with gaps, and a lawn with trees behind."""
    along, line = 0.0, side.walk + rng.uniform(1.0, 2.5)
    made = (vegetation.hedge, vegetation.hedge, furniture.wall)[rng.integers(3)]
    while along < side.length - 4:
        long = min(rng.uniform(4, 18), side.length - along)
        yield side.put(made(rng, long), along + long / 2, line)
        along += long + rng.uniform(1.5, 8)
    yield from FRONTS["verge"](rng, side._replace(walk=line + 2.0))


HERE = {"entrance": _entrance, "hedge": _hedge}


def _lane(rng, side: Side, lane: float) -> Iterator[Actor]:
    """Cars that wait at the kerb, and one or two that drive slowly."""
    for along in scattered(rng, side.length, 5.0):
        thing = (car if rng.random() < 0.75 else van)(rng, driver=bool(rng.random() < 0.5))
        yield side.put(thing, along, 0.3 + thing.size[1] / 2, np.pi)
    for along in scattered(rng, side.length, 1.5):
        yield side.put(car(rng), along, lane - 1.4, np.pi * rng.integers(2),
                       speed=rng.uniform(1.5, 5.0))


def _edge(rng, side: Side, kind: Kind, kerb: bool) -> Iterator[Actor]:
    """Lamps and trees in rows, bollards along a kerb, and what stands about."""
    out = SHOULDER if kind.path else -0.5
    if kerb:
        bollard, gap = prop(furniture.bollard(rng)), rng.uniform(1.4, 2.5)
        yield from (side.put(bollard, along, -0.3) for along in np.arange(1.0, side.length, gap))
        out = -1.6
    for made, chance in ((furniture.lamp, 0.8), (vegetation.tree, 0.5), (furniture.bollard, 0.2)):
        if rng.random() < chance:
            for along in evenly_spaced(rng, side.length, rng.uniform(7, 20)):
                yield side.put(made(rng), along, out + rng.normal(0, 0.1), -np.pi / 2)
    if not kind.path:
        yield from against(rng, side, (*furniture.PERSON_SIZED, furniture.pole), kind.edge)
        return
    for along in scattered(rng, side.length, kind.edge):
        yield side.put(clutter(rng), along, rng.uniform(0.6, 1.2), rng.uniform(-np.pi, np.pi))


def _rack(rng, side: Side, along: float, out: float) -> Iterator[Actor]:
    """Hoops in a row, most with a bicycle at one side of them."""
    for i in range(rng.integers(2, 9)):
        yield side.put(furniture.bicycle_stand(rng), along + 0.9 * i, out, np.pi / 2)
        if rng.random() < 0.75:
            yield side.put(parked_bicycle(rng), along + 0.9 * i + 0.42, out + rng.normal(0, 0.1),
                           np.pi / 2 + np.pi * rng.integers(2) + rng.normal(0, 0.06))


def _standing_about(rng, court: Court, kind: Kind, people: float) -> Iterator[list[Actor]]:
    """Planters, trees and things on the pavement; chairs of cafes with who sits there."""
    for x, y in court.spots(rng, kind.things):
        turn, pick = rng.uniform(-np.pi, np.pi), rng.random()
        if pick < 0.2:
            yield [Actor(prop(vegetation.tree(rng, rng.uniform(4.0, 8.0))), x, y)]
        elif pick < 0.35:
            yield [Actor(sitting(rng), x, y, turn)] if rng.random() < 0.3 * people else [
                Actor(prop(furniture.parasol(rng)), x, y, turn)]
        elif pick < 0.5:
            yield crowd.bench(rng, Side(x, y, turn, 0.0, 0.0, ""), 0.0, 0.0, people)
        else:
            yield [Actor(prop(clutter(rng)), x, y, turn)]
