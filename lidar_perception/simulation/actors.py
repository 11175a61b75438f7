"""Actors of a scene: things that move along straight lines and never collide."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from math import cos, sin

import numpy as np
from numba import njit

from lidar_perception.simulation.shapes.scene_object import SceneObject, make_rigid
from lidar_perception.simulation.solids import compute_hull
from lidar_perception.simulation.trajectory import Trajectory

HEAD_ROOM_M = 2.2  # parts above this height do not block anyone
SIGHT_M, FAR_SIGHT_M = 80.0, 120.0  # maximum distance of objects in a scan; the latter applies to
LARGE_M = 5.0  # objects of at least this size
STEP_S = 0.1  # time between the robot positions that others keep clear of


def make_prop(made: np.ndarray) -> SceneObject:
    """Return a thing without a label, of parts (P,) PART."""
    return make_rigid(made, (0.0, 0.0, 0.0), "")


@dataclass(frozen=True)
class Actor:
    """A thing at x, y in the world at time 0, in m.

    It moves straight ahead at speed (m/s) from start to stop (s), and stands before and after.
    Things without a label have size (0, 0, 0).
    """

    thing: SceneObject
    x: float
    y: float
    heading: float = 0.0
    speed: float = 0.0
    start: float = 0.0
    stop: float = np.inf

    @cached_property
    def footprint(self) -> np.ndarray:
        """Footprint (8,) float64, see below; for walkers it contains the box of all poses."""
        x0, y0, _, x1, y1, _ = compute_hull(self.thing.parts(0.0), HEAD_ROOM_M)
        length, width, _ = self.thing.size
        x0, x1 = min(x0, -length / 2), max(x1, length / 2)
        y0, y1 = min(y0, -width / 2), max(y1, width / 2)
        x, y = (x0 + x1) / 2, (y0 + y1) / 2
        ahead, aside = cos(self.heading), sin(self.heading)
        return np.array(
            [
                self.x + ahead * x - aside * y,
                self.y + aside * x + ahead * y,
                self.heading,
                (x1 - x0) / 2,
                (y1 - y0) / 2,
                self.speed,
                self.start,
                self.stop,
            ]
        )


# A footprint is a row [x y heading, half length, half width, speed, start, stop]: the rectangle
# around the parts of an actor below HEAD_ROOM_M, with its centre x y at time 0.
X, Y, HEADING, LENGTH, WIDTH, SPEED, START, STOP = range(8)


@njit(cache=True, nogil=True)
def _touches_any(one, many, reach, seconds, gap):
    """Return True if one touches any of many; reach (M,): _max_reach of these."""
    far = _max_reach(one, seconds) + gap
    for m in range(len(many)):
        x, y, near = many[m, X] - one[X], many[m, Y] - one[Y], far + reach[m]
        if 0 <= near and x * x + y * y <= near * near and footprints_touch(one, many[m], seconds, gap):
            return True
    return False


@njit(cache=True, nogil=True)
def _max_reach(one, seconds):
    """Return the largest distance from its first centre that a footprint ever reaches."""
    return math.hypot(one[LENGTH], one[WIDTH]) + one[SPEED] * seconds


@njit(cache=True, nogil=True)
def footprints_touch(one, other, seconds, gap):
    """Return True if two footprints (8,) ever come within gap metres in 0 .. seconds.

    Exact for gap 0: convex shapes that slide along straight lines touch while their projections on
    the normals of all sides do.
    """
    times = np.empty(6)
    times[:] = (one[START], one[STOP], other[START], other[STOP], 0.0, seconds)
    for i in range(6):
        times[i] = min(max(times[i], 0.0), seconds)
    times.sort()
    for i in range(5):  # motion is linear between these times
        x, y = _compute_offset(one, other, times[i])
        next_x, next_y = _compute_offset(one, other, times[i + 1])
        enter, leave = 0.0, 1.0  # start and end of the overlap, as fractions of this interval
        for side in range(4):
            angle = (one if side < 2 else other)[HEADING] + side % 2 * np.pi / 2
            cos, sin = math.cos(angle), math.sin(angle)
            reach = gap
            for f in (one, other):
                turned = angle - f[HEADING]
                reach += f[LENGTH] * abs(math.cos(turned)) + f[WIDTH] * abs(math.sin(turned))
            near = x * cos + y * sin
            change = (next_x - x) * cos + (next_y - y) * sin
            if abs(change) >= 1e-9:
                one_end, other_end = (-reach - near) / change, (reach - near) / change
                enter = max(enter, min(one_end, other_end))
                leave = min(leave, max(one_end, other_end))
            elif abs(near) > reach:
                enter = 2.0
        if enter <= leave:
            return True
    return False


@njit(cache=True, nogil=True)
def _compute_offset(one, other, t):
    """Return the vector from the centre of one to that of the other at time t."""
    way = one[SPEED] * min(max(t - one[START], 0.0), one[STOP] - one[START])
    other_way = other[SPEED] * min(max(t - other[START], 0.0), other[STOP] - other[START])
    return (
        other[X] + math.cos(other[HEADING]) * other_way - one[X] - math.cos(one[HEADING]) * way,
        other[Y] + math.sin(other[HEADING]) * other_way - one[Y] - math.sin(one[HEADING]) * way,
    )


@njit(cache=True, nogil=True)
def _touches_trajectory(one, way, radius):
    """Return True if a footprint (8,) comes within radius of a trajectory (T, 3), [t x y].

    Both move between the samples, so half the distance of a step is added.
    """
    cos, sin = math.cos(one[HEADING]), math.sin(one[HEADING])
    for k in range(len(way)):
        t, last = way[k, 0], way[max(k - 1, 0)]
        moved = one[SPEED] * min(max(t - one[START], 0.0), one[STOP] - one[START])
        x, y = way[k, 1] - one[X] - cos * moved, way[k, 2] - one[Y] - sin * moved
        outside = math.hypot(
            max(abs(cos * x + sin * y) - one[LENGTH], 0.0), max(abs(cos * y - sin * x) - one[WIDTH], 0.0)
        )
        covered = one[SPEED] * (t - last[0]) + math.hypot(way[k, 1] - last[1], way[k, 2] - last[2])
        if outside < radius + covered / 2:
            return True
    return False


class ActorSet:
    """Actors of a scene, to which others are admitted if they never touch them."""

    def __init__(
        self,
        seconds: float,
        keep_clear: np.ndarray | None = None,
        trajectory: Trajectory | None = None,
        radius: float = 0.0,
    ):
        """Start without actors.

        Args:
            seconds: Duration of the drive.
            keep_clear: (M, 8) footprints to keep clear of.
            trajectory: Trajectory of a round robot; None without one.
            radius: Radius of the robot, m.
        """
        self.seconds = seconds
        self._path = np.empty((0, 3)) if trajectory is None else trajectory.sample(seconds, STEP_S)
        self._radius = radius
        self.actors: list[Actor] = []
        self._taken, self._reach, self._used = np.empty((64, 8)), np.empty(64), 0
        for row in () if keep_clear is None else keep_clear:
            self._take(row)

    def admit(self, *group: Actor, gap: float = 0.1) -> bool:
        """Add a group if it never comes within gap of other actors or the robot, or touches itself."""
        before = self._used
        for actor in group:
            row, own = actor.footprint, slice(before, self._used)
            if (
                _touches_trajectory(row, self._path, self._radius + gap)
                or _touches_any(row, self._taken[:before], self._reach, self.seconds, gap)
                or _touches_any(row, self._taken[own], self._reach[own], self.seconds, 0.0)
            ):
                self._used = before
                return False
            self._take(row)
        self.actors += group
        return True

    def admit_each(self, actors: Iterable[Actor], gap: float = 0.1) -> None:
        """Add each actor that never comes within gap of others or the robot."""
        for actor in actors:
            self.admit(actor, gap=gap)

    def add(self, *group: Actor) -> None:
        """Add a group without a check, such as people on a bench."""
        self.actors += group
        for actor in group:
            self._take(actor.footprint)

    def _take(self, row: np.ndarray) -> None:
        if self._used == len(self._taken):  # double the capacity
            self._taken, self._reach = np.tile(self._taken, (2, 1)), np.tile(self._reach, 2)
        self._taken[self._used], self._reach[self._used] = row, _max_reach(row, self.seconds)
        self._used += 1
