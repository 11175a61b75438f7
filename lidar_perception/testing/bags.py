"""Bags for tests, made of arrays or simulated frames and written by the rosbags library."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer

from lidar_perception.data.bag import Bag
from lidar_perception.data.frame import Frame
from lidar_perception.data.to_bag import write_bag
from lidar_perception.testing.detections import to_objects
from lidar_perception.types import CLASSES, GroundTruth, InputError, PointCloud
from lidar_perception.wire.codec import load_typestore
from lidar_perception.wire.topics import LIDAR_FRAME

START_NS = 1_700_000_000 * 10**9
STORAGES = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}


def make_frames(
    clouds: Iterable[Any],
    labels: Iterable[Any] | None = None,
    *,
    frame_id: str = LIDAR_FRAME,
    hz: float = 10.0,
    start_ns: int = START_NS,
) -> list[Frame]:
    """Make frames of clouds.

    Args:
        clouds: arrays (N, 3) [x y z] in metres, or (N, 4) with intensity 0..1, in the sensor frame.
        labels: for each cloud GroundTruth, pairs (class name, [x y z l w h yaw]), or None for an
            unlabelled cloud.

    Raises:
        InputError: for arrays of another shape, or if the numbers of clouds and labels differ.
    """
    clouds = [np.asarray(cloud, np.float32) for cloud in clouds]
    truths = [None] * len(clouds) if labels is None else [*map(_to_truth, labels)]
    if len(truths) != len(clouds):
        raise InputError(f"{len(clouds)} clouds and labels of {len(truths)}; give one each")
    frames = []
    for i, (cloud, truth) in enumerate(zip(clouds, truths)):
        if cloud.ndim != 2 or cloud.shape[1] not in (3, 4):
            raise InputError(f"cloud {i} has shape {cloud.shape}; it must be (N, 3) or (N, 4)")
        intensity = cloud[:, 3].copy() if cloud.shape[1] == 4 else None
        frames.append(
            Frame.of(
                str(i),
                PointCloud(np.ascontiguousarray(cloud[:, :3]), intensity, start_ns + round(i * 1e9 / hz), frame_id),
                truth,
            )
        )
    return frames


def _to_truth(given: Any) -> GroundTruth | None:
    if given is None or isinstance(given, GroundTruth):
        return given
    objects = to_objects(given)
    if unknown := [name for name in objects.labels if name not in CLASSES]:
        raise InputError(f"labels: '{unknown[0]}' is none of {', '.join(CLASSES)}")
    if np.isnan(objects.boxes).any():
        raise InputError("labels need complete boxes [x y z l w h yaw]")
    return GroundTruth.of(objects.boxes, [CLASSES.index(name) for name in objects.labels])


def write_rosbags_bag(
    path: Path, frames: Iterable[Frame], storage: str = "mcap", names: Mapping[str, str] = {}
) -> Path:
    """Write frames as a bag by rosbags; return its path.

    Args:
        storage: mcap or sqlite3.
        names: topic of lidar_perception.wire.topics -> another name.

    Raises:
        InputError: for an unknown storage.
    """
    with tempfile.TemporaryDirectory() as folder:
        write_bag(Path(folder) / "bag", frames)
        return copy_bag(Path(folder) / "bag", path, storage, names)


def copy_bag(source: Path, path: Path, storage: str, names: Mapping[str, str] = {}) -> Path:
    """Copy a bag by rosbags; arguments and errors are those of write_rosbags_bag."""
    if storage not in STORAGES:
        raise InputError(f"storage '{storage}' is none of {', '.join(STORAGES)}")
    with Bag(source) as recorded, Writer(path, version=9, storage_plugin=STORAGES[storage]) as bag:
        copies = {
            topic: bag.add_connection(
                names.get(topic, topic), kind, typestore=load_typestore(), offered_qos_profiles=recorded.qos(topic)
            )
            for topic, kind in recorded.topics.items()
        }
        for topic, stamp, data in recorded.raw_messages():
            bag.write(copies[topic], stamp, data)
    return path


def to_frames(given: Sequence[Any] | Iterable[Frame], labels: Any = None, **options: Any) -> list[Frame]:
    """Return frames as they are, or make_frames() of clouds.

    Raises:
        InputError: for labels or options together with frames, which would be ignored.
    """
    given = list(given)
    if not given or not isinstance(given[0], Frame):
        return make_frames(given, labels, **options)
    if refused := [*(() if labels is None else ("labels",)), *options]:
        raise InputError(
            f"frames already have labels, times and a frame_id, so they take no "
            f"{' and no '.join(refused)}; give arrays instead"
        )
    return given
