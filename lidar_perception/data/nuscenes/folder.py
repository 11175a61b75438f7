"""nuScenes folders: the key frames of its LiDAR, scene by scene.

LIDAR_TOP looks with its x axis to the right and its y axis forward, and may lean a little. Here a
frame lies at the sensor and has the vehicle's axes (x forward, y left, z up): the points are turned
by the calibration and not moved, and the ground lies sensor_height below the origin.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from lidar_perception.data.frame import BOXES, POSES, Frame, Recording
from lidar_perception.data.nuscenes.boxes import matrices
from lidar_perception.data.nuscenes.labels import NuscenesLabels, read_labels
from lidar_perception.data.nuscenes.tables import Tables
from lidar_perception.data.records import read_records
from lidar_perception.intensity import to_unit
from lidar_perception.types import GroundTruth, InputError, LidarFrame, usable_returns
from lidar_perception.wire.topics import LIDAR_FRAME

CHANNEL = "LIDAR_TOP"
SWEEP = "x y z intensity ring"  # of a .pcd.bin file, float32
OWN_VEHICLE = 1.0       # metres: what is nearer in both x and y is a return of the vehicle itself
FULL_REFLECTION = 255   # intensity


@dataclass(frozen=True, eq=False)
class KeyFrame:
    """What the detection task asks for besides: the sample's token; pose (4, 4) from the frame to
    the global one; ego (3,) where the vehicle is there; labels() in the global frame, None where
    the version has none, read with those of all frames together."""

    token: str
    pose: np.ndarray
    ego: np.ndarray
    labels: Callable[[], NuscenesLabels | None]


def load_sweep(path: Path, turn: np.ndarray, stamp_ns: int) -> LidarFrame:
    """The usable points of a .pcd.bin file without those on the vehicle itself; turn (3, 3) from
    the sensor's axes to the frame's."""
    cloud = read_records(path, SWEEP)
    away = (np.abs(cloud[:, :2]) >= OWN_VEHICLE).any(axis=1)
    cloud = cloud.compress(away & usable_returns(cloud[:, :3]), axis=0)
    xyz = (cloud[:, :3].astype(np.float64) @ turn.T).astype(np.float32)
    return LidarFrame(np.ascontiguousarray(xyz), to_unit(cloud[:, 3], FULL_REFLECTION),
                      stamp_ns, LIDAR_FRAME)


def _truth(key: KeyFrame) -> GroundTruth | None:
    """The labels in the frame's own coordinates, see NuscenesLabels.in_frame; also those without
    points."""
    labels = key.labels()
    return None if labels is None else labels.in_frame(key.pose)


def recognises(path: Path) -> bool:
    """Whether a nuScenes folder lies there, or that of a version in one."""
    return bool(_versions(path)) or (path / "sample_data.json").is_file()


def open_recording(path: Path, *, points: str = "", scans: bool = True) -> Recording:
    """The key frames of ROOT, which has one version, or of ROOT/VERSION."""
    if (path / "sample_data.json").is_file():
        root, version = path.absolute().parent, path.absolute().name
    else:
        root, (version, *others) = path, _versions(path)
        if others:
            raise InputError(f"{path} has several versions; give one: " + ", ".join(
                str(path / name) for name in (version, *others)))
    frames = open_nuscenes(root, version)
    labelled = (root / version / "sample_annotation.json").is_file()
    return Recording(path, f"nuScenes {version}", frames,
                     frozenset({POSES} | ({BOXES} if labelled else set())), timed=True)


def _versions(root: Path) -> list[str]:
    return sorted(table.parent.name for table in root.glob("*/sample_data.json"))


def open_nuscenes(root: str | Path, version: str = "v1.0-mini") -> list[Frame]:
    """The key frames of ROOT/VERSION, in the order of the scene table and of time. Sweeps and
    labels are read later. InputError says which folder or table is missing or wrong."""
    tables = Tables(root, version)
    names = dict(tables.rows("scene", "token", "name"))
    rank = {name: i for i, name in enumerate(names.values())}
    samples = sorted((rank[names[scene]], time, token) for token, time, scene in tables.rows(
        "sample", "token", "timestamp", "scene_token") if names.get(scene) in rank)
    if not samples:
        raise InputError(f"{tables.folder} has no key frame; download it again")
    scene_names, times = list(rank), {token: time for _, time, token in samples}
    if len(times) < len(samples):
        raise InputError(f"{tables.path('sample')} has rows with the same token; download it again")
    sweeps = _sweeps(tables, times)
    mounts = _poses(tables, "calibrated_sensor", {mount for _, _, _, mount in sweeps.values()})
    poses = _poses(tables, "ego_pose", {pose for _, _, pose, _ in sweeps.values()})
    all_labels = functools.cache(partial(read_labels, tables, times))
    read = tuple(tables.path(name) for name in (
        "sample_annotation", "calibrated_sensor", "ego_pose"))
    frames, counts = [], dict.fromkeys(rank.values(), 0)
    for number, (scene, _, token) in enumerate(samples):
        file, time, pose, mount = sweeps[token]
        at_sensor, turn = _at_sensor(poses[pose], mounts[mount]), mounts[mount][:3, :3]
        key = KeyFrame(token, at_sensor, poses[pose][:3, 3], partial(_of_frame, all_labels, number))
        frames.append(Frame(
            f"{scene_names[scene]}/{counts[scene]:02}", time * 1000,
            partial(load_sweep, tables.root / file, turn, time * 1000), partial(_truth, key),
            pose=at_sensor.copy, sequence=scene_names[scene], index=counts[scene],
            sensor_height=float(mounts[mount][2, 3]), points=tables.root / file,
            files=(tables.root / file, *read), native=key))
        counts[scene] += 1
    return frames


def _of_frame(all_labels: Callable, number: int) -> NuscenesLabels | None:
    labels = all_labels()
    return None if labels is None else labels[number]


def _at_sensor(ego: np.ndarray, mount: np.ndarray) -> np.ndarray:
    """Pose of the sensor's position with the vehicle's axes."""
    pose = ego.copy()
    pose[:3, 3] += ego[:3, :3] @ mount[:3, 3]
    return pose


def _sweeps(tables: Tables, times: dict[str, int]) -> dict[str, tuple[str, int, str, str]]:
    """By key frame: file, microseconds, and the tokens of the vehicle's pose and the sensor's
    calibration."""
    sensors = {token for token, channel in tables.rows("sensor", "token", "channel")
               if channel == CHANNEL}
    mounts = {token for token, sensor in tables.rows("calibrated_sensor", "token", "sensor_token")
              if sensor in sensors}
    sweeps = {sample: (file, time, pose, mount) for sample, key, file, time, pose, mount
              in tables.rows("sample_data", "sample_token", "is_key_frame", "filename", "timestamp",
                             "ego_pose_token", "calibrated_sensor_token")
              if key and mount in mounts and sample in times}
    if without := times.keys() - sweeps.keys():
        raise InputError(f"{tables.path('sample_data')} has no {CHANNEL} of {len(without)} of "
                         f"{len(times)} key frames, such as {min(without)}; download it again")
    return sweeps


def _poses(tables: Tables, table: str, wanted: set[str]) -> dict[str, np.ndarray]:
    """By token: (4, 4) float64, to the vehicle from its sensor, or to the global frame from it."""
    rows = {token: row for token, *row in tables.rows(table, "token", "translation", "rotation")
            if token in wanted}
    if without := wanted - rows.keys():
        raise InputError(f"{tables.path(table)} has no row {min(without)} ({len(without)} such); "
                         "download it again")
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, 3] = tables.numbers(table, "translation", [row[0] for row in rows.values()], 3)
    poses[:, :3, :3] = matrices(tables.numbers(table, "rotation", [row[1] for row in rows.values()],
                                               4))
    return dict(zip(rows, poses))
