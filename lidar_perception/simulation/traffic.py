"""Vehicles, cyclists and people on a street."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from lidar_perception.simulation.actors import SIGHT_M, Actor, ActorSet
from lidar_perception.simulation.crowd import AT_WALL_RATIO, place_at_walls, place_bench, place_standing, place_walking
from lidar_perception.simulation.places import Side, draw_positions_along
from lidar_perception.simulation.shapes.cyclists import make_bicycle, make_cyclist, make_motorcycle, make_motorcyclist
from lidar_perception.simulation.shapes.heavy_vehicles import make_bus, make_tram, make_truck
from lidar_perception.simulation.shapes.people import make_sitting_person
from lidar_perception.simulation.shapes.primitives import block, disc
from lidar_perception.simulation.shapes.scene_object import SceneObject, make_rigid
from lidar_perception.simulation.shapes.vehicles import make_car, make_van
from lidar_perception.simulation.solids import make_parts
from lidar_perception.simulation.street import CORNER_SIDEWALK_M, PARALLEL_STRIP_M, Lane, Street, compute_parking_width

DRAWBAR_M = 0.8  # gap between a car and its trailer
FREE_CORNER_M = 5.0  # distance from a crossing to the first parked vehicle
MAX_OCCUPANCY = 0.6  # maximum fraction of the parking spaces that are occupied
OTHER_VEHICLE = 20  # SemanticKITTI class
MAX_AT_WALL_M = 8.0  # maximum distance of a wall, fence or hedge from the curb
AT_WALL_TRIES = 0.4  # attempts per replaced group to place a person at a wall; most attempts find no place
AT_CAR_RATIO = 0.3  # attempts to place people next to parked vehicles, per attempt next to walls
MOTORCYCLIST_FRACTION = 0.3  # motorcyclists among the riders at the edges of the road


def populate(rng: np.random.Generator, street: Street, actors: ActorSet, people: float) -> None:
    """Add the labelled actors of a street, and parked bicycles and motorcycles.

    Args:
        people: Factor for the number of people.
    """
    kind, blocks = street.kind, street.blocks
    for lane in street.lanes:
        for group in _queue_vehicles(rng, lane, street, actors.seconds):
            actors.admit(*group, gap=0.3)
    for crossing in street.ground.crossings:
        actors.admit_each(_fill_side_street(rng, crossing, street.ground), gap=0.3)
    for side, factor in [(curb, 1.0) for curb in blocks] + [(curb, 0.7) for curb in street.side_curbs]:
        actors.admit_each(_park_vehicles(rng, side, factor * rng.uniform(0.0, MAX_OCCUPANCY)))
    for side in blocks:
        for seat, *sitters in _place_seats(rng, side, kind.benches, people):
            if actors.admit(seat, gap=0.4):
                actors.add(*sitters)
    actors.admit_each(_place_riders(rng, street, actors.seconds, people), gap=0.3)
    rate = AT_WALL_RATIO * AT_WALL_TRIES * (kind.walkers + kind.standers) * people
    for side in blocks:
        place_at_walls(rng, actors, side, rate, (0.3, max(side.sidewalk_width, 0.5)), MAX_AT_WALL_M, np.pi / 2)
        if side.parking_width:
            place_at_walls(rng, actors, side, AT_CAR_RATIO * rate, (0.6, 1.5), 1.0, -np.pi / 2)
    people *= 1 - AT_WALL_RATIO
    for side in blocks:
        for group in place_standing(rng, side, kind.standers * people):
            actors.admit(*group)
    for side in (*blocks, *_find_crosswalks(street)):
        for group in place_walking(rng, side, kind.walkers * people, roam=kind.curb_height < 0.05):
            actors.admit(*group)


def _draw_vehicles(rng, use: str) -> list[SceneObject]:
    """Draw a vehicle for a kind of lane, some with a trailer. The frequencies are similar to KITTI's labels."""
    if use == "rail":
        return [make_tram(rng)]
    pick = rng.random()
    if pick < 0.97:
        return [(make_car if pick < 0.82 else make_van if pick < 0.91 else make_truck)(rng)]
    return [make_bus(rng)] if pick < 0.985 else [make_car(rng), make_trailer(rng)]


