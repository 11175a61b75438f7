"""A short street drive: who stands, walks and drives where, and what that is in the LiDAR frame."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np

from lidar_perception.simulation import shapes
from lidar_perception.simulation.raycast import Solids
from lidar_perception.simulation.terrain import Ground, ground_height, surface_height
from lidar_perception.types import CLASSES

SECONDS = 20.0  # for so long nobody walks or drives into anything
START, END = -60.0, 200.0  # x of the built-up street
LEFT_CURB, RIGHT_CURB = 7.3, -4.1  # y; ego drives at 0, oncoming traffic at 3.2
LEFT_PARKING, RIGHT_PARKING = 6.2, -3.05
LEFT_WALL, RIGHT_WALL = 11.5, -8.5
UNLABELLED = -1


@dataclass(frozen=True)
class Actor:
    """Something that stands at x, y (world, time 0) or moves straight ahead at speed m/s.

    shape(travelled m) gives its parts, see shapes.py. class_id into CLASSES, or UNLABELLED.
    """

    shape: Callable[[float], np.ndarray]
    x: float
    y: float
    heading: float = 0.0
    speed: float = 0.0
    class_id: int = UNLABELLED

    def position(self, t):
        """(x, y) at time t, a float or an array."""
        return (self.x + np.cos(self.heading) * self.speed * t,
                self.y + np.sin(self.heading) * self.speed * t)


@dataclass(frozen=True)
class Moment:
    """The scene at one time, as the sensor at position (3,) in the world finds it. boxes (K, 7)
    as in GroundTruth, class_ids (K,), track_ids (K,) in 1.. which are also the solids' owners."""

    solids: Solids
    position: np.ndarray
    boxes: np.ndarray
    class_ids: np.ndarray
    track_ids: np.ndarray


@dataclass(frozen=True)
class Scene:
    """A street along x. The ego vehicle drives at y = 0 from x = 0; it stays upright, so that
    the ground has its slope in the LiDAR frame too. Actor i has track id i + 1."""

    ground: Ground
    actors: tuple[Actor, ...]
    speed: float

    def at(self, t: float, sensor_height: float) -> Moment:
        """The scene after t seconds, relative to a sensor so high above the road."""
        ego = self.speed * t
        sensor = np.array([ego, 0.0, ground_height(self.ground, ego, 0.0) + sensor_height])
        parts = [a.shape(a.speed * t) for a in self.actors]
        flat = np.array([a.position(t) for a in self.actors]).reshape(-1, 2)
        base = np.array([(x, y, surface_height(self.ground, x, y)) for x, y in flat]) - sensor
        heading = np.array([a.heading for a in self.actors])
        classes = np.array([a.class_id for a in self.actors])
        labelled = np.flatnonzero(classes != UNLABELLED)
        boxes = [_box(parts[i], base[i], heading[i]) for i in labelled]
        actor = np.repeat(np.arange(len(parts)), [len(p) for p in parts])
        owner = np.where(classes != UNLABELLED, np.arange(1, len(parts) + 1), 0)
        return Moment(_solids(np.concatenate(parts), base[actor], heading[actor], owner[actor]),
                      sensor, np.array(boxes).reshape(-1, 7), classes[labelled], labelled + 1)


def _solids(parts: np.ndarray, base: np.ndarray, heading: np.ndarray,
            owner: np.ndarray) -> Solids:
    """Parts (P, 9) of objects at base (P, 3), turned by heading (P,), in the frame of base."""
    cos, sin = np.cos(heading), np.sin(heading)
    down, nose = np.cos(parts[:, 7]), np.sin(parts[:, 7])
    zero = np.zeros(len(parts))
    forward = np.stack([cos * down, sin * down, -nose], axis=1)
    left = np.stack([-sin, cos, zero], axis=1)
    up = np.stack([cos * nose, sin * nose, down], axis=1)
    x, y, z = parts[:, 1:4].T
    centre = base + np.stack([cos * x - sin * y, sin * x + cos * y, z], axis=1)
    return Solids(parts[:, 0].astype(np.int64), centre, parts[:, 4:7],
                  np.stack([forward, left, up], axis=2), parts[:, 8], owner)


def _box(parts: np.ndarray, base: np.ndarray, heading: float) -> np.ndarray:
    """(7,) the smallest box with this heading around the parts of an object at base (3,)."""
    low, high = shapes.extents(parts)
    low, high = low.min(axis=0), high.max(axis=0)
    x, y, z = (low + high) / 2
    cos, sin = np.cos(heading), np.sin(heading)
    return np.array([*(base + (cos * x - sin * y, sin * x + cos * y, z)), *(high - low), heading])


