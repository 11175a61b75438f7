"""Campus scenes for robots: forecourts, squares and paths, with few and slow cars."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from lidar_perception.simulation import crowd
from lidar_perception.simulation.actors import Actor, ActorSet, make_prop
from lidar_perception.simulation.places import Court, Side, place_against, scatter, space_evenly
from lidar_perception.simulation.roadside import FRONTS, is_plant, make_clutter
from lidar_perception.simulation.shapes import furniture, vegetation
from lidar_perception.simulation.shapes.buildings import make_glass_hall
from lidar_perception.simulation.shapes.cyclists import make_bicycle, make_cyclist
from lidar_perception.simulation.shapes.people import make_sitting_person
from lidar_perception.simulation.shapes.vehicles import make_car, make_van
from lidar_perception.simulation.terrain import PAVEMENT, Ground
from lidar_perception.simulation.trajectory import DRIVE_SECONDS, ROBOT_RADIUS_M, Trajectory, draw_trajectory

SHOULDER_M = 0.6  # distance from a path to benches and lamps


@dataclass(frozen=True)
class CampusKind:
    """Parameters of a kind of campus, which is laid out around the trajectory of the robot.

    Pairs (low, high) are the ranges of uniform distributions. Lengths are in m.
    """

    share: float  # fraction of scenes of this kind
    left: tuple[float, float]  # distance from the trajectory to the left edge of the court
    right: tuple[float, float]
    fronts: dict[str, float]  # weights of the kinds of edge, see FRONTS and CAMPUS_FRONTS
    turn: float  # maximum heading of the robot to either side, rad
    lane: float = 0.0  # probability of a car lane on the right
    path: bool = False  # True for a path through grass
    things: float = 0.5  # objects per 100 square metres
    edge: float = 18.0  # objects along the edges, per 100 m
    seats: float = 5.0  # benches along the edges, per 100 m
    racks: float = 1.5  # bicycle racks along the edges, per 100 m
    along: float = 0.0  # groups walking along x, per 100 m
    across: float = 0.0  # groups walking in any direction, per 100 square metres
    standers: float = 8.0  # standing groups, per 100 m
    riders: float = 3.0  # cyclists per 100 m
    ends: tuple[float, float] = (25.0, 60.0)  # length of the court behind and ahead of the trajectory
    stands: float = 0.15  # probability that the robot stands still
    speed: tuple[float, float] = (0.5, 1.5)


CAMPUS_KINDS = {
    "forecourt": CampusKind(
        0.4,
        (4.0, 16.0),
        (3.0, 12.0),
        {"entrance": 0.5, "facade": 0.25, "verge": 0.15, "square": 0.1},
        0.5,
        lane=0.8,
        along=10.0,
        across=0.9,
        standers=14.0,
    ),
    "square": CampusKind(
        0.25,
        (8.0, 25.0),
        (8.0, 25.0),
        {"facade": 0.4, "square": 0.3, "entrance": 0.3},
        0.7,
        things=0.7,
        across=0.8,
        standers=22.0,
    ),
    "path": CampusKind(
        0.35,
        (1.0, 2.6),
        (1.0, 2.6),
        {"verge": 0.55, "garden": 0.15, "hedge": 0.3},
        0.15,
        path=True,
        things=0.0,
        along=26.0,
        standers=5.0,
        riders=4.0,
        seats=3.0,
        edge=6.0,
    ),
}


def make_campus(
    rng: np.random.Generator, kind: CampusKind, people: float
) -> tuple[Ground, tuple[Actor, ...], Trajectory]:
    """Make ground, actors and trajectory of a campus scene; people: factor for the number of people."""
    trajectory = draw_trajectory(rng, kind.speed, kind.stands, kind.turn)
    court = Court.around(
        trajectory.sample(DRIVE_SECONDS, 1.0)[:, 1:],
        rng.uniform(*kind.ends, 2),
        np.array([rng.uniform(*kind.right), rng.uniform(*kind.left)]),
    )
    lane = rng.uniform(5.0, 7.0) if rng.random() < kind.lane else 0.0
    ground = _draw_ground(rng, kind, court, lane)
    actors = ActorSet(DRIVE_SECONDS, trajectory=trajectory, radius=ROBOT_RADIUS_M)
    names, shares = list(kind.fronts), list(kind.fronts.values())
    left, _, right, _ = sides = court.sides()
    for side in sides:
        walk = lane + 3.0 if lane and side == right else SHOULDER_M if kind.path else 0.0
        front = {**FRONTS, **CAMPUS_FRONTS}[str(rng.choice(names, p=shares))]
        for obj in front(rng, side._replace(walk=walk)):
            actors.admit(obj, gap=-0.8 if is_plant(obj) else 0.1)
    if lane:
        actors.admit_each(_fill_lane(rng, right, lane), gap=0.3)
    for side in (left, right):
        actors.admit_each(_furnish_edge(rng, side, kind, kerb=lane > 0 and side == right), gap=0.25)
        for along in scatter(rng, side.length, kind.seats):
            out = SHOULDER_M if kind.path else -rng.uniform(0.5, 1.5)
            seat, *sitters = crowd.place_bench(rng, side, along, out, people)
            if actors.admit(seat, gap=0.5):
                actors.add(*sitters)
        for along in scatter(rng, side.length, kind.racks):
            actors.admit_each(_place_rack(rng, side, along, SHOULDER_M + 0.5 if kind.path else -1.4), gap=0.0)
    for first, *others in _place_things(rng, court.inner(1.5), kind, people):
        if actors.admit(first, gap=0.3):
            actors.add(*others)
    for along in scatter(rng, court.floor.length, kind.riders * people):
        actors.admit(
            court.floor.place(
                make_cyclist(rng),
                along,
                rng.uniform(0.6, max(court.floor.walk - 0.6, 0.7)),
                np.pi * rng.integers(2) + rng.normal(0, 0.03),
                speed=rng.uniform(2.0, 4.5),
            ),
            gap=0.2,
        )
    crowd.fill_court(rng, actors, court, people, kind.along, kind.across, kind.standers)
    return ground, tuple(actors.actors), trajectory


def _draw_ground(rng, kind: CampusKind, court: Court, lane: float) -> Ground:
    """Draw the ground: pavement, pavement with a lane on its right, or a path through grass."""
    slopes = np.tan(np.radians(rng.normal(0.0, 0.7, 2))).tolist()
    surface = dict(
        slope_x=slopes[0],
        slope_y=slopes[1],
        wave=rng.uniform(0.0, 0.06),
        wavelength=rng.uniform(15, 40),
        road=rng.uniform(0.23, 0.38),
        sidewalk=rng.uniform(0.3, 0.5),
        grass=rng.uniform(0.3, 0.4),
        curb_height=rng.uniform(0.0, 0.15),
        rough=rng.uniform(0.05, 0.25),
    )
    if kind.path:
        return Ground(
            **{**surface, "curb_height": rng.uniform(0.0, 0.04)},
            curb_left=court.y1,
            curb_right=court.y0,
            walk=0.0,
            camber=rng.uniform(0.0, 0.02),
        )
    if lane:
        return Ground(**surface, curb_left=court.y0, curb_right=court.y0 - lane, camber=rng.uniform(0.0, 0.02))
    return PAVEMENT._replace(**{**surface, "curb_height": 0.0})


def _build_entrance(rng, side: Side) -> Iterator[Actor]:
    """Yield glass halls, some with stairs, and squares between them."""
    along, line = rng.uniform(0, 8), side.walk + 2.5
    while along < side.length - 8:
        length = min(rng.uniform(12, 35), side.length - along)
        if rng.random() < 0.75:
            yield side.place(make_glass_hall(rng, length, rng.uniform(8, 15)), along + length / 2, line)
            if rng.random() < 0.6:
                width = rng.uniform(3.0, 0.7 * length)
                yield side.place(furniture.make_stairs(rng, width), along + length / 2, line - 2.4)
        else:
            yield from FRONTS["square"](
                rng,
                side._replace(
                    x=side.x + np.cos(side.heading) * along, y=side.y + np.sin(side.heading) * along, length=length
                ),
            )
        along += length + rng.uniform(0.5, 6)


def _build_hedge(rng, side: Side) -> Iterator[Actor]:
    """Yield a hedge or low wall with gaps, and a lawn with trees behind."""
    along, line = 0.0, side.walk + rng.uniform(1.0, 2.5)
    make = (vegetation.make_hedge, vegetation.make_hedge, furniture.make_wall)[rng.integers(3)]
    while along < side.length - 4:
        length = min(rng.uniform(4, 18), side.length - along)
        yield side.place(make(rng, length), along + length / 2, line)
        along += length + rng.uniform(1.5, 8)
    yield from FRONTS["verge"](rng, side._replace(walk=line + 2.0))


CAMPUS_FRONTS = {"entrance": _build_entrance, "hedge": _build_hedge}


def _fill_lane(rng, side: Side, lane: float) -> Iterator[Actor]:
    """Yield cars that stand at the curb, and a few that drive slowly."""
    for along in scatter(rng, side.length, 5.0):
        make = make_car if rng.random() < 0.75 else make_van
        obj = make(rng, driver=bool(rng.random() < 0.5))
        yield side.place(obj, along, 0.3 + obj.size[1] / 2, np.pi)
    for along in scatter(rng, side.length, 1.5):
        yield side.place(make_car(rng), along, lane - 1.4, np.pi * rng.integers(2), speed=rng.uniform(1.5, 5.0))


def _furnish_edge(rng, side: Side, kind: CampusKind, kerb: bool) -> Iterator[Actor]:
    """Yield rows of lamps, trees and bollards, and scattered objects along an edge of the court."""
    out = SHOULDER_M if kind.path else -0.5
    if kerb:
        bollard, gap = make_prop(furniture.make_bollard(rng)), rng.uniform(1.4, 2.5)
        yield from (side.place(bollard, along, -0.3) for along in np.arange(1.0, side.length, gap))
        out = -1.6
    for make, chance in ((furniture.make_lamp, 0.8), (vegetation.make_tree, 0.5), (furniture.make_bollard, 0.2)):
        if rng.random() < chance:
            for along in space_evenly(rng, side.length, rng.uniform(7, 20)):
                yield side.place(make(rng), along, out + rng.normal(0, 0.1), -np.pi / 2)
    if not kind.path:
        yield from place_against(rng, side, (*furniture.PERSON_SIZED, furniture.make_pole), kind.edge)
        return
    for along in scatter(rng, side.length, kind.edge):
        yield side.place(make_clutter(rng), along, rng.uniform(0.6, 1.2), rng.uniform(-np.pi, np.pi))


def _place_rack(rng, side: Side, along: float, out: float) -> Iterator[Actor]:
    """Yield a row of bicycle stands, most with a bicycle."""
    for i in range(rng.integers(2, 9)):
        yield side.place(furniture.make_bicycle_stand(rng), along + 0.9 * i, out, np.pi / 2)
        if rng.random() < 0.75:
            yield side.place(
                make_bicycle(rng),
                along + 0.9 * i + 0.42,
                out + rng.normal(0, 0.1),
                np.pi / 2 + np.pi * rng.integers(2) + rng.normal(0, 0.06),
            )


def _place_things(rng, court: Court, kind: CampusKind, people: float) -> Iterator[list[Actor]]:
    """Yield the objects on the pavement, each with the people on it: trees, chairs, parasols, benches and clutter."""
    for x, y in court.draw_positions(rng, kind.things):
        turn, pick = rng.uniform(-np.pi, np.pi), rng.random()
        if pick < 0.2:
            yield [Actor(make_prop(vegetation.make_tree(rng, rng.uniform(4.0, 8.0))), x, y)]
        elif pick < 0.35:
            is_person = rng.random() < 0.3 * people
            yield [Actor(make_sitting_person(rng) if is_person else make_prop(furniture.make_parasol(rng)), x, y, turn)]
        elif pick < 0.5:
            yield crowd.place_bench(rng, Side(x, y, turn, 0.0, 0.0, ""), 0.0, 0.0, people)
        else:
            yield [Actor(make_prop(make_clutter(rng)), x, y, turn)]
