"""Campus scenes for robots: forecourts, squares and paths, with a few slow cars."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from lidar_perception.simulation import crowd
from lidar_perception.simulation.actors import Actor, ActorSet, make_prop
from lidar_perception.simulation.places import Court, Side, draw_even_positions, draw_positions_along, place_along
from lidar_perception.simulation.roadside import CLUTTER, FRONTS, is_plant, make_clutter
from lidar_perception.simulation.shapes import furniture, vegetation
from lidar_perception.simulation.shapes.buildings import make_glass_hall
from lidar_perception.simulation.shapes.cyclists import make_bicycle, make_cyclist
from lidar_perception.simulation.shapes.people import make_sitting_person
from lidar_perception.simulation.shapes.vehicles import make_car, make_van
from lidar_perception.simulation.terrain import PAVEMENT, Ground
from lidar_perception.simulation.trajectory import DRIVE_SECONDS, ROBOT_RADIUS_M, Trajectory, draw_trajectory

SHOULDER_M = 0.6  # distance from a path to benches and lamps
ENDS_M = 25.0, 60.0  # minimum and maximum length of the court before and after the trajectory
RACK_RATE = 1.5  # bicycle racks along the edges, per 100 m


@dataclass(frozen=True)
class CampusKind:
    """Parameters of a kind of campus. Its layout surrounds the trajectory of the robot.

    Pairs (low, high) are the ranges of uniform distributions. Lengths are in m.
    """

    fraction: float  # fraction of scenes of this kind
    left: tuple[float, float]  # distance from the trajectory to the left edge of the court
    right: tuple[float, float]  # distance from the trajectory to the right edge
    fronts: dict[str, float]  # probability of each kind of edge, see FRONTS and CAMPUS_FRONTS
    max_heading: float  # maximum deviation of the robot's heading from x, rad
    lane_chance: float = 0.0  # probability of a car lane on the right
    is_path: bool = False  # True for a path through grass
    floor_objects: float = 0.5  # objects per 100 square metres
    edge_objects: float = 18.0  # objects along the edges, per 100 m
    benches: float = 5.0  # benches along the edges, per 100 m
    walkers: float = 0.0  # groups walking along x, per 100 m
    strollers: float = 0.0  # groups walking in any direction, per 100 square metres
    standers: float = 8.0  # standing groups, per 100 m
    riders: float = 3.0  # cyclists per 100 m


CAMPUS_KINDS = {
    "forecourt": CampusKind(
        0.4,
        (4.0, 16.0),
        (3.0, 12.0),
        {"entrance": 0.5, "facade": 0.25, "verge": 0.15, "square": 0.1},
        0.5,
        lane_chance=0.8,
        walkers=10.0,
        strollers=0.9,
        standers=14.0,
    ),
    "square": CampusKind(
        0.25,
        (8.0, 25.0),
        (8.0, 25.0),
        {"facade": 0.4, "square": 0.3, "entrance": 0.3},
        0.7,
        floor_objects=0.7,
        strollers=0.8,
        standers=22.0,
    ),
    "path": CampusKind(
        0.35,
        (1.0, 2.6),
        (1.0, 2.6),
        {"verge": 0.55, "garden": 0.15, "hedge": 0.3},
        0.15,
        is_path=True,
        floor_objects=0.0,
        walkers=26.0,
        standers=5.0,
        riders=4.0,
        benches=3.0,
        edge_objects=6.0,
    ),
}


def make_campus(
    rng: np.random.Generator, kind: CampusKind, people: float
) -> tuple[Ground, tuple[Actor, ...], Trajectory]:
    """Make the ground, actors and trajectory of a campus scene; `people` scales the number of people."""
    trajectory = draw_trajectory(rng, kind.max_heading)
    court = Court.enclose(
        trajectory.sample(DRIVE_SECONDS, 1.0)[:, 1:],
        rng.uniform(*ENDS_M, 2),
        np.array([rng.uniform(*kind.right), rng.uniform(*kind.left)]),
    )
    lane_width = rng.uniform(5.0, 7.0) if rng.random() < kind.lane_chance else 0.0
    ground = _draw_ground(rng, kind, court, lane_width)
    actors = ActorSet(DRIVE_SECONDS, trajectory=trajectory, radius=ROBOT_RADIUS_M)
    names, weights = list(kind.fronts), list(kind.fronts.values())
    left, _, right, _ = sides = court.make_sides()
    for side in sides:
        sidewalk_width = lane_width + 3.0 if lane_width and side == right else SHOULDER_M if kind.is_path else 0.0
        front = {**FRONTS, **CAMPUS_FRONTS}[str(rng.choice(names, p=weights))]
        for obj in front(rng, side._replace(sidewalk_width=sidewalk_width)):
            actors.admit(obj, gap=-0.8 if is_plant(obj) else 0.1)
    if lane_width:
        actors.admit_each(_fill_lane(rng, right, lane_width), gap=0.3)
    for side in (left, right):
        actors.admit_each(_furnish_edge(rng, side, kind, has_curb=lane_width > 0 and side == right), gap=0.25)
        for position in draw_positions_along(rng, side.length, kind.benches):
            offset = SHOULDER_M if kind.is_path else -rng.uniform(0.5, 1.5)
            seat, *sitters = crowd.place_bench(rng, side, position, offset, people)
            if actors.admit(seat, gap=0.5):
                actors.add(*sitters)
        for position in draw_positions_along(rng, side.length, RACK_RATE):
            actors.admit_each(_place_rack(rng, side, position, SHOULDER_M + 0.5 if kind.is_path else -1.4), gap=0.0)
    for first, *others in _place_floor_objects(rng, court.shrink(1.5), kind, people):
        if actors.admit(first, gap=0.3):
            actors.add(*others)
    for position in draw_positions_along(rng, court.floor.length, kind.riders * people):
        actors.admit(
            court.floor.place(
                make_cyclist(rng),
                position,
                rng.uniform(0.6, max(court.floor.sidewalk_width - 0.6, 0.7)),
                np.pi * rng.integers(2) + rng.normal(0, 0.03),
                speed=rng.uniform(2.0, 4.5),
            ),
            gap=0.2,
        )
    crowd.fill_court(rng, actors, court, people, kind.walkers, kind.strollers, kind.standers)
    return ground, tuple(actors.actors), trajectory


def _draw_ground(rng, kind: CampusKind, court: Court, lane_width: float) -> Ground:
    """Draw the ground: pavement without or with a lane on its right, or a path through grass."""
    slopes = np.tan(np.radians(rng.normal(0.0, 0.7, 2))).tolist()
    surface = dict(
        slope_x=slopes[0],
        slope_y=slopes[1],
        wave_height=rng.uniform(0.0, 0.06),
        wavelength=rng.uniform(15, 40),
        road_reflectance=rng.uniform(0.23, 0.38),
        sidewalk_reflectance=rng.uniform(0.3, 0.5),
        grass_reflectance=rng.uniform(0.3, 0.4),
        curb_height=rng.uniform(0.0, 0.15),
        tuft_height=rng.uniform(0.05, 0.25),
    )
    if kind.is_path:
        return Ground(
            **{**surface, "curb_height": rng.uniform(0.0, 0.04)},
            curb_left=court.y1,
            curb_right=court.y0,
            sidewalk_width=0.0,
            camber=rng.uniform(0.0, 0.02),
        )
    if lane_width:
        return Ground(**surface, curb_left=court.y0, curb_right=court.y0 - lane_width, camber=rng.uniform(0.0, 0.02))
    return PAVEMENT._replace(**{**surface, "curb_height": 0.0})


def _build_entrance(rng, side: Side) -> Iterator[Actor]:
    """Yield glass halls, some with stairs, and squares between them."""
    position, offset = rng.uniform(0, 8), side.sidewalk_width + 2.5
    while position < side.length - 8:
        length = min(rng.uniform(12, 35), side.length - position)
        if rng.random() < 0.75:
            yield side.place(make_glass_hall(rng, length, rng.uniform(8, 15)), position + length / 2, offset)
            if rng.random() < 0.6:
                width = rng.uniform(3.0, 0.7 * length)
                yield side.place(furniture.make_stairs(rng, width), position + length / 2, offset - 2.4)
        else:
            yield from FRONTS["square"](
                rng,
                side._replace(
                    x=side.x + np.cos(side.heading) * position,
                    y=side.y + np.sin(side.heading) * position,
                    length=length,
                ),
            )
        position += length + rng.uniform(0.5, 6)


def _build_hedge(rng, side: Side) -> Iterator[Actor]:
    """Yield a hedge or low wall with gaps, and a lawn with trees behind it."""
    position, offset = 0.0, side.sidewalk_width + rng.uniform(1.0, 2.5)
    make = (vegetation.make_hedge, vegetation.make_hedge, furniture.make_wall)[rng.integers(3)]
    while position < side.length - 4:
        length = min(rng.uniform(4, 18), side.length - position)
        yield side.place(make(rng, length), position + length / 2, offset)
        position += length + rng.uniform(1.5, 8)
    yield from FRONTS["verge"](rng, side._replace(sidewalk_width=offset + 2.0))


CAMPUS_FRONTS = {"entrance": _build_entrance, "hedge": _build_hedge}


def _fill_lane(rng, side: Side, lane_width: float) -> Iterator[Actor]:
    """Yield cars and vans that stand at the curb, and a few cars that drive slowly."""
    for position in draw_positions_along(rng, side.length, 5.0):
        make = make_car if rng.random() < 0.75 else make_van
        obj = make(rng, driver=bool(rng.random() < 0.5))
        yield side.place(obj, position, 0.3 + obj.size[1] / 2, np.pi)
    for position in draw_positions_along(rng, side.length, 1.5):
        yield side.place(
            make_car(rng), position, lane_width - 1.4, np.pi * rng.integers(2), speed=rng.uniform(1.5, 5.0)
        )


def _furnish_edge(rng, side: Side, kind: CampusKind, has_curb: bool) -> Iterator[Actor]:
    """Yield rows of lamps, trees and bollards, and random objects, along an edge of the court."""
    offset = SHOULDER_M if kind.is_path else -0.5
    if has_curb:
        bollard, gap = make_prop(furniture.make_bollard(rng)), rng.uniform(1.4, 2.5)
        yield from (side.place(bollard, position, -0.3) for position in np.arange(1.0, side.length, gap))
        offset = -1.6
    for make, chance in ((furniture.make_lamp, 0.8), (vegetation.make_tree, 0.5), (furniture.make_bollard, 0.2)):
        if rng.random() < chance:
            for position in draw_even_positions(rng, side.length, rng.uniform(7, 20)):
                yield side.place(make(rng), position, offset + rng.normal(0, 0.1), -np.pi / 2)
    if not kind.is_path:
        yield from place_along(rng, side, CLUTTER, kind.edge_objects)
        return
    for position in draw_positions_along(rng, side.length, kind.edge_objects):
        yield side.place(make_clutter(rng), position, rng.uniform(0.6, 1.2), rng.uniform(-np.pi, np.pi))


def _place_rack(rng, side: Side, position: float, offset: float) -> Iterator[Actor]:
    """Yield a row of bicycle stands, most with a bicycle."""
    for i in range(rng.integers(2, 9)):
        yield side.place(furniture.make_bicycle_stand(rng), position + 0.9 * i, offset, np.pi / 2)
        if rng.random() < 0.75:
            yield side.place(
                make_bicycle(rng),
                position + 0.9 * i + 0.42,
                offset + rng.normal(0, 0.1),
                np.pi / 2 + np.pi * rng.integers(2) + rng.normal(0, 0.06),
            )


def _place_floor_objects(rng, court: Court, kind: CampusKind, people: float) -> Iterator[list[Actor]]:
    """Yield trees, chairs, parasols, benches and clutter on the pavement, each with the people on it."""
    for x, y in court.draw_positions(rng, kind.floor_objects):
        heading, pick = rng.uniform(-np.pi, np.pi), rng.random()
        if pick < 0.2:
            yield [Actor(make_prop(vegetation.make_tree(rng, rng.uniform(4.0, 8.0))), x, y)]
        elif pick < 0.35:
            is_person = rng.random() < 0.3 * people
            yield [
                Actor(make_sitting_person(rng) if is_person else make_prop(furniture.make_parasol(rng)), x, y, heading)
            ]
        elif pick < 0.5:
            yield crowd.place_bench(rng, Side(x, y, heading, 0.0, 0.0, ""), 0.0, 0.0, people)
        else:
            yield [Actor(make_prop(make_clutter(rng)), x, y, heading)]