def make_scene(seed: int = 0, speed: float = 4.0) -> Scene:
    """A street of its own for every seed; the ego vehicle drives along it at speed m/s.

    The first walkers are cast so that at 4 m/s they stay ahead of the ego vehicle, within 40
    degrees of its heading, for four seconds at least. The rest is drawn at random and dropped
    where it would ever touch something that is there already.
    """
    rng = np.random.default_rng(seed)
    ground = Ground(*np.tan(np.radians(rng.uniform((-0.8, -1.2), (0.8, 1.2)))), wave=0.03,
                    curb_left=LEFT_CURB, curb_right=RIGHT_CURB, curb_height=0.12)
    ego = Actor(lambda _: shapes.car(4.6, 1.9, 1.6, 0.0), 0.0, 0.0, speed=speed)
    placed: list[Actor] = []
    swept = _swept(ego)[None]
    for actor in (a for part in (_cast, _traffic, _street, _passers_by) for a in part(rng)):
        footprint = _swept(actor)
        if not _touch(footprint, swept):
            placed.append(actor)
            swept = np.concatenate([swept, footprint[None]])
    return Scene(ground, tuple(placed), speed)


def _swept(actor: Actor) -> np.ndarray:
    """(T, 4) [x low, y low, -x high, -y high] of what is below 2.2 m, over SECONDS."""
    low, high = shapes.extents(actor.shape(0.0))
    below = low[:, 2] < 2.2
    (l0, w0), (l1, w1) = low[below, :2].min(axis=0), high[below, :2].max(axis=0)
    if actor.speed:  # limbs swing
        l0, l1 = min(l0, -0.4), max(l1, 0.4)
    cos, sin = np.cos(actor.heading), np.sin(actor.heading)
    x = [cos * a - sin * b for a in (l0, l1) for b in (w0, w1)]
    y = [sin * a + cos * b for a in (l0, l1) for b in (w0, w1)]
    at_x, at_y = actor.position(np.linspace(0.0, SECONDS, 101))
    return np.stack([at_x + min(x), at_y + min(y), -at_x - max(x), -at_y - max(y)], axis=1)


def _touch(footprint: np.ndarray, others: np.ndarray, gap: float = 0.1) -> bool:
    """Whether a footprint (T, 4) ever comes within gap metres of one of others (M, T, 4)."""
    both = np.maximum(footprint, others)
    return bool((both[..., :2] + both[..., 2:] <= gap).all(axis=-1).any())


def _walker(rng: np.random.Generator, x: float, y: float, heading: float,
            speed: float = -1.0) -> Actor:
    """A pedestrian of random build; speed -1 draws that too."""
    speed = rng.uniform(1.1, 1.6) if speed < 0 else speed
    shape = partial(shapes.pedestrian, height=rng.uniform(1.62, 1.9),
                    girth=rng.uniform(0.9, 1.2), phase=rng.uniform(0, 2 * np.pi),
                    stride=rng.uniform(0.95, 1.05) * speed, coat=rng.uniform(0.1, 0.6),
                    trousers=rng.uniform(0.05, 0.4))
    return Actor(shape, x, y, heading, speed, CLASSES.index("Pedestrian"))


def _cast(rng: np.random.Generator) -> Iterator[Actor]:
    """Eight walkers who stay in view, each on a track of their own; the last one crosses."""
    pace, x, y = rng.uniform(1.1, 1.5), rng.uniform(21, 24), rng.uniform(-7.0, -6.6)
    yield _walker(rng, x, y, 0.0, pace)  # a pair on the right
    yield _walker(rng, x + rng.uniform(-0.2, 0.2), y + rng.uniform(0.85, 0.95), 0.0, pace)
    yield _walker(rng, rng.uniform(16, 18), -1.5, 0.0, rng.uniform(1.2, 1.5))  # past parked cars
    yield _walker(rng, rng.uniform(24, 28), rng.uniform(8.1, 8.4), 0.0)
    pace, x, y = rng.uniform(1.1, 1.5), rng.uniform(37, 41), rng.uniform(10.1, 10.3)
    yield _walker(rng, x, y, np.pi, pace)  # a pair that comes towards us on the left
    yield _walker(rng, x + rng.uniform(-0.2, 0.2), y - rng.uniform(0.85, 0.95), np.pi, pace)
    yield _walker(rng, rng.uniform(27, 31), rng.uniform(-5.0, -4.7), rng.uniform(-3, 3), 0.0)
    yield _walker(rng, rng.uniform(29, 34), rng.uniform(-4.5, -3), np.pi / 2)


