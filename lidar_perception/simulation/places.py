"""Lines and rectangles on which objects are placed."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from lidar_perception.simulation.actors import Actor, make_prop
from lidar_perception.simulation.shapes.scene_object import SceneObject
from lidar_perception.simulation.solids import compute_extents


class Side(NamedTuple):
    """A line along which objects are placed, such as a curb or a wall.

    Attributes:
        x, y: Start, m.
        heading: Direction, rad.
        length: m.
        sidewalk_width: Width of the sidewalk on its left, m.
        front: Type of the buildings or plants beyond the sidewalk, see roadside.FRONTS.
        parking_width: Width of the parking strip on its right, m.
    """

    x: float
    y: float
    heading: float
    length: float
    sidewalk_width: float
    front: str
    parking_width: float = 0.0

    def place(
        self, obj: SceneObject | np.ndarray, position: float, offset: float, heading: float = 0.0, **motion
    ) -> Actor:
        """Place an object relative to the line.

        Args:
            obj: The object, or the parts (P,) PART of an object without a label.
            position: Distance along the line from its start, m.
            offset: Distance from the line to its left, m.
            heading: Heading relative to the line, rad.
            motion: speed, start and stop of the actor.
        """
        obj = make_prop(obj) if isinstance(obj, np.ndarray) else obj
        cos, sin = math.cos(self.heading), math.sin(self.heading)
        x, y = self.x + cos * position - sin * offset, self.y + sin * position + cos * offset
        return Actor(obj, x, y, self.heading + heading, **motion)


class Court(NamedTuple):
    """A rectangle from (x0, y0) to (x1, y1) in the world, m."""

    x0: float
    y0: float
    x1: float
    y1: float

    @staticmethod
    def enclose(path: np.ndarray, ends: np.ndarray, sides: np.ndarray) -> Court:
        """Return the court around a path.

        Args:
            path: (T, 2) points in the world, m.
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
        """The edge at y0, as a line with the court on its left."""
        return Side(self.x0, self.y0, 0.0, self.x1 - self.x0, self.y1 - self.y0, "")

    def make_sides(self) -> tuple[Side, Side, Side, Side]:
        """Return the edges at y1, x0, y0 and x1, as lines with the outside on their left."""
        length, width = self.x1 - self.x0, self.y1 - self.y0
        return (
            Side(self.x0, self.y1, 0.0, length, 0.0, ""),
            Side(self.x0, self.y0, np.pi / 2, width, 0.0, ""),
            Side(self.x1, self.y0, np.pi, length, 0.0, ""),
            Side(self.x1, self.y1, -np.pi / 2, width, 0.0, ""),
        )

    def shrink(self, margin: float) -> Court:
        """Return the rectangle, shrunk by a margin in m at each edge."""
        return Court(self.x0 + margin, self.y0 + margin, self.x1 - margin, self.y1 - margin)

    def draw_positions(self, rng: np.random.Generator, rate: float) -> Iterator[tuple[float, float]]:
        """Yield random positions (x, y) with a mean number of `rate` per 100 square metres."""
        area = max(self.x1 - self.x0, 0.0) * max(self.y1 - self.y0, 0.0)
        for _ in range(rng.poisson(area * rate / 100)):
            yield rng.uniform(self.x0, self.x1), rng.uniform(self.y0, self.y1)


def place_along(rng: np.random.Generator, side: Side, makers: Sequence[Callable], rate: float) -> Iterator[Actor]:
    """Yield random objects that stand with their backs against a side.

    Args:
        side: The side; the objects are on its right.
        makers: Functions (rng) that make parts (P,) PART.
        rate: Mean number of objects per 100 m.
    """
    for position in draw_positions_along(rng, side.length, rate):
        parts = makers[int(rng.integers(len(makers)))](rng)
        low, _ = compute_extents(parts)
        yield side.place(parts, position, low[:, 0].min() - 0.05, -np.pi / 2 + rng.normal(0, 0.02))


def draw_even_positions(rng, length: float, spacing: float) -> np.ndarray:
    """Return evenly spaced positions along a length, with jitter, in m."""
    positions = np.arange(rng.uniform(0, spacing), length, spacing)
    return np.clip(positions + rng.uniform(-0.2, 0.2, len(positions)) * spacing, 0, length)


def draw_positions_along(rng, length: float, rate: float) -> np.ndarray:
    """Return independent random positions along a length in m, with a mean number of `rate` per 100 m."""
    return rng.uniform(0, length, rng.poisson(max(length, 0.0) * rate / 100))