def make_trailer(rng) -> SceneObject:
    """Make a closed single-axle trailer, labelled Misc."""
    length, width, height = size = tuple(rng.uniform((1.8, 1.3, 0.9), (3.8, 1.9, 2.3)).tolist())
    x, y = length / 2, width / 2
    rows = [
        block((-x, -y, 0.35), (x, y, height), rng.uniform(0.1, 0.5)),
        *(disc((0, s * (y - 0.1), 0.3), 0.3, 0.1, 0.06) for s in (-1, 1)),
    ]
    return make_rigid(make_parts(rows, OTHER_VEHICLE), size, "Misc")


def _queue_vehicles(rng, lane: Lane, street: Street, seconds: float) -> Iterator[list[Actor]]:
    """Yield the vehicles in a lane that come into sight during the drive, clear of the ego vehicle."""
    if lane.use == "cycle":
        return
    is_ego_lane, direction = lane is street.lanes[0], lane.direction
    # Distance by which the ego vehicle overtakes the traffic in the lane.
    gain = (street.speed - direction * lane.speed) * seconds
    x, end = sorted((-direction * SIGHT_M, direction * SIGHT_M))
    x, end = x + min(gain, 0.0), end + max(gain, 0.0)
    stop_lines = [25.0] if is_ego_lane else [edge[direction < 0] for edge in street.ground.crossings]
    queue_length = rng.uniform(0, 40)
    while True:
        group = _draw_vehicles(rng, lane.use)
        length = sum(obj.size[0] for obj in group) + DRAWBAR_M * (len(group) - 1)
        min_gap = 1.2 + lane.speed  # 1 s of driving
        x += min_gap + rng.exponential(street.kind.headway * lane.speed + 1.0) * (2.0 if lane.use == "rail" else 1.0)
        if x + length > end:
            return
        rear, front = (x, x + length) if direction > 0 else (x + length, x)
        x += length
        if lane.speed == 0.0 and not any(0 < (line - front) * direction < queue_length for line in stop_lines):
            continue
        if is_ego_lane and min(rear, front) - 2.5 < min_gap and max(rear, front) + 2.5 > -min_gap:
            continue
        speed = lane.speed * rng.uniform(0.98, 1.02)
        offset, heading = rng.normal(0, 0.12), np.pi * (direction < 0)
        actors = []
        for obj in group:
            centre = front - direction * obj.size[0] / 2
            actors.append(Actor(obj, centre, lane.y + offset, heading, speed))
            front = centre - direction * (obj.size[0] / 2 + DRAWBAR_M)
        yield actors


def _fill_side_street(rng, crossing: tuple[float, float], ground) -> Iterator[Actor]:
    """Yield vehicles in a side street that wait at the main street, drive away from it or cross it."""
    low, high = crossing
    parking_width = compute_parking_width(crossing)
    lane_offset = (high - low - 2 * parking_width) / 4 + parking_width
    for curb, direction in ((ground.curb_left, 1), (ground.curb_right, -1)):
        approach_x, exit_x = (low, high) if direction > 0 else (high, low)
        approach_x, exit_x = approach_x + direction * lane_offset, exit_x - direction * lane_offset
        y = curb + direction * rng.uniform(0.5, 1.0 + ground.sidewalk_width)
        while rng.random() < 0.5:
            obj = _draw_vehicles(rng, "road")[0]
            yield Actor(obj, approach_x, y + direction * obj.size[0] / 2, -direction * np.pi / 2)
            y += direction * (obj.size[0] + rng.uniform(1, 3))
        for chance, distance in ((0.25, rng.uniform(5, 50)), (0.3, -rng.uniform(15, 100))):
            if rng.random() < chance:
                yield Actor(
                    _draw_vehicles(rng, "road")[0],
                    exit_x,
                    curb + direction * distance,
                    direction * np.pi / 2,
                    rng.uniform(3, 9),
                )