def _passers_by(rng: np.random.Generator) -> Iterator[Actor]:
    """More walkers on both sidewalks, some two by two."""
    for x in np.arange(START, END, 9.0):
        y = rng.uniform(8.2, 10.6) if rng.random() < 0.5 else rng.uniform(-7.6, -5.2)
        heading, pace = np.pi * rng.integers(2), rng.uniform(1.0, 1.6)
        yield _walker(rng, x, y, heading, pace)
        if rng.random() < 0.3:
            yield _walker(rng, x + rng.uniform(-0.2, 0.2), y + 0.8, heading, pace)


def _traffic(rng: np.random.Generator) -> Iterator[Actor]:
    """Cars, vans and cyclists: oncoming, one ahead of us, and parked along both curbs."""
    def vehicle(x, y, heading, speed=0.0, share_of_vans=0.0):
        paint = rng.uniform(0.1, 0.7)
        if rng.random() < share_of_vans:
            size = rng.uniform((5.0, 1.85, 2.0), (5.6, 2.0, 2.3))
            return _rigid(shapes.van(*size, paint), x, y, heading, speed, "Van")
        size = rng.uniform((3.7, 1.6, 1.4), (4.6, 1.78, 1.6))
        return _rigid(shapes.car(*size, paint), x, y, heading, speed, "Car")

    yield vehicle(rng.uniform(38, 48), 0.0, 0.0, rng.uniform(5, 6))
    for x in (rng.uniform(26, 34), rng.uniform(60, 75), rng.uniform(120, 150)):
        yield vehicle(x, 3.2, np.pi, rng.uniform(7, 9))
    for x, y, heading in ((rng.uniform(18, 26), 1.9, np.pi), (rng.uniform(25, 35), -1.4, 0.0),
                          (rng.uniform(70, 90), 4.6, np.pi)):
        shape = partial(shapes.cyclist, height=rng.uniform(1.6, 1.85),
                        coat=rng.uniform(0.1, 0.6), trousers=rng.uniform(0.05, 0.4))
        yield Actor(shape, x, y, heading, rng.uniform(4, 5.5), CLASSES.index("Cyclist"))
    for y, heading in ((LEFT_PARKING, np.pi), (RIGHT_PARKING, 0.0)):
        for x in np.arange(START, END, 6.5):
            free, vans = (0.75, 0.0) if 0 < x < 40 else (0.4, 0.2)  # the cast must be seen
            if rng.random() > free:
                yield vehicle(x + rng.uniform(-0.4, 0.4), y + rng.uniform(-0.05, 0.05),
                              heading + rng.uniform(-0.03, 0.03), share_of_vans=vans)


def _street(rng: np.random.Generator) -> Iterator[Actor]:
    """Buildings with gaps between them, and trees, lamps, bushes and clutter on the sidewalks."""
    for wall, curb, heading in ((LEFT_WALL, LEFT_CURB, 0.0), (RIGHT_WALL, RIGHT_CURB, np.pi)):
        out = np.sign(wall)
        x = START + rng.uniform(0, 5)
        while x < END:
            length = rng.uniform(8, 20)
            parts = shapes.building(length, rng.uniform(8, 12), rng.uniform(4, 12),
                                    rng.uniform(0.25, 0.5))
            yield _rigid(parts, x + length / 2, wall + out * rng.uniform(0.1, 1.2), heading)
            x += length + rng.choice([0.2, 3.0, 6.0])
        for x in np.arange(START, END, 5.0) + rng.uniform(0, 5):
            y = curb + out * rng.uniform(0.4, 0.6)
            pick = rng.random()
            if pick < 0.35:
                yield _rigid(shapes.tree(rng), x, y, rng.uniform(-3, 3))
            elif pick < 0.5:
                yield _rigid(shapes.lamp(), x, y, -out * np.pi / 2)
            elif pick < 0.9:
                yield _rigid(shapes.clutter(rng), x, y, rng.uniform(-3, 3))
        for x in np.arange(START, END, 7.0) + rng.uniform(0, 7):
            parts = shapes.bush(rng) if rng.random() < 0.5 else shapes.clutter(rng)
            yield _rigid(parts, x, wall - out * 0.55, heading)


def _rigid(parts: np.ndarray, x: float, y: float, heading: float, speed: float = 0.0,
           label: str = "") -> Actor:
    return Actor(lambda _: parts, x, y, heading, speed,
                 CLASSES.index(label) if label else UNLABELLED)
