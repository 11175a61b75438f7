"""Actors of a scene: objects that stand, or move along straight lines, and never collide."""

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
# Maximum distance of objects in a scan, and that of objects of at least LARGE_M.
SIGHT_M, FAR_SIGHT_M, LARGE_M = 80.0, 120.0, 5.0
STEP_S = 0.1  # time between the robot positions that others keep clear of


def make_prop(parts: np.ndarray) -> SceneObject:
    """Make an object without a label from parts (P,) PART."""
    return make_rigid(parts, (0.0, 0.0, 0.0), "")


@dataclass(frozen=True)
class Actor:
    """An object with its motion: straight ahead from time start to stop, standing before and after.

    Attributes:
        obj: The object.
        x, y: Position in the world at time 0, m.
        heading: rad.
        speed: m/s.
        start, stop: Times of the motion, s.
    """

    obj: SceneObject
    x: float
    y: float
    heading: float = 0.0
    speed: float = 0.0
    start: float = 0.0
    stop: float = np.inf

    @cached_property
    def footprint(self) -> np.ndarray:
        """Footprint (8,) float64, see X, Y, HEADING, ... below. It contains the labelled box in all poses."""
        x0, y0, _, x1, y1, _ = compute_hull(self.obj.parts(0.0), HEAD_ROOM_M)
        length, width, _ = self.obj.size
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


# Columns of a footprint: the rectangle around the parts of an actor below HEAD_ROOM_M, with its
# centre at time 0, half length and half width in m, and the motion of the actor.
X, Y, HEADING, LENGTH, WIDTH, SPEED, START, STOP = range(8)


@njit(cache=True, nogil=True)
def _touches_any(footprint, others, radii, seconds, gap):
    """Return True if a footprint touches any of others (M, 8), whose motion radii are radii (M,)."""
    radius = _motion_radius(footprint, seconds) + gap
    for m in range(len(others)):
        x, y, limit = others[m, X] - footprint[X], others[m, Y] - footprint[Y], radius + radii[m]
        if 0 <= limit and x * x + y * y <= limit * limit and footprints_touch(footprint, others[m], seconds, gap):
            return True
    return False


@njit(cache=True, nogil=True)
def _motion_radius(footprint, seconds):
    """Return the radius of a circle around the first centre of a footprint that it never leaves, in m."""
    return math.hypot(footprint[LENGTH], footprint[WIDTH]) + footprint[SPEED] * seconds


@njit(cache=True, nogil=True)
def footprints_touch(one, other, seconds, gap):
    """Return True if two footprints (8,) come within gap metres at any time in 0 .. seconds.

    Separating axis theorem for moving rectangles; exact for gap 0.
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
            width = gap
            for f in (one, other):
                rotation = angle - f[HEADING]
                width += f[LENGTH] * abs(math.cos(rotation)) + f[WIDTH] * abs(math.sin(rotation))
            distance = x * cos + y * sin
            change = (next_x - x) * cos + (next_y - y) * sin
            if abs(change) >= 1e-9:
                first, second = (-width - distance) / change, (width - distance) / change
                enter = max(enter, min(first, second))
                leave = min(leave, max(first, second))
            elif abs(distance) > width:
                enter = 2.0
        if enter <= leave:
            return True
    return False


@njit(cache=True, nogil=True)
def _compute_offset(one, other, t):
    """Return the vector from the centre of one to that of the other at time t."""
    moved = one[SPEED] * min(max(t - one[START], 0.0), one[STOP] - one[START])
    other_moved = other[SPEED] * min(max(t - other[START], 0.0), other[STOP] - other[START])
    return (
        other[X] + math.cos(other[HEADING]) * other_moved - one[X] - math.cos(one[HEADING]) * moved,
        other[Y] + math.sin(other[HEADING]) * other_moved - one[Y] - math.sin(one[HEADING]) * moved,
    )


@njit(cache=True, nogil=True)
def _touches_trajectory(footprint, trajectory, radius):
    """Return True if a footprint (8,) comes within radius of a sampled trajectory (T, 3), [t x y].

    Half of the motion between two samples is added to the radius.
    """
    cos, sin = math.cos(footprint[HEADING]), math.sin(footprint[HEADING])
    for k in range(len(trajectory)):
        (t, x, y), last = trajectory[k], trajectory[max(k - 1, 0)]
        step = footprint[SPEED] * (t - last[0]) + math.hypot(x - last[1], y - last[2])
        moved = footprint[SPEED] * min(max(t - footprint[START], 0.0), footprint[STOP] - footprint[START])
        x, y = x - footprint[X] - cos * moved, y - footprint[Y] - sin * moved
        ahead, aside = abs(cos * x + sin * y) - footprint[LENGTH], abs(cos * y - sin * x) - footprint[WIDTH]
        if math.hypot(max(ahead, 0.0), max(aside, 0.0)) < radius + step / 2:
            return True
    return False


class ActorSet:
    """Actors of a scene that never touch each other."""

    def __init__(
        self,
        seconds: float,
        keep_clear: np.ndarray | None = None,
        trajectory: Trajectory | None = None,
        radius: float = 0.0,
    ):
        """Create a set without actors.

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
        self._footprints, self._radii, self._count = np.empty((64, 8)), np.empty(64), 0
        for footprint in () if keep_clear is None else keep_clear:
            self._append(footprint)

    def admit(self, *group: Actor, gap: float = 0.1) -> bool:
        """Add a group of actors, unless they come within gap of other actors or the robot, or touch each other.

        Returns:
            True if the group was added.
        """
        before = self._count
        for actor in group:
            footprint, own = actor.footprint, slice(before, self._count)
            if (
                _touches_trajectory(footprint, self._path, self._radius + gap)
                or _touches_any(footprint, self._footprints[:before], self._radii, self.seconds, gap)
                or _touches_any(footprint, self._footprints[own], self._radii[own], self.seconds, 0.0)
            ):
                self._count = before
                return False
            self._append(footprint)
        self.actors += group
        return True

    def admit_each(self, actors: Iterable[Actor], gap: float = 0.1) -> None:
        """Add each of the actors that never comes within gap of others or the robot."""
        for actor in actors:
            self.admit(actor, gap=gap)

    def add(self, *group: Actor) -> None:
        """Add a group without a check, such as people on a bench."""
        self.actors += group
        for actor in group:
            self._append(actor.footprint)

    def _append(self, footprint: np.ndarray) -> None:
        if self._count == len(self._footprints):  # double the capacity
            self._footprints, self._radii = np.tile(self._footprints, (2, 1)), np.tile(self._radii, 2)
        self._footprints[self._count], self._radii[self._count] = footprint, _motion_radius(footprint, self.seconds)
        self._count += 1
