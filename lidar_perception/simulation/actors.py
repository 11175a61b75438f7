"""Actors of a scene: objects that stand still or move along straight lines, without collisions."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from math import cos, sin

import numpy as np
from numba import njit

from lidar_perception.simulation.shapes.scene_object import SceneObject, make_rigid
from lidar_perception.simulation.solids import compute_hull
from lidar_perception.simulation.trajectory import Trajectory

HEAD_ROOM_M = 2.2  # height above which parts do not block other actors
# Maximum distance of objects in a scan, and of those that are larger than LARGE_M.
SIGHT_M, FAR_SIGHT_M, LARGE_M = 80.0, 120.0, 5.0
SLIDE_STEP_M = 0.05  # step of the search for a place next to another actor
STEP_S = 0.1  # time step of the robot's trajectory in collision checks


def make_prop(parts: np.ndarray) -> SceneObject:
    """Make an object without a label from parts (P,) PART."""
    return make_rigid(parts, (0.0, 0.0, 0.0), "")


@dataclass(frozen=True)
class Actor:
    """An object that moves straight ahead between the times start and stop, and stands still otherwise.

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
        """Footprint (8,) float64, see X, Y, HEADING, ... below. It contains the labelled box in every pose."""
        x0, y0, _, x1, y1, _ = compute_hull(self.obj.parts(0.0), HEAD_ROOM_M)
        length, width, _ = self.obj.size
        x0, x1 = min(x0, -length / 2), max(x1, length / 2)
        y0, y1 = min(y0, -width / 2), max(y1, width / 2)
        x, y = (x0 + x1) / 2, (y0 + y1) / 2
        cos_heading, sin_heading = cos(self.heading), sin(self.heading)
        return np.array(
            [
                self.x + cos_heading * x - sin_heading * y,
                self.y + sin_heading * x + cos_heading * y,
                self.heading,
                (x1 - x0) / 2,
                (y1 - y0) / 2,
                self.speed,
                self.start,
                self.stop,
            ]
        )


# Columns of a footprint, the rectangle around the parts of an actor below HEAD_ROOM_M: its centre at
# time 0, its half length and half width in m, and the motion of the actor.
X, Y, HEADING, LENGTH, WIDTH, SPEED, START, STOP = range(8)


@njit(cache=True, nogil=True)
def _touches_any(footprint, others, radii, seconds, gap):
    """Return True if a footprint touches any of the others (M, 8), which have the motion radii (M,)."""
    radius = _compute_motion_radius(footprint, seconds) + gap
    for m in range(len(others)):
        x, y, limit = others[m, X] - footprint[X], others[m, Y] - footprint[Y], radius + radii[m]
        if 0 <= limit and x * x + y * y <= limit * limit and footprints_touch(footprint, others[m], seconds, gap):
            return True
    return False


@njit(cache=True, nogil=True)
def _compute_motion_radius(footprint, seconds):
    """Return the radius of a circle around the initial centre that a footprint never leaves, in m."""
    return math.hypot(footprint[LENGTH], footprint[WIDTH]) + footprint[SPEED] * seconds


