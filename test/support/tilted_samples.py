"""Simulated clouds of tilted sensors with a known mounting and the columns of real drivers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numba import njit

from lidar_perception.simulation import drive
from lidar_perception.simulation.raycast import Hits, cast_rays
from lidar_perception.simulation.returns import make_returns
from lidar_perception.simulation.scene import ALL_STREETS
from lidar_perception.simulation.sensor import Motion, Sensor, find_sensor, make_rays
from lidar_perception.simulation.terrain import Ground, cast_ground, compile_ground, compute_ground_height
from lidar_perception.wire.codec import make_bag_message
from msg_utils.point_cloud2 import from_array
from msg_utils.stamps import make_header

# Columns of a driver: name, type and scale.
VELODYNE = dict(intensity=("intensity", "<f4", 255), ring=("ring", "<u2", -1), time=("time", "<f4", 1))
OUSTER = dict(intensity=("intensity", "<f4", 255), ring=("ring", "<u1", 1), time=("t", "<u4", 1e9))
HESAI = dict(intensity=("intensity", "u1", 255), ring=("channel", "<u2", 1), time=("time_stamp", "<u4", 1e9))
KITTI = dict(intensity=("intensity", "<f4", 1), ring=None, time=None)
BARE = dict(intensity=None, ring=None, time=None)
EVEN = dict(camber=0.0, wave_height=0.0, tuft_height=0.0, litter_height=0.0)  # ground without unevenness
MOUNTS = {  # sensor: driver, roll and pitch in degrees, height in metres
    "hdl-64e": (KITTI, 1.5, -2.0, 1.73),
    "hdl-32e": (VELODYNE, -3.0, 4.0, 1.9),
    "vlp-16": (VELODYNE, 5.0, 8.0, 0.6),
    "vlp-32c": (VELODYNE, -6.0, -3.0, 1.1),
    "os1-64": (OUSTER, 2.0, 12.0, 1.4),
    "os1-128": (OUSTER, -1.0, 3.0, 0.8),
    "pandar64": (HESAI, 4.0, -1.0, 2.1),
    "pandarxt-32": (BARE, -2.5, 6.0, 0.9),
}


def tilt_matrix(roll: float, pitch: float) -> np.ndarray:
    """Return the rotation (3, 3) from a sensor with this roll and pitch (degrees) to the level frame."""
    r, p = np.radians([roll, pitch])
    return np.array([[np.cos(p), 0, np.sin(p)], [0, 1, 0], [-np.sin(p), 0, np.cos(p)]]) @ np.array(
        [[1, 0, 0], [0, np.cos(r), -np.sin(r)], [0, np.sin(r), np.cos(r)]]
    )


def find_road_pose(ground: Ground, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return axes (3, 3) with z along the road's normal at (x, y), and the point on the road."""
    x, y = np.meshgrid(np.linspace(-6, 6, 25), np.linspace(-3, 3, 13))
    z = compute_ground_height(ground._replace(curb_height=0.0), xy[0] + x, xy[1] + y)
    a, b, c = np.linalg.lstsq(np.column_stack([x.ravel(), y.ravel(), np.ones(x.size)]), z.ravel(), rcond=None)[0]
    up = np.array([-a, -b, 1.0]) / np.sqrt(a * a + b * b + 1)
    forward = np.array([up[2], 0.0, -up[0]]) / np.hypot(up[0], up[2])
    return np.column_stack([forward, np.cross(up, forward), up]), np.array([*xy, c])


@njit(cache=True)
def _cast_ground(ground, start, direction, times, velocity, lift, max_range):
    """Return range, brightness, cosine and class (columns, rings, 4) of hits on the ground."""
    result = np.empty((*direction.shape[:2], 4))
    for i in range(direction.shape[0]):
        for k in range(direction.shape[1]):
            origin = start + velocity * times[i] + lift[k]
            hit = cast_ground(
                ground,
                (origin[0], origin[1], origin[2]),
                (direction[i, k, 0], direction[i, k, 1], direction[i, k, 2]),
                max_range,
            )
            result[i, k, 0], result[i, k, 1] = hit.range, hit.brightness
            result[i, k, 2], result[i, k, 3] = hit.cosine, hit.semantic
    return result


