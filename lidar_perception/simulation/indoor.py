"""Interior scenes for robots: corridors, halls, canteens and stores."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from lidar_perception.simulation import crowd
from lidar_perception.simulation.actors import Actor, ActorSet, make_prop
from lidar_perception.simulation.places import Court, Side, draw_even_positions, place_along
from lidar_perception.simulation.roadside import FRONTS
from lidar_perception.simulation.shapes import furniture, interiors
from lidar_perception.simulation.shapes.people import make_sitting_person
from lidar_perception.simulation.terrain import PAVEMENT, Ground
from lidar_perception.simulation.trajectory import DRIVE_SECONDS, ROBOT_RADIUS_M, Trajectory, draw_trajectory

WINDOW_VIEW_M = 4.0  # distance from windows to the trees outside
SEAT_WIDTH_M = 0.65  # width of a table per person


@dataclass(frozen=True)
class IndoorKind:
    """Parameters of a kind of interior. Its layout surrounds the trajectory of the robot.

    Pairs (low, high) are the ranges of uniform distributions. Lengths are in m.
    """

    fraction: float  # fraction of scenes of this kind
    side_distance: tuple[float, float]  # distance from the trajectory to the side walls
    ends: tuple[float, float]  # distance from the trajectory to the end walls
    height: tuple[float, float]
    walls: dict[str, float]  # probability of each kind of wall segment, see WALLS
    furniture: tuple[str, ...]  # kinds of furniture, see FURNITURE
    max_heading: float  # maximum deviation of the robot's heading from x, rad
    window_chance: float = 0.0  # probability that a wall consists of windows
    wall_objects: float = 12.0  # objects along the walls, per 100 m
    floor_objects: float = 0.3  # objects per 100 square metres
    walkers: float = 0.0  # groups walking along x, per 100 m
    strollers: float = 0.0  # groups walking in any direction, per 100 square metres
    standers: float = 5.0  # standing groups, per 100 m


INDOOR_KINDS = {
    "corridor": IndoorKind(
        0.35,
        (0.7, 1.7),
        (8.0, 35.0),
        (2.4, 3.2),
        {"wall": 0.42, "door": 0.38, "glazing": 0.1, "passage": 0.1},
        (),
        0.25,
        walkers=45.0,
        standers=8.0,
        floor_objects=0.6,
        wall_objects=22.0,
    ),
    "hall": IndoorKind(
        0.3,
        (5.0, 14.0),
        (6.0, 20.0),
        (3.5, 8.0),
        {"wall": 0.4, "door": 0.2, "glazing": 0.2, "passage": 0.2},
        ("columns", "benches", "tables"),
        0.7,
        window_chance=0.4,
        strollers=2.2,
        standers=16.0,
    ),
    "canteen": IndoorKind(
        0.2,
        (3.0, 9.0),
        (6.0, 14.0),
        (2.7, 4.5),
        {"wall": 0.6, "door": 0.15, "glazing": 0.15, "passage": 0.1},
        ("columns", "many tables"),
        0.3,
        window_chance=0.35,
        strollers=2.0,
        standers=14.0,
        walkers=12.0,
    ),
    "store": IndoorKind(
        0.15,
        (4.0, 10.0),
        (6.0, 14.0),
        (2.8, 5.5),
        {"wall": 0.8, "door": 0.15, "glazing": 0.05},
        ("shelves",),
        0.1,
        strollers=2.0,
        walkers=18.0,
        standers=16.0,
        floor_objects=0.5,
    ),
}
WALLS = {  # kind -> (function, minimum length, maximum length)
    "wall": (interiors.make_wall, 1.0, 7.0),
    "door": (interiors.make_door, 1.2, 1.7),
    "glazing": (interiors.make_glazing, 2.0, 6.0),
    "passage": (interiors.make_passage, 1.8, 3.2),
    "window": (interiors.make_window, 3.0, 9.0),
}
OBJECTS = (*interiors.PERSON_SIZED, furniture.make_planter, furniture.make_litter_bin, furniture.make_cabinet)


def make_interior(
    rng: np.random.Generator, kind: IndoorKind, people: float
) -> tuple[Ground, tuple[Actor, ...], Trajectory]:
    """Make the ground, actors and trajectory of an interior; `people` scales the number of people."""
    trajectory = draw_trajectory(rng, kind.max_heading)
    actors = ActorSet(DRIVE_SECONDS, trajectory=trajectory, radius=ROBOT_RADIUS_M)
    court = Court.enclose(
        trajectory.sample(DRIVE_SECONDS, 1.0)[:, 1:], rng.uniform(*kind.ends, 2), rng.uniform(*kind.side_distance, 2)
    )
    height = rng.uniform(*kind.height)
    for side in court.make_sides():
        actors.add(*_build_walls(rng, side, kind, height))
    for name in kind.furniture:
        for first, *others in FURNITURE[name](rng, court, height, people):
            if actors.admit(first, gap=0.8 if others else 0.3):
                actors.add(*others)
    for side in court.make_sides():
        actors.admit_each(place_along(rng, side, OBJECTS, kind.wall_objects), gap=0.05)
    for x, y in court.shrink(0.8).draw_positions(rng, kind.floor_objects):
        parts = OBJECTS[rng.integers(len(OBJECTS))](rng)
        actors.admit(Actor(make_prop(parts), x, y, rng.uniform(-np.pi, np.pi)), gap=0.3)
    crowd.fill_court(rng, actors, court, people, kind.walkers, kind.strollers, kind.standers)
    # Placed last because it blocks nobody.
    area = court.shrink(-interiors.WALL_THICKNESS_M)
    ceiling = interiors.make_ceiling(rng, area.x1 - area.x0, area.y1 - area.y0, height)
    actors.add(Actor(make_prop(ceiling), *court.centre))
    return PAVEMENT._replace(sidewalk_reflectance=rng.uniform(0.2, 0.6)), tuple(actors.actors), trajectory


def _build_walls(rng, side: Side, kind: IndoorKind, height: float) -> Iterator[Actor]:
    """Yield the segments of a wall, or windows with trees outside."""
    names, weights = list(kind.walls), list(kind.walls.values())
    has_windows = rng.random() < kind.window_chance
    position = 0.0
    while position < side.length:
        make, low, high = WALLS["window" if has_windows else str(rng.choice(names, p=weights))]
        remaining = side.length - position
        if remaining < low + 0.5:
            make, low, high = interiors.make_wall, remaining, remaining
        length = min(rng.uniform(low, high), remaining)
        yield side.place(make(rng, length, height), position + length / 2, 0.0)
        position += length
    if has_windows:
        yield from FRONTS["verge"](rng, side._replace(sidewalk_width=WINDOW_VIEW_M))


def _place_columns(rng, court: Court, height: float, people: float) -> Iterator[list[Actor]]:
    """Yield rows of columns."""
    column = make_prop(interiors.make_column(rng, height))
    (spacing_x, spacing_y), (x, y) = rng.uniform(5.0, 10.0, 2), rng.uniform(1.0, 5.0, 2)
    for at_x in np.arange(court.x0 + x, court.x1 - 1, spacing_x):
        for at_y in np.arange(court.y0 + y, court.y1 - 1, spacing_y):
            yield [Actor(column, at_x, at_y)]


def _place_benches(rng, court: Court, height: float, people: float) -> Iterator[list[Actor]]:
    """Yield benches with people along the walls, and counters."""
    for side in court.make_sides():
        for position in draw_even_positions(rng, side.length, rng.uniform(4.0, 12.0)):
            if rng.random() < 0.6:
                yield crowd.place_bench(rng, side, position, -rng.uniform(0.4, 1.0), people)
        if rng.random() < 0.4:
            yield [
                side.place(interiors.make_counter(rng), rng.uniform(0, side.length), -rng.uniform(1.2, 2.5), -np.pi / 2)
            ]


def _place_tables(rng, court: Court, height: float, people: float) -> Iterator[list[Actor]]:
    """Yield tables at random positions, each with its chairs and people."""
    for x, y in court.shrink(1.5).draw_positions(rng, 1.5):
        yield _make_table_group(rng, x, y, rng.uniform(-np.pi, np.pi), people)


def _place_table_rows(rng, court: Court, height: float, people: float) -> Iterator[list[Actor]]:
    """Yield rows of tables, each with its chairs and people."""
    spacing_x, spacing_y = rng.uniform(2.2, 3.5, 2)
    heading = np.pi / 2 * rng.integers(2)
    for x in np.arange(court.x0 + 1.3, court.x1 - 1.2, spacing_x):
        for y in np.arange(court.y0 + 1.3, court.y1 - 1.2, spacing_y):
            if rng.random() < 0.85:
                yield _make_table_group(
                    rng, x + rng.normal(0, 0.1), y + rng.normal(0, 0.1), heading + rng.normal(0, 0.05), people
                )


def _make_table_group(rng, x: float, y: float, heading: float, people: float) -> list[Actor]:
    """Return a table, and the chairs and people at its long sides."""
    length, width = rng.uniform((0.7, 0.65), (2.0, 0.9))
    table = Actor(make_prop(interiors.make_table(rng, length, width)), x, y, heading)
    line, seats = Side(x, y, heading, 0.0, 0.0, ""), []
    count = int(length / SEAT_WIDTH_M)
    for position in (np.arange(count) + 0.5) * SEAT_WIDTH_M - count * SEAT_WIDTH_M / 2:
        for side in (-1, 1):
            offset, pick = side * (width / 2 + rng.uniform(0.2, 0.4)), rng.random()
            if pick < min(0.35 * people, 0.8):
                seats.append(line.place(make_sitting_person(rng), position, offset, -side * np.pi / 2))
            elif pick < 0.85:
                seats.append(
                    line.place(interiors.make_chair(rng), position, offset, -side * np.pi / 2 + rng.normal(0, 0.3))
                )
    return [table, *seats]


def _place_shelves(rng, court: Court, height: float, people: float) -> Iterator[list[Actor]]:
    """Yield rows of shelves along x with aisles between."""
    aisle, y = rng.uniform(1.6, 2.8), court.y0 + 0.5
    while y < court.y1 - 0.4:
        x = court.x0 + rng.uniform(1.0, 2.5)
        while x < court.x1 - 1.5:
            length = rng.uniform(1.0, 2.4)
            yield [Actor(make_prop(interiors.make_shelf(rng, length)), x + length / 2, y)]
            x += length + (0.4 if rng.random() < 0.8 else rng.uniform(1.5, 2.5))
        y += 0.7 + aisle


FURNITURE = {
    "columns": _place_columns,
    "benches": _place_benches,
    "tables": _place_tables,
    "many tables": _place_table_rows,
    "shelves": _place_shelves,
}
