"""People on foot and in wheelchairs, alone or in groups."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from lidar_perception.simulation.actors import Actor, ActorSet
from lidar_perception.simulation.places import Court, Side, draw_positions_along
from lidar_perception.simulation.shapes import furniture
from lidar_perception.simulation.shapes.people import CARRIED, make_pedestrian, make_sitting_person, make_wheelchair
from lidar_perception.simulation.shapes.scene_object import SceneObject

# Probabilities of groups with 1, 2, ... people.
STANDING_PROBABILITIES, WALKING_PROBABILITIES = (0.55, 0.3, 0.1, 0.05), (0.62, 0.3, 0.08)
AT_WALL_RATIO = 0.25  # fraction of groups that are replaced by people at walls
AT_WALL_TRIES = 0.9  # attempts per replaced group to place a person at a wall of a court
MAX_AT_WALL_M = 4.0  # maximum distance of a wall from the edge of a court
LEANING_RATIO = 0.35  # fraction of people at walls who lean against them
CROWD_FACTORS = 0.3, 1.0, 1.0, 2.5  # random factors for the number of people in a court
WHEELCHAIR_RATIO = 0.06  # wheelchairs per walking or standing group


def make_person(rng, speed: float = 0.0) -> SceneObject:
    """Make a person who walks at a speed in m/s, or stands; some are children or carry an object."""
    carried = rng.choice(CARRIED, p=(0.6, 0.14, 0.14, 0.04, 0.04, 0.04))
    return make_pedestrian(rng, speed, child=rng.random() < 0.08, carried=str(carried))


def place_standing(rng, side: Side, rate: float) -> Iterator[list[Actor]]:
    """Yield standing people, and groups of people who face each other."""
    for position in draw_positions_along(rng, side.length, rate):
        offset, count = (
            rng.uniform(0.4, max(side.sidewalk_width - 0.4, 1.0)),
            rng.choice([1, 2, 3, 4], p=STANDING_PROBABILITIES),
        )
        start_angle, radius = rng.uniform(-np.pi, np.pi), rng.uniform(0.5, 0.7) * (count > 1)
        angles = start_angle + 2 * np.pi / count * np.arange(count)
        yield [
            side.place(
                make_person(rng),
                position + radius * np.cos(angle),
                offset + radius * np.sin(angle),
                angle + np.pi + rng.normal(0, 0.15),
            )
            for angle in angles
        ]


def place_at_walls(
    rng, actors: ActorSet, side: Side, rate: float, offsets: tuple[float, float], distance: float, turn: float
) -> None:
    """Add people next to the objects along a line: walls, shop fronts, fences, hedges, shelves, parked vehicles.

    Some lean against it. The others are up to 1 m away and look at it, away from it or along it.

    Args:
        side: The line.
        rate: Mean number of attempts per 100 m.
        offsets: Range of distances from the line at which the search begins, m.
        distance: Maximum length of the search beyond the line, m.
        turn: Direction of the search relative to the line, rad: pi / 2 for left, -pi / 2 for right.
    """
    for position in draw_positions_along(rng, side.length, rate):
        offset, is_leaning = rng.uniform(*offsets), rng.random() < LEANING_RATIO
        person = make_pedestrian(rng, 0.0, lean=rng.uniform(0.05, 0.25)) if is_leaning else make_person(rng)
        heading = np.pi if is_leaning else rng.choice((np.pi, 0.0, np.pi / 2, -np.pi / 2), p=(0.4, 0.3, 0.15, 0.15))
        actor = side.place(person, position, offset, turn + heading + rng.normal(0, 0.1 if is_leaning else 0.3))
        gap = 0.0 if is_leaning else min(0.05 + rng.exponential(0.3), 1.0)
        actors.admit_next_to_other(actor, side.heading + turn, distance + abs(offset), gap)


def place_walking(rng, side: Side, rate: float, roam: bool) -> Iterator[list[Actor]]:
    """Yield people who walk along a sidewalk, alone or in groups; some start or stop on the way.

    Args:
        rate: Groups per 100 m.
        roam: True if people also walk on the road, and in any direction.
    """
    for position in draw_positions_along(rng, side.length, rate):
        speed = _draw_speed(rng)
        heading = np.pi * rng.integers(2) + rng.normal(0, 0.02)
        min_offset = 0.9
        if roam:
            min_offset, heading = -3.0, heading + rng.normal(0, 0.6) * (rng.random() < 0.5)
        offset = rng.uniform(min_offset, max(side.sidewalk_width - 0.5, min_offset + 0.5))
        moves = _draw_moves(rng, speed, 0.2)
        count = rng.choice([1, 2, 3], p=WALKING_PROBABILITIES)
        yield [
            side.place(make_person(rng, speed), position + rng.uniform(-0.2, 0.2), offset + 0.85 * i, heading, **moves)
            for i in range(count)
        ]


def place_strolling(rng, court: Court, rate: float) -> Iterator[list[Actor]]:
    """Yield groups who walk across a court in any direction; half of them start or stop on the way.

    Args:
        rate: Groups per 100 square metres.
    """
    for x, y in court.draw_positions(rng, rate):
        speed, heading = _draw_speed(rng), rng.uniform(-np.pi, np.pi)
        moves = _draw_moves(rng, speed, 0.5)
        count = rng.choice([1, 2, 3], p=WALKING_PROBABILITIES)
        yield [
            Actor(
                make_person(rng, speed),
                x - 0.85 * i * np.sin(heading),
                y + 0.85 * i * np.cos(heading),
                heading,
                **moves,
            )
            for i in range(count)
        ]


def _draw_moves(rng, speed: float, chance: float) -> dict[str, float]:
    """Draw the speed, start and stop of an Actor that starts or stops on the way with probability `chance`."""
    moves = {"speed": speed}
    pick = rng.random()
    if pick < chance:
        moves["start" if pick < chance / 2 else "stop"] = rng.uniform(1, 15)
    return moves


def _draw_speed(rng) -> float:
    """Draw a walking speed in m/s; some people run."""
    return float(np.clip(rng.normal(1.35, 0.25), 0.6, 2.0) if rng.random() < 0.97 else 2.7)


def fill_court(
    rng, actors: ActorSet, court: Court, people: float, walkers: float, strollers: float, standers: float
) -> None:
    """Add pedestrians and people in wheelchairs to a court.

    Args:
        people: Factor for all numbers, which are also multiplied by one of CROWD_FACTORS.
        walkers: Groups who walk along x, per 100 m.
        strollers: Groups who walk in any direction, per 100 square metres.
        standers: Groups who stand, per 100 m.
    """
    people *= rng.choice(CROWD_FACTORS)
    floor, sides = court.floor, court.make_sides()
    groups_at_walls = ((walkers + standers) + strollers * floor.sidewalk_width) * floor.length / 100
    rate = AT_WALL_RATIO * AT_WALL_TRIES * groups_at_walls * people / sum(side.length for side in sides) * 100
    for side, depth in zip(sides, (floor.sidewalk_width, floor.length) * 2):
        place_at_walls(rng, actors, side, rate, (-depth / 2, -0.3), MAX_AT_WALL_M, np.pi / 2)
    people *= 1 - AT_WALL_RATIO
    for groups in (
        place_standing(rng, court.floor, standers * people),
        place_walking(rng, court.floor, walkers * people, roam=False),
        place_wheelchairs(rng, court.floor, WHEELCHAIR_RATIO * (walkers + standers) * people),
        place_strolling(rng, court.shrink(0.4), strollers * people),
    ):
        for group in groups:
            actors.admit(*group)


def place_wheelchairs(rng, side: Side, rate: float) -> Iterator[list[Actor]]:
    """Yield people in wheelchairs along a side, with a mean number of `rate` per 100 m."""
    for position in draw_positions_along(rng, side.length, rate):
        yield [
            side.place(
                make_wheelchair(rng),
                position,
                rng.uniform(0.5, max(side.sidewalk_width - 0.5, 0.6)),
                np.pi * rng.integers(2) + rng.normal(0, 0.1),
                speed=rng.choice((0.0, rng.uniform(0.5, 1.3))),
            )
        ]


def place_bench(rng, side: Side, position: float, offset: float, people: float, occupancy: float = 0.25) -> list[Actor]:
    """Return a bench that faces the inside of a side, and the people on its two seats.

    occupancy * people is the probability that a seat is taken, at most 0.8.
    """
    sitters = [
        side.place(make_sitting_person(rng, has_chair=False), position + shift, offset, -np.pi / 2)
        for shift in (-0.45, 0.45)
        if rng.random() < min(occupancy * people, 0.8)
    ]
    return [side.place(furniture.make_bench(rng), position, offset, -np.pi / 2), *sitters]
