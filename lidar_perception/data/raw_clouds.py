"""Clouds with all the columns that their driver gave them, whatever they lie in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lidar_perception.data import bag_frames
from lidar_perception.data.bag import KeptOpen
from lidar_perception.data.bag_poses import BagPoses
from lidar_perception.data.cloud_files import to_message
from lidar_perception.data.cloud_folder import cloud_files, named_times
from lidar_perception.data.frame import Frame
from lidar_perception.data.open import layout_of, open_recording, with_topic
from lidar_perception.data.to_bag import points_of
from lidar_perception.types import InputError
from lidar_perception.wire.codec import bag_message
from lidar_perception.wire.topics import LIDAR_FRAME
from msg_utils.point_cloud2 import from_array
from msg_utils.stamps import header_message

APART = 8  # clouds between those of a pair in which a slow robot moves: see spread


@dataclass(frozen=True)
class RawClouds:
    """Clouds in order of time. layout: what was recognised, for people; stamps_ns: those of all,
    None where the source has none or invents them; load(i) -> PointCloud2 of cloud i, of rosbags'
    class; poses: of the frame of a bag's clouds, and topic: theirs. InputError from load names
    what is broken."""

    path: Path
    layout: str
    count: int
    stamps_ns: np.ndarray | None
    load: Callable[[int], Any]
    poses: BagPoses | None = None
    topic: str = ""


def open_clouds(path: str | Path, topic: str | None = None) -> RawClouds:
    """The clouds at a path: a bag (topic: which, needed where several are recorded; see
    data.open), a file of clouds or a folder of them, or the folder of a data set as data.open
    knows it. InputError says what is missing, and what can be opened."""
    path, on = with_topic(path)
    if not path.exists():
        raise InputError(f"there is no {path}; give a bag, a data set, or files of clouds")
    if files := cloud_files(path):
        return _of_files(path, files)
    if layout_of(path) is bag_frames:
        return _of_bag(path, topic or on)
    recording = open_recording(path)
    stamps = np.array([frame.stamp_ns for frame in recording])
    return RawClouds(path, recording.layout, len(recording), stamps if recording.timed else None,
                     lambda i: _of_frame(recording.frames[i]))


def _of_bag(path: Path, topic: str) -> RawClouds:
    opened = KeptOpen(path)
    bag = opened.bag()
    topic = bag_frames.cloud_topic(bag, topic)
    if not bag.counts[topic]:
        raise InputError(f"{path} has no cloud on {topic}; record it again")
    frames = bag_frames.BagFrames(opened, topic, bag.topics[topic], bag.counts[topic])
    return RawClouds(path, f"{bag.layout}, clouds on {topic}", len(frames), frames.stamps(),
                     frames.message, frames.poses, topic)


def _of_files(path: Path, files: list[Path]) -> RawClouds:
    stamps = named_times(files)
    return RawClouds(path, f"{len(files)} {files[0].suffix} file{'s' * (len(files) != 1)}",
                     len(files), np.array(stamps) if stamps else None,
                     lambda i: to_message(files[i], stamps[i] if stamps else 0))


def _of_frame(frame: Frame) -> Any:
    scan = frame.load()
    header = header_message(scan.stamp_ns, scan.frame_id or LIDAR_FRAME, bag_message)
    return from_array(points_of(scan), header, bag_message)


def spread(count: int, wanted: int) -> list[int]:
    """Which clouds to look at: up to wanted numbers below count in ascending order, pairs evenly
    over all, so that motion shows within a pair and places differ between them: of a fast robot in
    those of neighbours, of a slow one in every second, whose clouds are APART."""
    if count <= wanted or wanted < 2:
        return list(range(min(count, wanted)))
    pairs = wanted // 2
    gaps = np.where(np.arange(pairs) % 2 == 1, min(APART, count - 1), 1)
    starts = np.linspace(0, count - 1 - gaps[-1], pairs).astype(int)
    return sorted({*starts.tolist(), *np.minimum(starts + gaps, count - 1).tolist()})
