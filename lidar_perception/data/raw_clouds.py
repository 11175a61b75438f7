"""Clouds of any recording as messages with all columns that the driver wrote."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lidar_perception.data import bag_frames
from lidar_perception.data.bag import BagHandle
from lidar_perception.data.bag_poses import BagPoses
from lidar_perception.data.cloud_files import to_message
from lidar_perception.data.cloud_folder import list_cloud_files, parse_times
from lidar_perception.data.frame import Frame
from lidar_perception.data.open import find_layout, open_recording, split_topic
from lidar_perception.data.to_bag import to_point_array
from lidar_perception.types import InputError
from lidar_perception.wire.codec import make_bag_message
from lidar_perception.wire.topics import LIDAR_FRAME
from msg_utils.point_cloud2 import from_array
from msg_utils.stamps import make_header

PAIR_DISTANCE = 8  # number of clouds from the first to the second cloud of a wide pair, see choose_clouds


@dataclass(frozen=True)
class RawClouds:
    """Clouds in order of time.

    Attributes:
        path: path of the recording.
        layout: description of the recognised layout.
        count: number of clouds.
        stamps_ns: stamps of all clouds; None if they were not recorded.
        load: load(i) returns cloud i as a PointCloud2 (class of rosbags), or raises InputError.
        poses: poses of the sensor in a bag.
        topic: topic of the clouds in a bag.
    """

    path: Path
    layout: str
    count: int
    stamps_ns: np.ndarray | None
    load: Callable[[int], Any]
    poses: BagPoses | None = None
    topic: str = ""


def open_clouds(path: str | Path, topic: str | None = None) -> RawClouds:
    """Open the clouds at a path: a bag, point cloud files, or a data set (see data.open).

    Args:
        topic: topic of the clouds of a bag that has several.

    Raises:
        InputError: the path cannot be opened.
    """
    path, path_topic = split_topic(path)
    if not path.exists():
        raise InputError(f"{path} does not exist; give a bag, a data set, or point cloud files")
    if files := list_cloud_files(path):
        return _open_files(path, files)
    if find_layout(path) is bag_frames:
        return _open_bag(path, topic or path_topic)
    recording = open_recording(path)
    stamps = np.array([frame.stamp_ns for frame in recording])
    return RawClouds(
        path,
        recording.layout,
        len(recording),
        stamps if recording.has_times else None,
        lambda i: _to_message(recording.frames[i]),
    )


def _open_bag(path: Path, topic: str) -> RawClouds:
    handle = BagHandle(path)
    bag = handle.get_bag()
    topic = bag_frames.choose_cloud_topic(bag, topic)
    if not bag.counts[topic]:
        raise InputError(f"{path} has no clouds on {topic}; record it again")
    frames = bag_frames.BagFrames(handle, topic, bag.topics[topic], bag.counts[topic])
    return RawClouds(
        path,
        f"{bag.layout}, clouds on {topic}",
        len(frames),
        frames.read_stamps(),
        frames.read_message,
        frames.poses,
        topic,
    )


def _open_files(path: Path, files: list[Path]) -> RawClouds:
    stamps = parse_times(files)
    return RawClouds(
        path,
        f"{len(files)} {files[0].suffix} file{'s' * (len(files) != 1)}",
        len(files),
        np.array(stamps) if stamps else None,
        lambda i: to_message(files[i], stamps[i] if stamps else 0),
    )


def _to_message(frame: Frame) -> Any:
    scan = frame.load()
    header = make_header(scan.stamp_ns, scan.frame_id or LIDAR_FRAME, make_bag_message)
    return from_array(to_point_array(scan), header, make_bag_message)


def choose_clouds(count: int, max_count: int) -> list[int]:
    """Choose up to `max_count` of `count` clouds, in evenly spread pairs; return their numbers.

    The two clouds of a pair show the robot's motion, and the pairs cover different places. Every
    other pair consists of adjacent clouds, for fast robots; in the other pairs, the clouds are
    PAIR_DISTANCE apart, for slow robots.
    """
    if count <= max_count or max_count < 2:
        return list(range(min(count, max_count)))
    pairs = max_count // 2
    gaps = np.where(np.arange(pairs) % 2 == 1, min(PAIR_DISTANCE, count - 1), 1)
    starts = np.linspace(0, count - 1 - gaps[-1], pairs).astype(int)
    return sorted({*starts.tolist(), *np.minimum(starts + gaps, count - 1).tolist()})
