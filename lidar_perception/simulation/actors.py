"""Who is in a street: looks, straight ways, and room that nobody shares."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit

from lidar_perception.simulation.shapes.thing import Thing, rigid
from lidar_perception.simulation.solids import extents

HEAD_ROOM = 2.2  # metres; what hangs higher is in nobody's way
SIGHT, FAR_SIGHT = 80.0, 120.0  # metres from the sensor; what is farther is left out of a moment;
LARGE = 5.0                     # FAR_SIGHT is for what is so large, m


def prop(made: np.ndarray) -> Thing:
    """A thing without a label, of parts (P,) PART."""
    return rigid(made, (0.0, 0.0, 0.0), "")


@dataclass(frozen=True)
class Actor:
    """Something at x, y (world, time 0). It moves straight ahead at speed m/s from start to stop,
    in seconds, and stands before and after. What has no label is a thing with size (0, 0, 0)."""

    thing: Thing
    x: float
    y: float
    heading: float = 0.0
    speed: float = 0.0
    start: float = 0.0
    stop: float = np.inf

    @cached_property
    def footprint(self) -> np.ndarray:
        """(8,) float64, see below; holds the box of a walker, which covers all poses."""
        low, high = extents(self.thing.parts(0.0))
        below = low[:, 2] < HEAD_ROOM
        half = np.divide(self.thing.size[:2], 2)
        low = np.minimum(low[below, :2].min(axis=0), -half)
        high = np.maximum(high[below, :2].max(axis=0), half)
        (x, y), (length, width) = (low + high) / 2, (high - low) / 2
        cos, sin = np.cos(self.heading), np.sin(self.heading)
        return np.array([self.x + cos * x - sin * y, self.y + sin * x + cos * y, self.heading,
                         length, width, self.speed, self.start, self.stop])


# A footprint is a row [x y heading, half length, half width, speed, start, stop]: the rectangle
# around what of an actor is below HEAD_ROOM, x y its centre at time 0.
X, Y, HEADING, LENGTH, WIDTH, SPEED, START, STOP = range(8)


def centres(footprints: np.ndarray, t: np.ndarray) -> np.ndarray:
    """(M, T, 2) centres of footprints (M, 8) at times t (M, T) or (T,)."""
    f = footprints[:, None]
    way = f[..., SPEED] * np.clip(t - f[..., START], 0.0, f[..., STOP] - f[..., START])
    return np.stack([f[..., X] + np.cos(f[..., HEADING]) * way,
                     f[..., Y] + np.sin(f[..., HEADING]) * way], axis=-1)


def meet(one: np.ndarray, many: np.ndarray, seconds: float, gap: float = 0.0) -> np.ndarray:
    """(M,) bool: whether footprint one (8,) comes within gap metres of each of many (M, 8) at any
    time in 0 .. seconds. Exact for gap 0: convex shapes that slide along straight lines touch
    while their shadows on the normals of all sides do."""
    return _meet(np.ascontiguousarray(one), np.ascontiguousarray(many), seconds, gap)


@njit(cache=True, nogil=True)
def _meet(one, many, seconds, gap):
    met = np.zeros(len(many), np.bool_)
    times = np.empty(6)
    for m in range(len(many)):
        other = many[m]
        times[:] = (one[START], one[STOP], other[START], other[STOP], 0.0, seconds)
        for i in range(6):
            times[i] = min(max(times[i], 0.0), seconds)
        times.sort()
        for i in range(5):  # straight in between
            x, y = _apart(one, other, times[i])
            next_x, next_y = _apart(one, other, times[i + 1])
            enter, leave = 0.0, 1.0  # shares of this piece
            for side in range(4):
                angle = (one if side < 2 else other)[HEADING] + side % 2 * np.pi / 2
                cos, sin = np.cos(angle), np.sin(angle)
                reach = gap
                for f in (one, other):
                    turned = angle - f[HEADING]
                    reach += f[LENGTH] * abs(np.cos(turned)) + f[WIDTH] * abs(np.sin(turned))
                near = x * cos + y * sin
                change = (next_x - x) * cos + (next_y - y) * sin
                if abs(change) >= 1e-9:
                    one_end, other_end = (-reach - near) / change, (reach - near) / change
                    enter = max(enter, min(one_end, other_end))
                    leave = min(leave, max(one_end, other_end))
                elif abs(near) > reach:
                    enter = 2.0
            met[m] |= enter <= leave
    return met


@njit(cache=True, nogil=True)
def _apart(one, other, t):
    """From the centre of one to that of the other at time t."""
    way = one[SPEED] * min(max(t - one[START], 0.0), one[STOP] - one[START])
    other_way = other[SPEED] * min(max(t - other[START], 0.0), other[STOP] - other[START])
    return (other[X] + np.cos(other[HEADING]) * other_way
            - one[X] - np.cos(one[HEADING]) * way,
            other[Y] + np.sin(other[HEADING]) * other_way
            - one[Y] - np.sin(one[HEADING]) * way)


class Room:
    """The actors of a street so far; a newcomer must keep clear of all of them all the time."""

    def __init__(self, seconds: float, keep_clear: np.ndarray):
        """keep_clear (M, 8): footprints that are taken from the start."""
        self.seconds = seconds
        self.actors: list[Actor] = []
        self.taken = keep_clear

    def admit(self, *group: Actor, gap: float = 0.1) -> bool:
        """Adds the group if none of it ever comes within gap of anyone else, nor meets another of
        its own."""
        rows = np.array([a.footprint for a in group])
        if any(self._meets(row, self.taken, gap) or self._meets(row, rows[:i], 0.0)
               for i, row in enumerate(rows)):
            return False
        self.add(*group)
        return True

    def add(self, *group: Actor) -> None:
        """Adds a group unasked, such as people on a bench."""
        self.actors += group
        self.taken = np.concatenate([self.taken, *(a.footprint[None] for a in group)])

    def _meets(self, row: np.ndarray, taken: np.ndarray, gap: float) -> bool:
        reach = (np.hypot(row[LENGTH], row[WIDTH]) + np.hypot(taken[:, LENGTH], taken[:, WIDTH])
                 + (row[SPEED] + taken[:, SPEED]) * self.seconds + gap)
        near = np.hypot(taken[:, X] - row[X], taken[:, Y] - row[Y]) <= reach
        return bool(meet(row, taken[near], self.seconds, gap).any())