@njit(cache=True, nogil=True)
def footprints_touch(one, other, seconds, gap):
    """Return True if two footprints (8,) come within gap metres at any time in 0 .. seconds.

    This uses the separating axis theorem for moving rectangles, and is exact for gap 0.
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
                first_contact, second_contact = (-width - distance) / change, (width - distance) / change
                enter = max(enter, min(first_contact, second_contact))
                leave = min(leave, max(first_contact, second_contact))
            elif abs(distance) > width:
                enter = 2.0
        if enter <= leave:
            return True
    return False


@njit(cache=True, nogil=True)
def _compute_offset(one, other, t):
    """Return the vector from the centre of `one` to the centre of `other` at time t."""
    distance = one[SPEED] * min(max(t - one[START], 0.0), one[STOP] - one[START])
    other_distance = other[SPEED] * min(max(t - other[START], 0.0), other[STOP] - other[START])
    return (
        other[X] + math.cos(other[HEADING]) * other_distance - one[X] - math.cos(one[HEADING]) * distance,
        other[Y] + math.sin(other[HEADING]) * other_distance - one[Y] - math.sin(one[HEADING]) * distance,
    )


@njit(cache=True, nogil=True)
def _touches_trajectory(footprint, trajectory, radius):
    """Return True if a footprint (8,) comes within `radius` of a sampled trajectory (T, 3), [t x y].

    Half of the motion between two samples is added to the radius.
    """
    cos, sin = math.cos(footprint[HEADING]), math.sin(footprint[HEADING])
    for k in range(len(trajectory)):
        (t, x, y), previous = trajectory[k], trajectory[max(k - 1, 0)]
        step = footprint[SPEED] * (t - previous[0]) + math.hypot(x - previous[1], y - previous[2])
        distance = footprint[SPEED] * min(max(t - footprint[START], 0.0), footprint[STOP] - footprint[START])
        x, y = x - footprint[X] - cos * distance, y - footprint[Y] - sin * distance
        dx, dy = abs(cos * x + sin * y) - footprint[LENGTH], abs(cos * y - sin * x) - footprint[WIDTH]
        if math.hypot(max(dx, 0.0), max(dy, 0.0)) < radius + step / 2:
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
            trajectory: Trajectory of a round robot to keep clear of; None without a robot.
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
        """Add a group of actors if it never comes within `gap` of others, and its members never touch.

        Returns:
            True if the group was added.
        """
        old_count = self._count
        for actor in group:
            footprint, group_slice = actor.footprint, slice(old_count, self._count)
            if (
                _touches_trajectory(footprint, self._path, self._radius + gap)
                or _touches_any(footprint, self._footprints[:old_count], self._radii, self.seconds, gap)
                or _touches_any(footprint, self._footprints[group_slice], self._radii[group_slice], self.seconds, 0.0)
            ):
                self._count = old_count
                return False
            self._append(footprint)
        self.actors += group
        return True

    def admit_each(self, actors: Iterable[Actor], gap: float = 0.1) -> None:
        """Add each actor that never comes within `gap` of the others or the robot."""
        for actor in actors:
            self.admit(actor, gap=gap)

    def admit_next_to_other(self, actor: Actor, direction: float, distance: float, gap: float) -> bool:
        """Move an actor in a direction until it is next to another actor, and add it there.

        Args:
            actor: The actor, which stands still.
            direction: Direction in the world, rad.
            distance: Maximum distance, m.
            gap: Gap to the other actor, m.

        Returns:
            True if the actor was added; False if its place is taken or no other actor is within the distance.
        """
        footprint = actor.footprint.copy()
        step = SLIDE_STEP_M * np.array([cos(direction), sin(direction)])
        others, radii = self._footprints[: self._count], self._radii
        for step_count in range(1 + int(distance / SLIDE_STEP_M)):
            if _touches_trajectory(footprint, self._path, self._radius + gap):
                return False
            if _touches_any(footprint, others, radii, self.seconds, 0.0):
                x, y = footprint[:2] - step * (1 + gap / SLIDE_STEP_M) - actor.footprint[:2]
                return step_count > 0 and self.admit(replace(actor, x=actor.x + x, y=actor.y + y), gap=0.0)
            footprint[:2] += step
        return False

    def add(self, *group: Actor) -> None:
        """Add a group that may touch others, such as people on a bench."""
        self.actors += group
        for actor in group:
            self._append(actor.footprint)

    def _append(self, footprint: np.ndarray) -> None:
        if self._count == len(self._footprints):  # double the capacity
            self._footprints, self._radii = np.tile(self._footprints, (2, 1)), np.tile(self._radii, 2)
        self._footprints[self._count], self._radii[self._count] = (
            footprint,
            _compute_motion_radius(footprint, self.seconds),
        )
        self._count += 1
