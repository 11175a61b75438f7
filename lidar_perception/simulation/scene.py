"""A drive through a scene: what that is in the LiDAR frame at any time.

A scene is a ground, things that stand or move on it, and the way of the sensor. Places make them: a
street for a car, or where robots are that drive on no road.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from lidar_perception.simulation import campus, indoor
from lidar_perception.simulation.actors import FAR_SIGHT_M, LARGE_M, SIGHT_M, Actor, Room
from lidar_perception.simulation.roadside import furnish
from lidar_perception.simulation.sensor import Motion
from lidar_perception.simulation.solids import PART, Solids, compute_hull, place_parts
from lidar_perception.simulation.street import STREET_KINDS, StreetKind, draw_street
from lidar_perception.simulation.terrain import Ground, surface_height
from lidar_perception.simulation.traffic import populate
from lidar_perception.simulation.trajectory import DRIVE_SECONDS, Trajectory
from lidar_perception.types import CLASSES, InputError, did_you_mean

MAX_PEOPLE = 100  # times as many as usual; a street then takes 3 s, and has no room for more
EGO_HALF_SIZE_M = (3.0, 1.1)  # half length and width that the ego vehicle keeps clear, m


class Scenes(NamedTuple):
    """Which scenes, see make_scene: all kinds, or one; how many times as many people as usual;
    scene: one of SCENES, or several with commas between, in turn from seed to seed."""

    kind: str | None = None
    people: float = 1.0
    scene: str = "street"

    def sorts(self) -> list[SceneType]:
        """In the order of their turns. InputError for an unknown scene or kind, and people that
        cannot be."""
        if not 0 <= self.people <= MAX_PEOPLE:
            raise InputError(f"people = {self.people} must be 0 .. {MAX_PEOPLE}, such as 1")
        names = self.scene.split(",")
        if unknown := [name for name in names if name not in SCENE_TYPES]:
            raise InputError(f"unknown scene {unknown[0]!r}: must be one of "
                             f"{', '.join(SCENE_TYPES)}, or several separated by commas"
                             f"{did_you_mean(unknown[0], SCENE_TYPES)}")
        for name in names:
            if self.kind is not None and self.kind not in SCENE_TYPES[name].kinds:
                raise InputError(f"kind = {self.kind!r} must be one of "
                                 f"{', '.join(SCENE_TYPES[name].kinds)} where scene is {name}"
                                 f"{did_you_mean(self.kind, SCENE_TYPES[name].kinds)}")
        return [SCENE_TYPES[name] for name in names]

    @property
    def camera(self) -> bool:
        """Whether all have a camera that looks ahead, beyond whose image nothing is labelled."""
        return all(sort.camera for sort in self.sorts())


ALL_STREETS = Scenes()
CROWDED_ZONES = Scenes("zone", 3.0)  # for demos and tests of pedestrian detectors


class SceneMoment(NamedTuple):
    """The scene at one time, as the sensor at position (3,) in the world, which looks along
    heading, finds it. boxes (K, 7) as in GroundTruth, class_ids (K,) int32, track_ids (K,) int32
    in 1.., which are also the solids' owners, speeds (K,) m/s over the ground, motion of the
    sensor."""

    solids: Solids
    position: np.ndarray
    heading: float
    boxes: np.ndarray
    class_ids: np.ndarray
    track_ids: np.ndarray
    speeds: np.ndarray
    motion: Motion


@dataclass(frozen=True)
class Scene:
    """Things on a ground, and a sensor that goes its way. Robots and all vehicles stay upright, so
    that the ground has its slope in the LiDAR frame too. The labelled actors have the track ids
    1.. in their order. seconds: how long the drive may be."""

    ground: Ground
    actors: tuple[Actor, ...]
    way: Trajectory = Trajectory()
    kind: str = ""
    seconds: float = DRIVE_SECONDS

    def sensor_pose(self, t: float, sensor_height: float) -> np.ndarray:
        """(4, 4) float64 from the sensor's frame after t seconds to the world."""
        along, pose = self.way.at(t), np.eye(4)
        cos, sin = math.cos(along.heading), math.sin(along.heading)
        pose[:2, :2] = (cos, -sin), (sin, cos)
        pose[:3, 3] = (along.x, along.y,
                       surface_height(self.ground, along.x, along.y) + sensor_height)
        return pose

    def at(self, t: float, sensor_height: float) -> SceneMoment:
        """The scene after t seconds, relative to a sensor so high above the ground."""
        along, pose = self.way.at(t), self.sensor_pose(t, sensor_height)
        sensor, turned = pose[:3, 3].copy(), pose[:3, :3]
        ego = sensor[:2]
        a = self._table
        way = a["speed"] * np.clip(t - a["start"], 0.0, a["stop"] - a["start"])
        flat = a["xy"] + a["forward"] * way[:, None]
        near = np.flatnonzero(np.hypot(*(flat - ego).T) <= a["sight"])
        a, way, flat = a[near], way[near], flat[near]
        feet = np.where(np.isnan(a["feet"]), surface_height(self.ground, *flat.T), a["feet"])
        base = (np.column_stack([flat, feet]) - sensor) @ turned
        heading = a["heading"] - along.heading
        speed = np.where((a["start"] <= t) & (t < a["stop"]), a["speed"], 0.0)
        velocity = self._climbing(a["forward"] * speed[:, None]) @ turned

        made = [self.actors[i].thing.parts(s) for i, s in zip(near.tolist(), way.tolist())]
        whose = np.repeat(np.arange(len(made)), [len(m) for m in made])
        solids = place_parts(_join_parts(made), base[whose], heading[whose], a["track"][whose],
                             velocity[whose])

        known = np.flatnonzero(a["track"])
        boxes = np.column_stack([base, a["size"], heading])[known]
        boxes[:, 2] += boxes[:, 5] / 2
        moved = (self._climbing(np.array([along.velocity])) @ turned)[0]
        motion = Motion(tuple(moved.tolist()), along.yaw_rate)
        return SceneMoment(solids, sensor, along.heading, boxes, a["class"][known],
                           a["track"][known], speed[known], motion)

    @cached_property
    def _table(self) -> np.ndarray:
        """One row for every actor. feet: the least height of the ground below what never moves and
        has no label, which may be too long to stand on a slope; NaN for the rest."""
        rows = []
        for a in self.actors:
            x0, y0, z0, x1, y1, z1 = compute_hull(a.thing.parts(0.0))
            level, span = math.hypot(x1 - x0, y1 - y0), max(x1 - x0, y1 - y0, z1 - z0)
            label = a.thing.label
            rows.append(((a.x, a.y), a.heading, (math.cos(a.heading), math.sin(a.heading)),
                         a.speed, a.start, a.stop, a.thing.size,
                         CLASSES.index(label) if label else -1, 0,
                         level / 2 + (FAR_SIGHT_M if span > LARGE_M else SIGHT_M), np.nan))
        table = np.array(rows, [
            ("xy", float, 2), ("heading", float), ("forward", float, 2), ("speed", float),
            ("start", float), ("stop", float), ("size", float, 3), ("class", np.int32),
            ("track", np.int32), ("sight", float), ("feet", float)])
        known = table["class"] >= 0
        table["track"] = np.where(known, np.cumsum(known), 0)
        fixed = np.flatnonzero((table["speed"] == 0) & ~known)
        footprints = np.array([self.actors[i].footprint for i in fixed]).reshape(-1, 8)
        corners = _compute_corners(footprints)
        table["feet"][fixed] = surface_height(self.ground, *corners).min(axis=1)
        return table

    def _climbing(self, flat: np.ndarray) -> np.ndarray:
        """(n, 3) velocities along the slope of the ground from those (n, 2) in the plane."""
        slope = np.array([self.ground.slope_x, self.ground.slope_y])
        return np.column_stack([flat, flat @ slope])


