"""Scenes, and their state in the sensor's frame at any time of a drive.

A scene consists of the ground, actors, and the trajectory of the sensor. It is a street for a car, or
a campus or interior for a robot.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from lidar_perception.simulation import campus, indoor
from lidar_perception.simulation.actors import FAR_SIGHT_M, LARGE_M, SIGHT_M, Actor, ActorSet
from lidar_perception.simulation.roadside import furnish
from lidar_perception.simulation.sensor import Motion
from lidar_perception.simulation.solids import PART, Solids, compute_hull, place_parts
from lidar_perception.simulation.street import STREET_KINDS, StreetKind, draw_street
from lidar_perception.simulation.terrain import Ground, compute_ground_height
from lidar_perception.simulation.traffic import populate
from lidar_perception.simulation.trajectory import DRIVE_SECONDS, Trajectory
from lidar_perception.types import CLASSES, InputError, suggest_name

MAX_PEOPLE = 100  # maximum factor for the number of people; making such a street takes 3 s
EGO_HALF_SIZE_M = (3.0, 1.1)  # half length and half width of the area kept clear for the ego vehicle


class Scenes(NamedTuple):
    """Selection of scenes, see make_scene.

    Attributes:
        kind: Kind of street, campus or interior, such as "city"; None for all kinds.
        people: Factor for the usual number of people.
        scene: One of SCENE_TYPES, or several separated by commas, which alternate with the seed.
    """

    kind: str | None = None
    people: float = 1.0
    scene: str = "street"

    def scene_types(self) -> list[SceneType]:
        """Return the selected scene types. Raise InputError if an attribute is invalid."""
        if not 0 <= self.people <= MAX_PEOPLE:
            raise InputError(f"people = {self.people} must be between 0 and {MAX_PEOPLE}; the default is 1")
        names = self.scene.split(",")
        if unknown_names := [name for name in names if name not in SCENE_TYPES]:
            raise InputError(
                f"unknown scene {unknown_names[0]!r}: must be one of "
                f"{', '.join(SCENE_TYPES)}, or several separated by commas"
                f"{suggest_name(unknown_names[0], SCENE_TYPES)}"
            )
        for name in names:
            if self.kind is not None and self.kind not in SCENE_TYPES[name].kinds:
                raise InputError(
                    f"kind = {self.kind!r} must be one of "
                    f"{', '.join(SCENE_TYPES[name].kinds)} for scene {name}"
                    f"{suggest_name(self.kind, SCENE_TYPES[name].kinds)}"
                )
        return [SCENE_TYPES[name] for name in names]

    @property
    def camera(self) -> bool:
        """True if all scene types have a forward camera, so that only objects in its image are labelled."""
        return all(scene_type.camera for scene_type in self.scene_types())


ALL_STREETS = Scenes()
CROWDED_ZONES = Scenes("zone", 3.0)  # for demos and tests of pedestrian detectors


# Properties of an actor.
# forward: unit vector of its heading. class: index into CLASSES, -1 without a label. track: 0 without a label.
# sight: maximum distance at which it is visible.
# feet: height of the lowest ground below an unlabelled actor that never moves, which may be too long to stand
# on the slope; NaN for other actors.
ACTOR_ROW = np.dtype(
    [
        *(("xy", float, 2), ("forward", float, 2), ("size", float, 3)),
        *((name, float) for name in ("heading", "speed", "start", "stop", "sight", "feet")),
        *((name, np.int32) for name in ("class", "track")),
    ]
)


class SceneState(NamedTuple):
    """State of a scene at one time, in the sensor's frame.

    Attributes:
        solids: Solids of all objects in sight.
        position: (3,) position of the sensor in the world, m.
        heading: Heading of the sensor in the world, rad.
        boxes: (K, 7), see GroundTruth.
        class_ids: (K,) int32.
        track_ids: (K,) int32, from 1; the owners of the solids have the same ids.
        speeds: (K,) m/s over the ground.
        motion: Motion of the sensor.
    """

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
    """Ground, actors, and the trajectory of a sensor that stays upright.

    Attributes:
        ground: The ground.
        actors: All actors. Labelled ones have the track ids 1, 2, ... in this order.
        trajectory: Trajectory of the sensor.
        kind: Kind of street, campus or interior, such as "city".
        seconds: Duration of the drive.
    """

    ground: Ground
    actors: tuple[Actor, ...]
    trajectory: Trajectory = Trajectory()
    kind: str = ""
    seconds: float = DRIVE_SECONDS

    def compute_sensor_pose(self, t: float, sensor_height: float) -> np.ndarray:
        """Return the pose (4, 4) float64 of the sensor in the world after t seconds."""
        point, pose = self.trajectory.evaluate(t), np.eye(4)
        cos, sin = math.cos(point.heading), math.sin(point.heading)
        pose[:2, :2] = (cos, -sin), (sin, cos)
        pose[:3, 3] = (point.x, point.y, compute_ground_height(self.ground, point.x, point.y) + sensor_height)
        return pose

    def compute_state(self, t: float, sensor_height: float) -> SceneState:
        """Return the scene after t seconds, for a sensor at this height above the ground in m."""
        point, pose = self.trajectory.evaluate(t), self.compute_sensor_pose(t, sensor_height)
        sensor_position, rotation = pose[:3, 3].copy(), pose[:3, :3]
        a = self._actor_table
        distances = a["speed"] * np.clip(t - a["start"], 0.0, a["stop"] - a["start"])
        xy = a["xy"] + a["forward"] * distances[:, None]
        in_sight = np.flatnonzero(np.hypot(*(xy - sensor_position[:2]).T) <= a["sight"])
        a, distances, xy = a[in_sight], distances[in_sight], xy[in_sight]
        feet = np.where(np.isnan(a["feet"]), compute_ground_height(self.ground, *xy.T), a["feet"])
        position = (np.column_stack([xy, feet]) - sensor_position) @ rotation
        heading = a["heading"] - point.heading
        speed = np.where((a["start"] <= t) & (t < a["stop"]), a["speed"], 0.0)
        velocity = self._add_vertical_velocity(a["forward"] * speed[:, None]) @ rotation

        parts = [self.actors[i].obj.parts(s) for i, s in zip(in_sight.tolist(), distances.tolist())]
        owner = np.repeat(np.arange(len(parts)), [len(p) for p in parts])
        solids = place_parts(_join_parts(parts), position[owner], heading[owner], a["track"][owner], velocity[owner])

        labelled_indices = np.flatnonzero(a["track"])
        boxes = np.column_stack([position, a["size"], heading])[labelled_indices]
        boxes[:, 2] += boxes[:, 5] / 2
        sensor_velocity = (self._add_vertical_velocity(np.array([point.velocity])) @ rotation)[0]
        motion = Motion(tuple(sensor_velocity.tolist()), point.yaw_rate)
        a = a[labelled_indices]
        return SceneState(
            solids, sensor_position, point.heading, boxes, a["class"], a["track"], speed[labelled_indices], motion
        )

    @cached_property
    def _actor_table(self) -> np.ndarray:
        """Properties of the actors as (A,) ACTOR_ROW."""
        table = np.empty(len(self.actors), ACTOR_ROW)
        for row, a in zip(table, self.actors):
            x0, y0, z0, x1, y1, z1 = compute_hull(a.obj.parts(0.0))
            radius = math.hypot(x1 - x0, y1 - y0) / 2
            is_large = max(x1 - x0, y1 - y0, z1 - z0) > LARGE_M
            row["xy"], row["heading"] = (a.x, a.y), a.heading
            row["speed"], row["start"], row["stop"] = a.speed, a.start, a.stop
            row["forward"] = math.cos(a.heading), math.sin(a.heading)
            row["size"] = a.obj.size
            row["class"] = CLASSES.index(a.obj.label) if a.obj.label else -1
            row["sight"] = radius + (FAR_SIGHT_M if is_large else SIGHT_M)
        is_labelled = table["class"] >= 0
        table["track"] = np.where(is_labelled, np.cumsum(is_labelled), 0)
        table["feet"] = np.nan
        fixed_indices = np.flatnonzero((table["speed"] == 0) & ~is_labelled)
        footprints = np.array([self.actors[i].footprint for i in fixed_indices]).reshape(-1, 8)
        corners = _compute_corners(footprints)
        table["feet"][fixed_indices] = compute_ground_height(self.ground, *corners).min(axis=1)
        return table

    def _add_vertical_velocity(self, velocity: np.ndarray) -> np.ndarray:
        """Convert horizontal velocities (N, 2) to velocities (N, 3) along the sloping ground."""
        slope = np.array([self.ground.slope_x, self.ground.slope_y])
        return np.column_stack([velocity, velocity @ slope])


def _join_parts(arrays: list[np.ndarray]) -> np.ndarray:
    """Concatenate arrays (P,) PART; much faster than np.concatenate."""
    result = np.empty(sum(map(len, arrays)), PART)
    end = 0
    for parts in arrays:
        begin, end = end, end + len(parts)
        result[begin:end] = parts
    return result


def _compute_corners(footprints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return x and y (A, 4) of the corners of footprints (A, 8) at time 0."""
    x, y, heading, length, width = footprints[:, :5, None].transpose(1, 0, 2)
    forward, left = length * np.array([1, 1, -1, -1]), width * np.array([1, -1, 1, -1])
    return (
        x + np.cos(heading) * forward - np.sin(heading) * left,
        y + np.sin(heading) * forward + np.cos(heading) * left,
    )


