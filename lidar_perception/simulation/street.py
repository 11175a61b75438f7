"""Kinds of streets, and the layout of their lanes, sidewalks and side streets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lidar_perception.simulation.places import Side
from lidar_perception.simulation.terrain import Ground

BEHIND_M, AHEAD_M = 100.0, 130.0  # street behind the start and beyond the end of a drive
CORNER_WALK_M = 2.5  # width of the sidewalk along a side street, m
ARM_LENGTH_M = 60.0  # length of a side street, m
# Widths of parking strips for parallel and perpendicular parking.
PARALLEL_STRIP_M, ACROSS_STRIP_M = 2.2, 5.0


@dataclass(frozen=True)
class StreetKind:
    """Parameters of a kind of street.

    Pairs (low, high) are the ranges of uniform distributions. Lengths are in m, speeds in m/s, and
    numbers of objects and people per 100 m.
    """

    share: float  # fraction of streets of this kind, a free choice
    fronts: dict[str, float]  # weights of the kinds of roadside, see roadside.py
    lane: tuple[float, float] = (3.0, 3.5)
    extra_lanes: tuple[int, int] = (0, 1)  # number of additional lanes in our direction, upper bound excluded
    oncoming: tuple[int, int] = (1, 2)
    rails: float = 0.0  # probability of tram tracks
    cycle: float = 0.0  # probability of a bicycle lane
    parking: float = 0.0  # probability of parking strips
    across: float = 0.0  # probability of perpendicular parking
    occupied: tuple[float, float] = (0.0, 0.6)
    walk: tuple[float, float] = (1.6, 3.0)
    curb: float = 0.12
    crossing: tuple[float, float] = (50.0, 120.0)  # distance from one side street to the next
    speed: tuple[float, float] = (3.0, 13.0)
    stands: float = 0.15  # probability that the traffic of a lane stands still
    headway: float = 5.0  # mean time between vehicles of a lane beyond the minimum, s
    lamp: float = 3.0  # objects per 100 m on each side: lamps (tree, clutter: trees, small objects)
    tree: float = 4.0
    clutter: float = 4.0
    islands: float = 0.3  # probability that a crossing has islands between the directions
    walkers: float = 3.3
    standers: float = 0.12
    seats: float = 0.05
    riders: float = 0.3


STREET_KINDS = {
    "city": StreetKind(
        0.28,
        {"facade": 0.4, "garden": 0.2, "verge": 0.4},
        cycle=0.25,
        parking=0.65,
        across=0.15,
        walk=(2.0, 4.5),
        rails=0.05,
        clutter=7,
        walkers=4.8,
        standers=0.17,
        riders=0.5,
        crossing=(45, 100),
    ),
    "residential": StreetKind(
        0.30,
        {"garden": 0.8, "facade": 0.1, "verge": 0.1},
        lane=(2.8, 3.2),
        parking=0.5,
        walk=(1.5, 2.4),
        speed=(2.0, 9.0),
        headway=12.0,
        tree=3.0,
        stands=0.1,
        walkers=1.3,
        standers=0.05,
        seats=0.02,
        riders=0.3,
    ),
    "arterial": StreetKind(
        0.20,
        {"verge": 0.8, "facade": 0.1, "wild": 0.1},
        lane=(3.2, 3.7),
        extra_lanes=(0, 2),
        oncoming=(1, 3),
        rails=0.4,
        cycle=0.4,
        parking=0.15,
        walk=(2.0, 3.5),
        crossing=(90, 200),
        speed=(5.0, 14.0),
        headway=3.0,
        tree=5.0,
        walkers=1.3,
        riders=0.5,
    ),
    "country": StreetKind(
        0.13,
        {"wild": 1.0},
        walk=(0.0, 0.0),
        curb=0.0,
        crossing=(150, 400),
        speed=(7.0, 14.0),
        stands=0.05,
        headway=5.0,
        lamp=0.5,
        tree=0.0,
        clutter=1.0,
        walkers=0.2,
        standers=0.0,
        seats=0.0,
        riders=0.2,
    ),
    "zone": StreetKind(
        0.09,
        {"facade": 0.6, "square": 0.4},
        walk=(4.0, 8.0),
        curb=0.03,
        rails=0.1,
        speed=(0.5, 3.5),
        stands=0.4,
        headway=40.0,
        tree=3.0,
        clutter=8.0,
        walkers=13.2,
        standers=0.5,
        seats=0.3,
        riders=1.5,
        crossing=(40, 80),
        parking=0.1,
    ),
}


class Lane(NamedTuple):
    """A lane.

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
        lanes: Lanes; the first is that of the ego vehicle.
        blocks: Curbs between the crossings.
        arms: Curbs of the side streets.
        speed: Speed of the ego vehicle, m/s.
        start, end: x of both ends, m.
    """

    kind: StreetKind
    ground: Ground
    lanes: tuple[Lane, ...]
    blocks: tuple[Side, ...]
    arms: tuple[Side, ...]
    speed: float
    start: float
    end: float


def draw_street(rng: np.random.Generator, kind: StreetKind, seconds: float) -> Street:
    """Draw a street that is long enough for a drive of this duration."""
    speed = 0.0 if rng.random() < kind.stands else rng.uniform(*kind.speed)
    start, end = -BEHIND_M, speed * seconds + AHEAD_M
    parking = 0.0
    if rng.random() < kind.parking:
        parking = ACROSS_STRIP_M if rng.random() < kind.across else PARALLEL_STRIP_M
    lanes, right, left = _draw_lanes(rng, kind, speed, parking)
    walk, crossings = rng.uniform(*kind.walk), _draw_crossings(rng, kind, start, end)
    # Slopes as in 27 scans of KITTI: 0.67 +- 0.2 degrees ahead (pitch of the sensor), +- 0.45 aside.
    # Heights of grass and litter give the roughness of KITTI's ground next to the road: the residual of
    # plane fits to cells of 1 m, 5 to 40 m away, is more than 1 cm in 36 to 52 % of the cells (real: 42
    # to 49). Wave, camber and reflectances are guesses.
    slope_x, slope_y = np.tan(np.radians(rng.normal((0.6, 0.05), (0.25, 0.4))))
    ground = Ground(
        slope_x,
        slope_y,
        wave=rng.uniform(0.03, 0.16),
        wavelength=rng.uniform(25, 60),
        camber=rng.uniform(0.01, 0.035),
        curb_left=left,
        curb_right=right,
        curb_height=kind.curb * rng.uniform(0.6, 1.2),
        walk=walk,
        crossings=crossings,
        parking=parking,
        rough=rng.uniform(0.2, 0.8),
        road=rng.uniform(0.23, 0.38),
        sidewalk=rng.uniform(0.33, 0.48),
        grass=rng.uniform(0.3, 0.4),
    )
    ground = ground._replace(litter=ground.rough - 0.2)  # high grass comes with unswept pavement
    names, weights = list(kind.fronts), list(kind.fronts.values())
    fronts = rng.choice(names, 2, p=weights)
    edges = [start, *np.ravel(crossings), end]
    blocks = []
    for low, high in zip(edges[::2], edges[1::2]):
        for y, heading, front in ((left, 0.0, fronts[0]), (right, np.pi, fronts[1])):
            front = front if rng.random() < 0.7 else rng.choice(names, p=weights)
            blocks.append(Side(low if y > 0 else high, y, heading, high - low, walk, str(front), parking))
    arms = [
        _make_arm(rng.choice(fronts), x, land, curb, up, walk, parking_width(crossing))
        for crossing in crossings
        for curb, up in ((left, 1), (right, -1))
        for x, land in zip(crossing, (-1, 1))
    ]
    return Street(kind, ground, lanes, tuple(blocks), tuple(arms), speed, start, end)


def _draw_lanes(rng, kind: StreetKind, speed: float, parking: float) -> tuple[tuple[Lane, ...], float, float]:
    """Draw the lanes, beginning with that of the ego vehicle, and the y of the right and the left curb."""
    width = rng.uniform(*kind.lane)
    lanes, right = [Lane(0.0, 1, speed)], -width / 2
    for _ in range(rng.integers(*kind.extra_lanes)):
        lanes.append(Lane(right - width / 2, 1, _draw_lane_speed(rng, kind)))
        right -= width
    left, use = width / 2, ["road"] * rng.integers(*kind.oncoming)
    ways = [-1] * len(use)
    if rng.random() < kind.rails:
        use, ways = ["rail", "rail", *use], [1, -1, *ways]
    for lane_use, direction in zip(use, ways):
        lanes.append(Lane(left + width / 2, direction, _draw_lane_speed(rng, kind), lane_use))
        left += width
    strip = 1.6 if rng.random() < kind.cycle else 0.0
    if strip:
        lanes += [Lane(right - strip / 2, 1, 5.0, "cycle"), Lane(left + strip / 2, -1, 5.0, "cycle")]
    edge = strip + parking + rng.uniform(0.1, 0.6)
    return tuple(lanes), right - edge, left + edge


def _draw_lane_speed(rng, kind: StreetKind) -> float:
    return 0.0 if rng.random() < kind.stands else rng.uniform(*kind.speed)


def _draw_crossings(rng, kind: StreetKind, start: float, end: float) -> tuple[tuple[float, float], ...]:
    """Draw the x intervals (low, high) of side streets, not near the ends."""
    crossings, x = [], start + rng.uniform(0.1, 1.0) * kind.crossing[1]
    while x < end - 20:
        width = rng.uniform(5.5, 7.0) + 2 * PARALLEL_STRIP_M * (rng.random() < kind.parking)
        crossings.append((x, x + width))
        x += width + rng.uniform(*kind.crossing)
    return tuple(crossings)


def _make_arm(front: str, x: float, land: int, curb: float, up: int, walk: float, parking: float) -> Side:
    """Return one curb of a side street.

    Args:
        front: Type of its front.
        x: Position, m.
        land: 1 or -1, side of the front along x.
        curb: y of the street's curb at which the side street begins, m.
        up: 1 or -1, direction of the side street along y.
        walk: Width of the street's sidewalk, m.
        parking: Width of the parking strip, m.
    """
    near = curb + up * (walk + 9.0)
    return Side(
        x,
        near if up == -land else near + up * ARM_LENGTH_M,
        -land * np.pi / 2,
        ARM_LENGTH_M,
        CORNER_WALK_M,
        str(front),
        parking,
    )


def parking_width(crossing: tuple[float, float]) -> float:
    """Return the width of the parking strips of a side street, in m."""
    return PARALLEL_STRIP_M if crossing[1] - crossing[0] > 8.0 else 0.0
