"""Bags for tests, made from arrays or simulated frames and written with the rosbags library."""

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
    """Make frames from clouds.

    Args:
        clouds: Arrays (N, 3) [x y z] in metres, or (N, 4) with intensity 0..1, in the sensor frame.
        labels: Labels of each cloud: GroundTruth, pairs (class name, [x y z l w h yaw]), or None
            for an unlabelled cloud.
        hz: Number of clouds per second.
        start_ns: Stamp of the first cloud.

    Raises:
        InputError: An array has a wrong shape, or the numbers of clouds and labels differ.
    """
    clouds = [np.asarray(cloud, np.float32) for cloud in clouds]
    truths = [None] * len(clouds) if labels is None else [*map(_to_truth, labels)]
    if len(truths) != len(clouds):
        raise InputError(f"{len(clouds)} clouds, but labels for {len(truths)}; give one item of labels per cloud")
    frames = []
    for i, (cloud, truth) in enumerate(zip(clouds, truths)):
        if cloud.ndim != 2 or cloud.shape[1] not in (3, 4):
            raise InputError(f"cloud {i} has shape {cloud.shape}, expected (N, 3) or (N, 4)")
        intensity = cloud[:, 3].copy() if cloud.shape[1] == 4 else None
        frames.append(
            Frame.of(
                str(i),
                PointCloud(np.ascontiguousarray(cloud[:, :3]), intensity, start_ns + round(i * 1e9 / hz), frame_id),
                truth,
            )
        )
    return frames


def _to_truth(labels: Any) -> GroundTruth | None:
    if labels is None or isinstance(labels, GroundTruth):
        return labels
    objects = to_objects(labels)
    if unknown_classes := [name for name in objects.labels if name not in CLASSES]:
        raise InputError(f"labels: unknown class '{unknown_classes[0]}'; choose from {', '.join(CLASSES)}")
    if np.isnan(objects.boxes).any():
        raise InputError("labels need complete boxes [x y z l w h yaw], not only centres")
    return GroundTruth.of(objects.boxes, [CLASSES.index(name) for name in objects.labels])


def write_rosbags_bag(
    path: Path, frames: Iterable[Frame], storage: str = "mcap", names: Mapping[str, str] = {}
) -> Path:
    """Write frames to a bag with rosbags and return its path.

    Args:
        storage: "mcap" or "sqlite3".
        names: New names for topics of lidar_perception.wire.topics.
    """
    with tempfile.TemporaryDirectory() as folder:
        write_bag(Path(folder) / "bag", frames)
        return copy_bag(Path(folder) / "bag", path, storage, names)


def copy_bag(source: Path, path: Path, storage: str, names: Mapping[str, str] = {}) -> Path:
    """Copy a bag with rosbags; for the arguments see write_rosbags_bag. Raises InputError for an unknown storage."""
    if storage not in STORAGES:
        raise InputError(f"unknown storage '{storage}'; choose from {', '.join(STORAGES)}")
    with Bag(source) as source_bag, Writer(path, version=9, storage_plugin=STORAGES[storage]) as bag:
        connections = {
            topic: bag.add_connection(
                names.get(topic, topic),
                type_name,
                typestore=load_typestore(),
                offered_qos_profiles=source_bag.find_qos(topic),
            )
            for topic, type_name in source_bag.topics.items()
        }
        for topic, stamp, data in source_bag.raw_messages():
            bag.write(connections[topic], stamp, data)
    return path


def to_frames(frames: Sequence[Any] | Iterable[Frame], labels: Any = None, **options: Any) -> list[Frame]:
    """Convert clouds to frames with make_frames(); frames are returned unchanged.

    Raises:
        InputError: Labels or options are given together with frames, which have their own.
    """
    frames = list(frames)
    if not frames or not isinstance(frames[0], Frame):
        return make_frames(frames, labels, **options)
    if rejected_options := [*(() if labels is None else ("labels",)), *options]:
        raise InputError(
            f"frames already have labels, times and a frame_id; leave out {' and '.join(rejected_options)}, or "
            "give arrays instead of frames"
        )
    return frames
