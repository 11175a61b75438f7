"""nuScenes folders: the key frames of the LiDAR, scene by scene.

The sensor LIDAR_TOP has x to the right and y forward, and may be slightly tilted. Frames have their
origin at the sensor and the axes of the vehicle (x forward, y left, z up): points are rotated by
the calibration, but not translated, so that the ground is sensor_height below the origin.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from lidar_perception.data.frame import BOXES, POSES, Frame, Recording
from lidar_perception.data.nuscenes.boxes import to_matrices
from lidar_perception.data.nuscenes.labels import NuscenesLabels, read_labels
from lidar_perception.data.nuscenes.tables import Tables
from lidar_perception.data.records import read_records
from lidar_perception.intensity import to_unit
from lidar_perception.types import GroundTruth, InputError, PointCloud, are_usable_returns
from lidar_perception.wire.topics import LIDAR_FRAME

LIDAR_CHANNEL = "LIDAR_TOP"
SWEEP_COLUMNS = "x y z intensity ring"  # columns of a .pcd.bin file, float32
EGO_RADIUS_M = 1.0  # distance in x and in y within which points are on the ego vehicle
FULL_REFLECTION = 255  # maximum value of the intensity column


@dataclass(frozen=True, eq=False)
class KeyFrame:
    """Data of a frame for the detection task.

    Attributes:
        token: token of the sample.
        pose: (4, 4) pose of the frame in the global frame.
        ego: (3,) position of the vehicle in the global frame.
        labels: returns the labels in the global frame; None if the version has no labels.
    """

    token: str
    pose: np.ndarray
    ego: np.ndarray
    labels: Callable[[], NuscenesLabels | None]


def load_sweep(path: Path, rotation: np.ndarray, stamp_ns: int) -> PointCloud:
    """Load the usable points of a .pcd.bin file that are not on the ego vehicle.

    Args:
        rotation: (3, 3) rotation from the sensor's axes to those of the frame.
    """
    cloud = read_records(path, SWEEP_COLUMNS)
    off_vehicle = (np.abs(cloud[:, :2]) >= EGO_RADIUS_M).any(axis=1)
    cloud = cloud.compress(off_vehicle & are_usable_returns(cloud[:, :3]), axis=0)
    xyz = (cloud[:, :3].astype(np.float64) @ rotation.T).astype(np.float32)
    return PointCloud(np.ascontiguousarray(xyz), to_unit(cloud[:, 3], FULL_REFLECTION), stamp_ns, LIDAR_FRAME)


def _read_truth(key: KeyFrame) -> GroundTruth | None:
    labels = key.labels()
    return None if labels is None else labels.to_ground_truth(key.pose)


def can_open(path: Path) -> bool:
    """Return True for a nuScenes folder, or for the folder of a version in it."""
    return bool(_list_versions(path)) or (path / "sample_data.json").is_file()


def open_layout(path: Path, *, points: str = "", scans: bool = True) -> Recording:
    """Open the key frames of a data set. The path is ROOT/VERSION, or ROOT if it has only one version."""
    if (path / "sample_data.json").is_file():
        root, version = path.absolute().parent, path.absolute().name
    else:
        root, (version, *others) = path, _list_versions(path)
        if others:
            raise InputError(
                f"{path} has several versions; choose one of "
                + ", ".join(str(path / name) for name in (version, *others))
            )
    frames = open_nuscenes(root, version)
    has_labels = (root / version / "sample_annotation.json").is_file()
    return Recording(
        path, f"nuScenes {version}", frames, frozenset({POSES} | ({BOXES} if has_labels else set())), has_times=True
    )


def _list_versions(root: Path) -> list[str]:
    return sorted(table.parent.name for table in root.glob("*/sample_data.json"))


def open_nuscenes(root: str | Path, version: str = "v1.0-mini") -> list[Frame]:
    """Return the key frames of ROOT/VERSION, in the order of the scene table and of time.

    Sweeps and labels are read later. Raises InputError if the folder or a table is missing or
    invalid.
    """
    tables = Tables(root, version)
    names = dict(tables.read_rows("scene", "token", "name"))
    scene_order = {name: i for i, name in enumerate(names.values())}
    samples = sorted(
        (scene_order[names[scene]], time, token)
        for token, time, scene in tables.read_rows("sample", "token", "timestamp", "scene_token")
        if names.get(scene) in scene_order
    )
    if not samples:
        raise InputError(f"{tables.folder} has no key frames; download it again")
    scene_names, times = list(scene_order), {token: time for _, time, token in samples}
    if len(times) < len(samples):
        raise InputError(f"{tables.get_path('sample')} has rows with the same token; download it again")
    sweeps = _read_sweeps(tables, times)
    mounts = _read_poses(tables, "calibrated_sensor", {mount for _, _, _, mount in sweeps.values()})
    poses = _read_poses(tables, "ego_pose", {pose for _, _, pose, _ in sweeps.values()})
    all_labels = functools.cache(partial(read_labels, tables, times))
    label_files = tuple(tables.get_path(name) for name in ("sample_annotation", "calibrated_sensor", "ego_pose"))
    frames, counts = [], dict.fromkeys(scene_order.values(), 0)
    for number, (scene, _, token) in enumerate(samples):
        file, time, pose, mount = sweeps[token]
        sensor_pose, rotation = _make_sensor_pose(poses[pose], mounts[mount]), mounts[mount][:3, :3]
        key = KeyFrame(token, sensor_pose, poses[pose][:3, 3], partial(_get_frame_labels, all_labels, number))
        frames.append(
            Frame(
                f"{scene_names[scene]}/{counts[scene]:02}",
                time * 1000,
                partial(load_sweep, tables.root / file, rotation, time * 1000),
                partial(_read_truth, key),
                pose=sensor_pose.copy,
                sequence=scene_names[scene],
                index=counts[scene],
                sensor_height=float(mounts[mount][2, 3]),
                points=tables.root / file,
                files=(tables.root / file, *label_files),
                native=key,
            )
        )
        counts[scene] += 1
    return frames


def _get_frame_labels(all_labels: Callable, number: int) -> NuscenesLabels | None:
    labels = all_labels()
    return None if labels is None else labels[number]


def _make_sensor_pose(ego_pose: np.ndarray, mount: np.ndarray) -> np.ndarray:
    """Return the pose (4, 4) at the sensor's position with the vehicle's axes."""
    pose = ego_pose.copy()
    pose[:3, 3] += ego_pose[:3, :3] @ mount[:3, 3]
    return pose


def _read_sweeps(tables: Tables, times: dict[str, int]) -> dict[str, tuple[str, int, str, str]]:
    """Return the sweep of each key frame, by sample token.

    A sweep is (file, time in us, ego pose token, calibration token).
    """
    sensors = {token for token, channel in tables.read_rows("sensor", "token", "channel") if channel == LIDAR_CHANNEL}
    mounts = {
        token for token, sensor in tables.read_rows("calibrated_sensor", "token", "sensor_token") if sensor in sensors
    }
    sweeps = {
        sample: (file, time, pose, mount)
        for sample, key, file, time, pose, mount in tables.read_rows(
            "sample_data",
            "sample_token",
            "is_key_frame",
            "filename",
            "timestamp",
            "ego_pose_token",
            "calibrated_sensor_token",
        )
        if key and mount in mounts and sample in times
    }
    if missing_tokens := times.keys() - sweeps.keys():
        raise InputError(
            f"{tables.get_path('sample_data')} has no {LIDAR_CHANNEL} for {len(missing_tokens)} of "
            f"{len(times)} key frames, such as {min(missing_tokens)}; download it again"
        )
    return sweeps


def _read_poses(tables: Tables, table: str, tokens: set[str]) -> dict[str, np.ndarray]:
    """Return the poses (4, 4) in a table by token: of the sensor in the vehicle's frame, or of the
    vehicle in the global frame."""
    rows = {
        token: row for token, *row in tables.read_rows(table, "token", "translation", "rotation") if token in tokens
    }
    if missing_tokens := tokens - rows.keys():
        raise InputError(
            f"{tables.get_path(table)} has no row {min(missing_tokens)} ({len(missing_tokens)} missing rows); "
            "download it again"
        )
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, 3] = tables.convert_numbers(table, "translation", [row[0] for row in rows.values()], 3)
    quaternions = tables.convert_numbers(table, "rotation", [row[1] for row in rows.values()], 4)
    poses[:, :3, :3] = to_matrices(quaternions)
    return dict(zip(rows, poses))