def _park_vehicles(rng, side: Side, occupancy: float) -> Iterator[Actor]:
    """Yield vehicles parked at the curb, in driveways and in car parks; `occupancy` is the used fraction."""

    def make_parked_vehicle():
        pick = rng.random()
        if pick < 0.965:
            return (make_car if pick < 0.88 else make_van)(rng, driver=False)
        return (make_truck if pick < 0.99 else make_trailer)(rng)

    def park_in_row(offset, angle):
        spacing = 2.6 / abs(np.sin(angle))
        for position in np.arange(FREE_CORNER_M, side.length - FREE_CORNER_M, spacing):
            if rng.random() < occupancy:
                heading = angle + np.pi * (rng.random() < 0.3) + rng.normal(0, 0.03)
                yield side.place(make_car(rng, driver=False), position, offset + rng.normal(0, 0.15), heading)

    if side.parking_width > PARALLEL_STRIP_M:
        yield from park_in_row(-side.parking_width / 2 - 0.1, rng.choice([1.57, 2.2]))
    position = FREE_CORNER_M
    while side.parking_width == PARALLEL_STRIP_M and position < side.length - FREE_CORNER_M - 4:
        obj = make_parked_vehicle()
        if rng.random() < occupancy:
            heading = np.pi * (rng.random() < 0.95) + rng.normal(0, 0.025)
            yield side.place(obj, position + obj.size[0] / 2, -0.25 - obj.size[1] / 2 + rng.normal(0, 0.06), heading)
        position += obj.size[0] + rng.uniform(0.7, 1.8)
    if side.front == "garden":
        for position in draw_positions_along(rng, side.length, 6.0):
            yield side.place(
                make_car(rng, driver=False),
                position,
                side.sidewalk_width + rng.uniform(3, 6),
                rng.choice([-1, 1]) * np.pi / 2 + rng.normal(0, 0.04),
            )
    if side.front == "verge" and rng.random() < 0.35:
        yield from park_in_row(side.sidewalk_width + rng.uniform(5, 9), 1.57)


def _place_seats(rng, side: Side, rate: float, people: float) -> Iterator[list[Actor]]:
    """Yield benches with people at the wall, and pairs of people on cafe chairs."""
    for position in draw_positions_along(rng, side.length, 8 * rate):
        yield place_bench(rng, side, position, max(side.sidewalk_width - 0.7, 1.5), people, 0.2)
    for position in draw_positions_along(rng, side.length, rate * people):
        offset = side.sidewalk_width - rng.uniform(0.8, 2.5)
        for shift in rng.uniform((-0.9, 0.5), (-0.5, 0.9)):
            yield [
                side.place(make_sitting_person(rng), position + shift, offset, np.pi * (shift > 0) + rng.normal(0, 0.2))
            ]


def _place_riders(rng, street: Street, seconds: float, people: float) -> Iterator[Actor]:
    """Yield riders at the edges of the road, on sidewalks and on crossings, and parked bicycles."""
    ground, kind = street.ground, street.kind
    lanes = [lane for lane in street.lanes if lane.use == "cycle"]
    edge_lanes = [(lane.y, lane.direction) for lane in lanes] or [
        (ground.curb_right + ground.parking_width + 0.6, 1),
        (ground.curb_left - ground.parking_width - 0.6, -1),
    ]
    for y, direction in edge_lanes:
        speed = rng.uniform(3.5, 5.5)
        start = street.start - (street.speed * seconds if direction > 0 else 0.0)
        for x in start + draw_positions_along(rng, street.end - start, kind.riders * people * (2.0 if lanes else 1.0)):
            make = make_motorcyclist if rng.random() < MOTORCYCLIST_FRACTION else make_cyclist
            yield Actor(make(rng), x, y + rng.normal(0, 0.1), np.pi * (direction < 0), speed * rng.uniform(0.95, 1.05))
    for side in (*street.blocks, *_find_crosswalks(street)):
        for position in draw_positions_along(rng, side.length, kind.riders * people * 0.5):
            yield side.place(
                make_cyclist(rng),
                position,
                max(side.sidewalk_width, 1.0) * rng.uniform(0.5, 0.7),
                np.pi * rng.integers(2),
                speed=rng.uniform(2.0, 4.5),
            )
    for side in street.blocks:
        for position in draw_positions_along(rng, side.length, kind.clutter / 6 if side.sidewalk_width else 0.0):
            offset, heading = rng.choice([0.9, max(side.sidewalk_width - 1.0, 0.9)]), rng.normal(np.pi / 2, 0.2)
            make_parked = make_bicycle if rng.random() < 0.75 else make_motorcycle
            for i in range(rng.integers(1, 6)):
                yield side.place(make_parked(rng), position + 0.75 * i, offset, heading)


def _find_crosswalks(street: Street) -> list[Side]:
    """Return the sidewalks of the side streets, extended across the main street."""
    reach = 40.0
    return [
        Side(x, front_direction * reach, -front_direction * np.pi / 2, 2 * reach, CORNER_SIDEWALK_M, "")
        for crossing in street.ground.crossings
        for x, front_direction in zip(crossing, (-1, 1))
    ]
