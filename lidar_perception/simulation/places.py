"""Lines and rectangles in which things are placed."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from lidar_perception.simulation.actors import Actor, make_prop
from lidar_perception.simulation.shapes.scene_object import SceneObject
from lidar_perception.simulation.solids import compute_extents


class Side(NamedTuple):
    """A line along which things are placed, such as a curb.

    Attributes:
        x, y, heading, length: Start, direction and length, in m and rad.
        walk: Width of the sidewalk to its left, m.
        front: Kind of the front beyond the sidewalk, see roadside.FRONTS.
        parking: Width of the parking strip to its right, m.
    """

    x: float
    y: float
    heading: float
    length: float
    walk: float
    front: str
    parking: float = 0.0

    def put(self, thing: SceneObject | np.ndarray, along: float, out: float, turn: float = 0.0, **moves) -> Actor:
        """Return an actor `along` the curb and `out` from it (m), turned against the line (rad).

        Parts (P,) PART become a thing without a label.
        """
        thing = make_prop(thing) if isinstance(thing, np.ndarray) else thing
        cos, sin = math.cos(self.heading), math.sin(self.heading)
        return Actor(
            thing, self.x + cos * along - sin * out, self.y + sin * along + cos * out, self.heading + turn, **moves
        )


class Court(NamedTuple):
    """A rectangle from x0, y0 to x1, y1 in the world, m."""

    x0: float
    y0: float
    x1: float
    y1: float

    @staticmethod
    def around(way: np.ndarray, ends: np.ndarray, wide: np.ndarray) -> Court:
        """Return the court around a path (T, 2).

        ends: (2,) margins behind and ahead; wide: (2,) margins to the right and left, m.
        """
        low, high = way.min(axis=0), way.max(axis=0)
        return Court(*(low - [ends[0], wide[0]]).tolist(), *(high + [ends[1], wide[1]]).tolist())

    @property
    def centre(self) -> tuple[float, float]:
        """Centre of the rectangle."""
        return (self.x0 + self.x1) / 2, (self.y0 + self.y1) / 2

    @property
    def floor(self) -> Side:
        """The edge at y0 as a line with the whole court to its left."""
        return Side(self.x0, self.y0, 0.0, self.x1 - self.x0, self.y1 - self.y0, "")

    def sides(self, walk: float = 0.0, front: str = "") -> tuple[Side, Side, Side, Side]:
        """Return the edges at y1, x0, y0, x1 as lines with the outside to their left."""
        long, wide = self.x1 - self.x0, self.y1 - self.y0
        return (
            Side(self.x0, self.y1, 0.0, long, walk, front),
            Side(self.x0, self.y0, np.pi / 2, wide, walk, front),
            Side(self.x1, self.y0, np.pi, long, walk, front),
            Side(self.x1, self.y1, -np.pi / 2, wide, walk, front),
        )

    def inner(self, margin: float) -> Court:
        """Return the rectangle without a margin, m."""
        return Court(self.x0 + margin, self.y0 + margin, self.x1 - margin, self.y1 - margin)

    def spots(self, rng: np.random.Generator, rate: float) -> Iterator[tuple[float, float]]:
        """Yield random positions (x, y), rate per 100 square metres in the mean."""
        area = max(self.x1 - self.x0, 0.0) * max(self.y1 - self.y0, 0.0)
        for _ in range(rng.poisson(area * rate / 100)):
            yield rng.uniform(self.x0, self.x1), rng.uniform(self.y0, self.y1)


def place_against(rng: np.random.Generator, side: Side, makers: Sequence[Callable], rate: float) -> Iterator[Actor]:
    """Yield things inside a side with their backs to it, rate per 100 m, made by random makers."""
    for along in scatter(rng, side.length, rate):
        made = makers[int(rng.integers(len(makers)))](rng)
        low, _ = compute_extents(made)
        yield side.put(made, along, low[:, 0].min() - 0.05, -np.pi / 2 + rng.normal(0, 0.02))


def space_evenly(rng, length: float, spacing: float) -> np.ndarray:
    """Return positions along a length, spacing apart in the mean."""
    places = np.arange(rng.uniform(0, spacing), length, spacing)
    return np.clip(places + rng.uniform(-0.2, 0.2, len(places)) * spacing, 0, length)


def scatter(rng, length: float, rate: float) -> np.ndarray:
    """Return independent positions along a length, on average `rate` per 100 m."""
    return rng.uniform(0, length, rng.poisson(max(length, 0.0) * rate / 100))
