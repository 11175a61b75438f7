"""Lines and rectangles in which objects are placed."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from lidar_perception.simulation.actors import Actor, make_prop
from lidar_perception.simulation.shapes.scene_object import SceneObject
from lidar_perception.simulation.solids import compute_extents


class Side(NamedTuple):
    """A line along which objects are placed, such as a curb.

    Attributes:
        x, y: Start, m.
        heading: Direction, rad.
        length: m.
        walk: Width of the sidewalk on its left, m.
        front: Type of the front beyond the sidewalk, see roadside.FRONTS.
        parking: Width of the parking strip on its right, m.
    """

    x: float
    y: float
    heading: float
    length: float
    walk: float
    front: str
    parking: float = 0.0

    def place(self, obj: SceneObject | np.ndarray, along: float, out: float, turn: float = 0.0, **motion) -> Actor:
        """Place an object relative to the line.

        Args:
            obj: The object, or the parts (P,) PART of an object without a label.
            along: Distance along the line from its start, m.
            out: Distance from the line to its left, m.
            turn: Heading relative to the line, rad.
            motion: speed, start and stop of the actor.
        """
        obj = make_prop(obj) if isinstance(obj, np.ndarray) else obj
        cos, sin = math.cos(self.heading), math.sin(self.heading)
        x, y = self.x + cos * along - sin * out, self.y + sin * along + cos * out
        return Actor(obj, x, y, self.heading + turn, **motion)


class Court(NamedTuple):
    """A rectangle from (x0, y0) to (x1, y1) in the world, m."""

    x0: float
    y0: float
    x1: float
    y1: float

    @staticmethod
    def around(path: np.ndarray, ends: np.ndarray, sides: np.ndarray) -> Court:
        """Return the court around a path (T, 2).

        Args:
            path: (T, 2) points, m.
            ends: (2,) margins behind and ahead, m.
            sides: (2,) margins to the right and left, m.
        """
        low, high = path.min(axis=0), path.max(axis=0)
        return Court(*(low - [ends[0], sides[0]]).tolist(), *(high + [ends[1], sides[1]]).tolist())

    @property
    def centre(self) -> tuple[float, float]:
        """Centre of the rectangle."""
        return (self.x0 + self.x1) / 2, (self.y0 + self.y1) / 2

    @property
    def floor(self) -> Side:
        """The edge at y0 as a line with the court on its left."""
        return Side(self.x0, self.y0, 0.0, self.x1 - self.x0, self.y1 - self.y0, "")

    def sides(self, walk: float = 0.0, front: str = "") -> tuple[Side, Side, Side, Side]:
        """Return the edges at y1, x0, y0, x1 as lines with the outside on their left."""
        length, width = self.x1 - self.x0, self.y1 - self.y0
        return (
            Side(self.x0, self.y1, 0.0, length, walk, front),
            Side(self.x0, self.y0, np.pi / 2, width, walk, front),
            Side(self.x1, self.y0, np.pi, length, walk, front),
            Side(self.x1, self.y1, -np.pi / 2, width, walk, front),
        )

    def inner(self, margin: float) -> Court:
        """Shrink the rectangle by a margin in m."""
        return Court(self.x0 + margin, self.y0 + margin, self.x1 - margin, self.y1 - margin)

    def draw_positions(self, rng: np.random.Generator, rate: float) -> Iterator[tuple[float, float]]:
        """Yield random positions (x, y), on average `rate` per 100 square metres."""
        area = max(self.x1 - self.x0, 0.0) * max(self.y1 - self.y0, 0.0)
        for _ in range(rng.poisson(area * rate / 100)):
            yield rng.uniform(self.x0, self.x1), rng.uniform(self.y0, self.y1)


def place_against(rng: np.random.Generator, side: Side, makers: Sequence[Callable], rate: float) -> Iterator[Actor]:
    """Yield objects on the inside of a side with their backs to it, from random makers, on average `rate` per 100 m."""
    for along in scatter(rng, side.length, rate):
        parts = makers[int(rng.integers(len(makers)))](rng)
        low, _ = compute_extents(parts)
        yield side.place(parts, along, low[:, 0].min() - 0.05, -np.pi / 2 + rng.normal(0, 0.02))


def space_evenly(rng, length: float, spacing: float) -> np.ndarray:
    """Return jittered positions along a length with this mean spacing, m."""
    positions = np.arange(rng.uniform(0, spacing), length, spacing)
    return np.clip(positions + rng.uniform(-0.2, 0.2, len(positions)) * spacing, 0, length)


def scatter(rng, length: float, rate: float) -> np.ndarray:
    """Return independent positions along a length, on average `rate` per 100 m."""
    return rng.uniform(0, length, rng.poisson(max(length, 0.0) * rate / 100))