def _join_parts(made: list[np.ndarray]) -> np.ndarray:
    """All parts (P,) PART in a row; np.concatenate takes as long as casting them."""
    whole = np.empty(sum(map(len, made)), PART)
    end = 0
    for one in made:
        begin, end = end, end + len(one)
        whole[begin:end] = one
    return whole


def _compute_corners(f: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """x and y (A, 4) of the corners of footprints (A, 8) at time 0."""
    x, y, heading, length, width = f[:, :5, None].transpose(1, 0, 2)
    ahead, aside = length * np.array([1, 1, -1, -1]), width * np.array([1, -1, 1, -1])
    return (x + np.cos(heading) * ahead - np.sin(heading) * aside,
            y + np.sin(heading) * ahead + np.cos(heading) * aside)


def make_scene(seed: int = 0, kind: str | None = None, people: float = 1.0,
               scene: str = "street") -> Scene:
    """A scene of its own for every seed. kind: one of those of the scene; None draws it by their
    shares. people: multiplies how many pedestrians, sitting people and cyclists are tried; on
    streets 1 comes near KITTI's labels, 0 is none. scene: see Scenes.

    What is placed later is dropped where it would ever touch what is there already. InputError
    for a negative seed, people beyond 0 .. MAX_PEOPLE and an unknown scene or kind.
    """
    if seed < 0:
        raise InputError(f"seed = {seed} must not be negative")
    sorts = Scenes(kind, people, scene).sorts()
    chosen = sorts[seed % len(sorts)]
    rng = np.random.default_rng(seed)
    drawn = str(rng.choice(list(chosen.kinds), p=[k.share for k in chosen.kinds.values()]))
    kind = kind or drawn
    return Scene(*chosen.make(rng, chosen.kinds[kind], people), kind)


def _make_street(rng: np.random.Generator, kind: StreetKind,
                 people: float) -> tuple[Ground, tuple[Actor, ...], Trajectory]:
    """A street along x, and a car that drives at y = 0."""
    street = draw_street(rng, kind, DRIVE_SECONDS)
    ego = [0.0, 0.0, 0.0, *EGO_HALF_SIZE_M, street.speed, 0.0, np.inf]
    room = Room(DRIVE_SECONDS, np.array([ego]))
    furnish(rng, street, room)
    populate(rng, street, room, people)
    return street.ground, tuple(room.actors), Trajectory(street.speed)


class SceneType(NamedTuple):
    """A sort of scene: its kinds by name, each with the share that it is drawn with; make(rng,
    kind, people): ground, actors and way; camera: see Scenes."""

    kinds: dict[str, Any]
    make: Callable[[np.random.Generator, Any, float], tuple[Ground, tuple[Actor, ...], Trajectory]]
    camera: bool = False


SCENE_TYPES = {"street": SceneType(STREET_KINDS, _make_street, camera=True),
               "campus": SceneType(campus.CAMPUS_KINDS, campus.make_campus),
               "indoor": SceneType(indoor.INDOOR_KINDS, indoor.make_interior)}

