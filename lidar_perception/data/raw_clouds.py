"""Clouds with all the columns that their driver gave them, whatever they lie in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lidar_perception.data import bag_frames
from lidar_perception.data.bag import Bag
from lidar_perception.data.frame import Frame
from lidar_perception.data.nuscenes.folder import SWEEP
from lidar_perception.data.open import open_recording
from lidar_perception.data.pcd import read_pcd
from lidar_perception.data.records import read_records
from lidar_perception.data.to_bag import points_of
from lidar_perception.types import InputError
from lidar_perception.wire.codec import bag_message
from lidar_perception.wire.topics import LIDAR_FRAME, POINTS
from msg_utils.point_cloud2 import from_array
from msg_utils.stamps import header_message

CLOUD = "sensor_msgs/msg/PointCloud2"
KITTI = "x y z intensity"
MAX_RING = 256
SAMPLE = 2000  # points on which the columns of a .bin file are told


@dataclass(frozen=True)
class RawClouds:
    """Clouds in order of time. layout: what was recognised, for people; stamps_ns: those of all,
    None where the source has none or invents them; load(i) -> PointCloud2 of cloud i, of rosbags'
    class. InputError from load names what is broken."""

    path: Path
    layout: str
    count: int
    stamps_ns: np.ndarray | None
    load: Callable[[int], Any]


def open_clouds(path: str | Path, topic: str | None = None) -> RawClouds:
    """The clouds at a path: a bag (topic: which, needed where several are recorded), a .pcd or .bin
    file or a folder of them, or the folder of a data set as data.open knows it. InputError says
    what is missing, and what can be opened."""
    path = Path(path)
    if not path.exists():
        raise InputError(f"there is no {path}; give a bag, a data set, or .pcd or .bin files")
    files = [path] if path.is_file() else sorted(
        file for file in path.iterdir() if file.suffix in (".pcd", ".bin") and file.is_file())
    if files and files[0].suffix in (".pcd", ".bin"):
        return _of_files(path, files)
    if bag_frames.recognises(path):
        return _of_bag(path, topic)
    recording = open_recording(path)
    stamps = np.array([frame.stamp_ns for frame in recording])
    named = "nuScenes" in recording.layout or "raw" in recording.layout
    return RawClouds(path, recording.layout, len(recording), stamps if named else None,
                     lambda i: _of_frame(recording.frames[i]))


def _of_bag(path: Path, topic: str | None) -> RawClouds:
    with Bag(path) as bag:
        clouds = sorted(t for t, kind in bag.topics.items() if kind == CLOUD and bag.counts[t])
        if topic is None and POINTS in clouds:
            topic = POINTS
        if topic is None and len(clouds) > 1:
            raise InputError(f"{path} has clouds of several sensors; give the topic of one with "
                             f"--topic: {', '.join(clouds)}")
        topic = topic or (clouds or [POINTS])[0]
        bag.require(topic)
        if not bag.counts[topic] or bag.topics[topic] != CLOUD:
            raise InputError(f"{path} has no cloud on {topic}; record it again, or give another "
                             "--topic")
        frames = bag_frames.BagFrames(path, topic, CLOUD, bag.counts[topic])
    return RawClouds(path, f"rosbag2 bag, clouds on {topic}", len(frames), frames.stamps(),
                     frames.message)


def _of_files(path: Path, files: list[Path]) -> RawClouds:
    def load(i: int) -> Any:
        points = read_pcd(files[i]) if files[i].suffix == ".pcd" else _of_records(files[i])
        if missing := {"x", "y", "z"} - set(points.dtype.names or ()):
            raise InputError(f"{files[i]} has no field {min(missing)}; it is no cloud of points")
        # A PointCloud2 has no whole numbers of 64 bits: times as float64 keep their microseconds.
        kinds = [(name, points.dtype[name].base.str.replace("i8", "f8").replace("u8", "f8"),
                  points.dtype[name].shape) for name in points.dtype.names or ()]
        try:
            return from_array(points.astype(kinds), header_message(0, "", bag_message), bag_message)
        except ValueError as error:
            raise InputError(f"{files[i]}: {error}") from None
    return RawClouds(path, f"{len(files)} {files[0].suffix} file{'s' * (len(files) != 1)}",
                     len(files), None, load)


def _of_records(file: Path) -> np.ndarray:
    """A .bin file of float32: KITTI's four columns, or nuScenes' five, whose last is the ring."""
    if file.stat().st_size % 20 == 0:
        cloud = read_records(file, SWEEP)
        ring = cloud[:SAMPLE, 4]
        with np.errstate(invalid="ignore"):
            if ((ring >= 0) & (ring < MAX_RING) & (ring == np.floor(ring))).all():
                return _structured(cloud, SWEEP)
    return _structured(read_records(file, KITTI), KITTI)


def _structured(cloud: np.ndarray, columns: str) -> np.ndarray:
    names = columns.split()
    return np.ascontiguousarray(cloud).view([(name, np.float32) for name in names]).reshape(-1)


def _of_frame(frame: Frame) -> Any:
    scan = frame.load()
    header = header_message(scan.stamp_ns, scan.frame_id or LIDAR_FRAME, bag_message)
    return from_array(points_of(scan), header, bag_message)


def spread(count: int, wanted: int) -> list[int]:
    """Which clouds to look at: up to wanted numbers below count in ascending order, pairs of
    neighbours evenly over all, so that motion shows within a pair and places differ between
    them."""
    if count <= wanted:
        return list(range(count))
    starts = np.linspace(0, count - 2, max(wanted // 2, 1)).astype(int)
    return sorted({int(i) + k for i in starts for k in (0, 1)})
