"""Kinds of streets, and layouts of their lanes, sidewalks and side streets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lidar_perception.simulation.places import Side
from lidar_perception.simulation.terrain import Ground

BEHIND_M, AHEAD_M = 100.0, 130.0  # length of the street before the start and after the end of a drive
CORNER_SIDEWALK_M = 2.5  # width of the sidewalk along a side street
SIDE_STREET_LENGTH_M = 60.0
# Widths of parking strips for parallel and perpendicular parking.
PARALLEL_STRIP_M, PERPENDICULAR_STRIP_M = 2.2, 5.0


@dataclass(frozen=True)
class StreetKind:
    """Parameters of a kind of street.

    Pairs (low, high) are the ranges of uniform distributions. Lengths are in m, speeds in m/s, and
    numbers of objects and people per 100 m.
    """

    fraction: float  # fraction of streets of this kind; not taken from data
    fronts: dict[str, float]  # probability of each kind of roadside, see roadside.py
    lane_width: tuple[float, float] = (3.0, 3.5)
    extra_lanes: tuple[int, int] = (0, 1)  # number of additional lanes in the ego direction, upper bound excluded
    oncoming_lanes: tuple[int, int] = (1, 2)
    tram_chance: float = 0.0  # probability of tram tracks
    cycle_lane_chance: float = 0.0  # probability of a bicycle lane
    parking_chance: float = 0.0  # probability of parking strips
    perpendicular_chance: float = 0.0  # probability of perpendicular parking
    sidewalk_width: tuple[float, float] = (1.6, 3.0)
    curb_height: float = 0.12
    crossing_distance: tuple[float, float] = (50.0, 120.0)  # distance from one side street to the next
    speed: tuple[float, float] = (3.0, 13.0)
    stop_chance: float = 0.15  # probability that the traffic of a lane stands still
    headway: float = 5.0  # mean time between vehicles in a lane, in addition to the minimum, s
    # Objects per 100 m on each side; clutter is small objects.
    lamps: float = 3.0
    trees: float = 4.0
    clutter: float = 4.0
    walkers: float = 3.3
    standers: float = 0.12
    benches: float = 0.05
    riders: float = 0.3


STREET_KINDS = {
    "city": StreetKind(
        0.28,
        {"facade": 0.4, "garden": 0.2, "verge": 0.4},
        cycle_lane_chance=0.25,
        parking_chance=0.65,
        perpendicular_chance=0.15,
        sidewalk_width=(2.0, 4.5),
        tram_chance=0.05,
        clutter=7,
        walkers=4.8,
        standers=0.17,
        riders=0.5,
        crossing_distance=(45, 100),
    ),
    "residential": StreetKind(
        0.30,
        {"garden": 0.8, "facade": 0.1, "verge": 0.1},
        lane_width=(2.8, 3.2),
        parking_chance=0.5,
        sidewalk_width=(1.5, 2.4),
        speed=(2.0, 9.0),
        headway=12.0,
        trees=3.0,
        stop_chance=0.1,
        walkers=1.3,
        standers=0.05,
        benches=0.02,
        riders=0.3,
    ),
    "arterial": StreetKind(
        0.20,
        {"verge": 0.8, "facade": 0.1, "wild": 0.1},
        lane_width=(3.2, 3.7),
        extra_lanes=(0, 2),
        oncoming_lanes=(1, 3),
        tram_chance=0.4,
        cycle_lane_chance=0.4,
        parking_chance=0.15,
        sidewalk_width=(2.0, 3.5),
        crossing_distance=(90, 200),
        speed=(5.0, 14.0),
        headway=3.0,
        trees=5.0,
        walkers=1.3,
        riders=0.5,
    ),
    "country": StreetKind(
        0.13,
        {"wild": 1.0},
        sidewalk_width=(0.0, 0.0),
        curb_height=0.0,
        crossing_distance=(150, 400),
        speed=(7.0, 14.0),
        stop_chance=0.05,
        headway=5.0,
        lamps=0.5,
        trees=0.0,
        clutter=1.0,
        walkers=0.2,
        standers=0.0,
        benches=0.0,
        riders=0.2,
    ),
    "zone": StreetKind(
        0.09,
        {"facade": 0.6, "square": 0.4},
        sidewalk_width=(4.0, 8.0),
        curb_height=0.03,
        tram_chance=0.1,
        speed=(0.5, 3.5),
        stop_chance=0.4,
        headway=40.0,
        trees=3.0,
        clutter=8.0,
        walkers=13.2,
        standers=0.5,
        benches=0.3,
        riders=1.5,
        crossing_distance=(40, 80),
        parking_chance=0.1,
    ),
}


class Lane(NamedTuple):
    """A lane, parallel to the x axis.

    Attributes:
        y: Position of the centre line, m.
        direction: 1 or -1 along x.
        speed: Speed of its traffic, m/s.
        use: "road", "rail" or "cycle".
    """

    y: float
    direction: int
    speed: float
    use: str = "road"


class Street(NamedTuple):
    """Layout of a street along x.

    Attributes:
        kind: Parameters of the street.
        ground: The ground.
        lanes: Lanes, the lane of the ego vehicle first.
        blocks: Curbs of the street between the crossings.
        side_curbs: Curbs of the side streets.
        speed: Speed of the ego vehicle, m/s.
        start, end: x of the ends of the street, m.
    """

    kind: StreetKind
    ground: Ground
    lanes: tuple[Lane, ...]
    blocks: tuple[Side, ...]
    side_curbs: tuple[Side, ...]
    speed: float
    start: float
    end: float


def draw_street(rng: np.random.Generator, kind: StreetKind, seconds: float) -> Street:
    """Draw a street that is long enough for a drive of `seconds`."""
    speed = 0.0 if rng.random() < kind.stop_chance else rng.uniform(*kind.speed)
    start, end = -BEHIND_M, speed * seconds + AHEAD_M
    parking_width = 0.0
    if rng.random() < kind.parking_chance:
        parking_width = PERPENDICULAR_STRIP_M if rng.random() < kind.perpendicular_chance else PARALLEL_STRIP_M
    lanes, right, left = _draw_lanes(rng, kind, speed, parking_width)
    sidewalk_width, crossings = rng.uniform(*kind.sidewalk_width), _draw_crossings(rng, kind, start, end)
    # Slopes as in 27 scans of KITTI: 0.67 +- 0.2 degrees along the road (includes the sensor's pitch),
    # 0 +- 0.45 degrees across it. The heights of grass and litter give a roughness as in KITTI next to the
    # road: the residual of plane fits to cells of 1 m, 5 to 40 m away, is above 1 cm in 36 to 52 % of the
    # cells (KITTI: 42 to 49 %). Waves, camber and reflectances are guesses.
    slope_x, slope_y = np.tan(np.radians(rng.normal((0.6, 0.05), (0.25, 0.4))))
    ground = Ground(
        slope_x,
        slope_y,
        wave_height=rng.uniform(0.03, 0.16),
        wavelength=rng.uniform(25, 60),
        camber=rng.uniform(0.01, 0.035),
        curb_left=left,
        curb_right=right,
        curb_height=kind.curb_height * rng.uniform(0.6, 1.2),
        sidewalk_width=sidewalk_width,
        crossings=crossings,
        parking_width=parking_width,
        tuft_height=rng.uniform(0.2, 0.8),
        road_reflectance=rng.uniform(0.23, 0.38),
        sidewalk_reflectance=rng.uniform(0.33, 0.48),
        grass_reflectance=rng.uniform(0.3, 0.4),
    )
    ground = ground._replace(litter_height=ground.tuft_height - 0.2)  # streets with high grass also have more litter
    names, weights = list(kind.fronts), list(kind.fronts.values())
    fronts = rng.choice(names, 2, p=weights)
    edges = [start, *np.ravel(crossings), end]
    blocks = []
    for low, high in zip(edges[::2], edges[1::2]):
        for y, heading, front in ((left, 0.0, fronts[0]), (right, np.pi, fronts[1])):
            front = front if rng.random() < 0.7 else rng.choice(names, p=weights)
            blocks.append(
                Side(low if y > 0 else high, y, heading, high - low, sidewalk_width, str(front), parking_width)
            )
    side_curbs = [
        _make_side_curb(
            rng.choice(fronts), x, front_direction, curb, direction, sidewalk_width, compute_parking_width(crossing)
        )
        for crossing in crossings
        for curb, direction in ((left, 1), (right, -1))
        for x, front_direction in zip(crossing, (-1, 1))
    ]
    return Street(kind, ground, lanes, tuple(blocks), tuple(side_curbs), speed, start, end)


def _draw_lanes(rng, kind: StreetKind, speed: float, parking_width: float) -> tuple[tuple[Lane, ...], float, float]:
    """Draw the lanes, the lane of the ego vehicle first, and the y of the right and the left curb."""
    width = rng.uniform(*kind.lane_width)
    lanes, right = [Lane(0.0, 1, speed)], -width / 2
    for _ in range(rng.integers(*kind.extra_lanes)):
        lanes.append(Lane(right - width / 2, 1, _draw_lane_speed(rng, kind)))
        right -= width
    left, uses = width / 2, ["road"] * rng.integers(*kind.oncoming_lanes)
    directions = [-1] * len(uses)
    if rng.random() < kind.tram_chance:
        uses, directions = ["rail", "rail", *uses], [1, -1, *directions]
    for lane_use, direction in zip(uses, directions):
        lanes.append(Lane(left + width / 2, direction, _draw_lane_speed(rng, kind), lane_use))
        left += width
    cycle_lane_width = 1.6 if rng.random() < kind.cycle_lane_chance else 0.0
    if cycle_lane_width:
        lanes += [
            Lane(right - cycle_lane_width / 2, 1, 5.0, "cycle"),
            Lane(left + cycle_lane_width / 2, -1, 5.0, "cycle"),
        ]
    margin = cycle_lane_width + parking_width + rng.uniform(0.1, 0.6)
    return tuple(lanes), right - margin, left + margin


def _draw_lane_speed(rng, kind: StreetKind) -> float:
    return 0.0 if rng.random() < kind.stop_chance else rng.uniform(*kind.speed)


def _draw_crossings(rng, kind: StreetKind, start: float, end: float) -> tuple[tuple[float, float], ...]:
    """Draw the x intervals (low, high) of the side streets."""
    crossings, x = [], start + rng.uniform(0.1, 1.0) * kind.crossing_distance[1]
    while x < end - 20:
        width = rng.uniform(5.5, 7.0) + 2 * PARALLEL_STRIP_M * (rng.random() < kind.parking_chance)
        crossings.append((x, x + width))
        x += width + rng.uniform(*kind.crossing_distance)
    return tuple(crossings)


def _make_side_curb(
    front: str,
    x: float,
    front_direction: int,
    street_curb: float,
    direction: int,
    sidewalk_width: float,
    parking_width: float,
) -> Side:
    """Return one curb of a side street, at x.

    The side street begins at the main street's curb (y) and continues in `direction` along y. The front of
    the curb is on the side `front_direction` along x.
    """
    start = street_curb + direction * (sidewalk_width + 9.0)
    return Side(
        x,
        start if direction == -front_direction else start + direction * SIDE_STREET_LENGTH_M,
        -front_direction * np.pi / 2,
        SIDE_STREET_LENGTH_M,
        CORNER_SIDEWALK_M,
        str(front),
        parking_width,
    )


def compute_parking_width(crossing: tuple[float, float]) -> float:
    """Return the width of the parking strips of a side street, in m."""
    return PARALLEL_STRIP_M if crossing[1] - crossing[0] > 8.0 else 0.0