def simulate_tilted(sensor: Sensor, roll: float, pitch: float, street: int, number: int, even: bool = True):
    """Simulate one sweep of a sensor with roll and pitch in degrees relative to the road. even: the street has
    slopes and curbs but is otherwise smooth.
    """
    scene = drive._make_cached_scene(street, ALL_STREETS)
    ground = scene.ground._replace(**EVEN) if even else scene.ground
    scene = replace(scene, ground=ground)
    sensor = sensor.shift_beams(number)
    state = scene.compute_state(number / sensor.rate, sensor.height)
    axes, road_point = find_road_pose(ground, state.position[:2])
    position = road_point + sensor.height * axes[:, 2]
    world = axes @ tilt_matrix(roll, pitch)
    solids = replace(
        state.solids,
        centre=(state.solids.centre + state.position - position) @ world,
        axes=world.T @ state.solids.axes,
        velocity=state.solids.velocity @ world,
    )
    motion = Motion(tuple(np.array(state.motion.velocity) @ world))
    hits = cast_rays(solids, Ground(), np.array([0.0, 0.0, 1e6]), sensor, motion, street)
    rays = make_rays(sensor, motion)
    lift = np.outer(sensor.lifts or np.zeros(sensor.rings), world[:, 2])
    ground_hits = _cast_ground(
        compile_ground(ground),
        position,
        rays.direction @ world.T,
        rays.times,
        np.array(state.motion.velocity),
        lift,
        sensor.max_range,
    )
    is_ground = ground_hits[..., 0] < hits.range
    merged = [
        np.where(is_ground, ground_hits[..., i], values)
        for i, values in enumerate((hits.range, hits.brightness, hits.cosine))
    ]
    owner = np.where(is_ground, 0, hits.owner)
    semantic = np.where(is_ground, ground_hits[..., 3], hits.semantic).astype(np.uint16)
    return make_returns(
        Hits(*merged, owner, semantic, hits.solid, hits.unoccluded_counts),
        sensor,
        motion,
        np.random.default_rng([street, number]),
        compensated=False,
    )


def make_cloud(returns, driver: dict, stamp_ns: int, rings: int, frame_id: str = "lidar"):
    """Return a PointCloud2 with a driver's columns, ordered by beam for KITTI and by firing otherwise."""
    order = np.arange(len(returns.xyz)) if driver is KITTI else np.argsort(returns.time, kind="stable")
    columns = {axis: returns.xyz[order, i] for i, axis in enumerate("xyz")}
    fields = [(axis, "<f4") for axis in "xyz"]
    for key, values in (
        ("intensity", returns.intensity),
        ("ring", returns.ring),
        ("time", returns.time - returns.time.min()),
    ):
        if driver[key] is not None:
            name, dtype, scale = driver[key]
            values = values[order].astype(np.float64) * abs(scale)
            if key == "ring" and scale < 0:
                values = rings - 1 - values
            is_integer = dtype[-2] != "f" or (key == "intensity" and scale > 1)
            columns[name] = np.round(values) if is_integer else values
            fields.append((name, dtype))
    points = np.empty(len(order), fields)
    for name, values in columns.items():
        points[name] = values
    return from_array(points, make_header(stamp_ns, frame_id, make_bag_message), make_bag_message)


def simulate_clouds(name: str, count: int = 4, even: bool = True, street: int = 40):
    """Yield clouds of a sensor mounted as in MOUNTS; every two clouds are from a new street."""
    driver, roll, pitch, height = MOUNTS[name]
    sensor = replace(find_sensor(name), height=height)
    for i in range(count):
        returns = simulate_tilted(sensor, roll, pitch, street + i // 2, 20 + i % 2, even)
        yield make_cloud(returns, driver, round(1e9 * (10 * (i // 2) + (i % 2) / sensor.rate)), sensor.rings)