def make_scene(seed: int = 0, kind: str | None = None, people: float = 1.0, scene: str = "street") -> Scene:
    """Make the scene of a seed. Objects that would touch others during the drive are left out.

    Args:
        seed: Seed, 0 or more.
        kind: Kind of street, campus or interior, such as "city"; None draws one.
        people: Factor for the usual number of pedestrians, sitting people and cyclists. Streets with
            a factor of 1 are similar to KITTI.
        scene: See Scenes.

    Raises:
        InputError: A value is invalid.
    """
    if seed < 0:
        raise InputError(f"seed = {seed} must not be negative")
    types = Scenes(kind, people, scene).scene_types()
    scene_type = types[seed % len(types)]
    rng = np.random.default_rng(seed)
    # Drawn in any case, so that the scene of a seed does not depend on whether its kind is given.
    random_kind = str(rng.choice(list(scene_type.kinds), p=[k.fraction for k in scene_type.kinds.values()]))
    kind = kind or random_kind
    return Scene(*scene_type.make(rng, scene_type.kinds[kind], people), kind)


def _make_street(
    rng: np.random.Generator, kind: StreetKind, people: float
) -> tuple[Ground, tuple[Actor, ...], Trajectory]:
    """Make a street along x, on which the ego vehicle drives at y = 0."""
    street = draw_street(rng, kind, DRIVE_SECONDS)
    ego = [0.0, 0.0, 0.0, *EGO_HALF_SIZE_M, street.speed, 0.0, np.inf]
    actors = ActorSet(DRIVE_SECONDS, np.array([ego]))
    furnish(rng, street, actors)
    populate(rng, street, actors, people)
    return street.ground, tuple(actors.actors), Trajectory(street.speed)


class SceneType(NamedTuple):
    """A type of scene.

    Attributes:
        kinds: Parameters of each kind by name, including its probability `fraction`.
        make: Function (rng, kind, people) that returns ground, actors and trajectory.
        camera: True if the scenes have a forward camera, see Scenes.
    """

    kinds: dict[str, Any]
    make: Callable[[np.random.Generator, Any, float], tuple[Ground, tuple[Actor, ...], Trajectory]]
    camera: bool = False


SCENE_TYPES = {
    "street": SceneType(STREET_KINDS, _make_street, camera=True),
    "campus": SceneType(campus.CAMPUS_KINDS, campus.make_campus),
    "indoor": SceneType(indoor.INDOOR_KINDS, indoor.make_interior),
}
