"""A drive to label or view, with its frames, sensor poses and a cache of segmented clouds."""

from __future__ import annotations

import hashlib
import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from lidar_perception.candidates.configurations import BEST
from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.pipeline import segment_cloud
from lidar_perception.classes import TABLE
from lidar_perception.data.frame import Frame, Recording
from lidar_perception.param_fields import with_values
from lidar_perception.tracking.ego import is_valid_pose
from lidar_perception.types import InputError, PointCloud, suggest_name
from lidar_studio.interpolation import Motion
from lidar_studio.journal import make_journal_header

Array = np.ndarray[Any, Any]
MAX_CACHE_BYTES = 200 * 10**6
MAGIC = b"LPC1"
COLORS = (
    "#e69f00",
    "#56b4e9",
    "#009e73",
    "#f0e442",
    "#cc79a7",
    "#0072b2",
    "#d55e00",
    "#999999",
    "#666666",
)  # colour-blind safe palette of Okabe and Ito, and two greys
DEFAULT_SIZE_M = (1.0, 1.0, 1.0)  # size of new boxes of classes without a mean size


@dataclass(frozen=True)
class Scan:
    """Segmented cloud of N points in random order, so that the first points are a random sample.

    Attributes:
        xyz: (N, 3) float32 in metres.
        intensity: (N,) uint8.
        ground: (N,) bool, True for ground points.
        cluster_ids: (N,) int32, 0 for points without a cluster.
    """

    xyz: Array
    intensity: Array
    ground: Array
    cluster_ids: Array

    @property
    def nbytes(self) -> int:
        """Size of the arrays in bytes."""
        return sum(a.nbytes for a in (self.xyz, self.intensity, self.ground, self.cluster_ids))

    def encode(self) -> bytes:
        """Return the response of /api/cloud: the magic bytes LPC1, N, then the columns."""
        count = len(self.xyz)
        return b"".join(
            (
                MAGIC,
                np.uint32(count).tobytes(),
                self.xyz.tobytes(),
                self.intensity.tobytes(),
                self.ground.astype(np.uint8).tobytes(),
                bytes(-2 * count % 4),
                self.cluster_ids.astype(np.uint32).tobytes(),
            )
        )


def make_pipeline_params(frame: Frame) -> PipelineParams:
    """Return the configuration `best` for clouds all around the sensor, with the sensor height of a frame."""
    return with_values(BEST, {"view.enabled": False, "ground.sensor_pose.height": frame.sensor_height})


def segment_frame(frame: Frame) -> Scan:
    """Load and segment the cloud of a frame. Raises InputError if it cannot be read."""
    cloud = frame.load()
    segmented = segment_cloud(cloud, None, make_pipeline_params(frame))
    return to_scan(cloud, segmented.ground, segmented.cluster_ids)


def to_scan(cloud: PointCloud, ground: Array, cluster_ids: Array) -> Scan:
    """Make a scan from N points with ground (N,) bool and cluster_ids (N,) int."""
    order = np.random.default_rng(0).permutation(len(cloud))
    intensity = np.zeros(len(cloud)) if cloud.intensity is None else cloud.intensity
    intensity = np.nan_to_num(np.clip(intensity, 0.0, 1.0)) * 255
    return Scan(cloud.xyz[order], intensity[order].astype(np.uint8), ground[order], cluster_ids[order].astype(np.int32))


class ScanCache:
    """Thread-safe LRU cache of up to `max_bytes`. Concurrent requests for a frame make its scan only once."""

    def __init__(self, make_scan: Callable[[int], Scan], max_bytes: int = MAX_CACHE_BYTES) -> None:
        self._make_scan, self._max_bytes, self._size = make_scan, max_bytes, 0
        self._scans: OrderedDict[int, Scan] = OrderedDict()
        self._locks: dict[int, threading.Lock] = {}
        self._lock = threading.Lock()

    def __call__(self, i: int) -> Scan:
        """Return the scan of frame i."""
        with self._lock:
            lock = self._locks.setdefault(i, threading.Lock())
        with lock:
            with self._lock:
                if (scan := self._scans.get(i)) is not None:
                    self._scans.move_to_end(i)
                    return scan
            scan = self._make_scan(i)
            with self._lock:
                self._scans[i] = scan
                self._size += scan.nbytes
                while self._size > self._max_bytes and len(self._scans) > 1:
                    index, oldest_scan = self._scans.popitem(last=False)
                    self._locks.pop(index, None)
                    self._size -= oldest_scan.nbytes
            return scan


@dataclass(frozen=True, eq=False)
class Drive:
    """A recording of one sequence.

    Attributes:
        make_scan: Function that makes the scan of a frame; by default, it segments the cloud.
    """

    name: str
    recording: Recording
    make_scan: Callable[[Frame], Scan] = segment_frame

    @cached_property
    def frames(self) -> list[Frame]:
        """Frames in order of time."""
        return list(self.recording.frames)

    @property
    def first(self) -> int:
        """Index of the first frame."""
        return 0

    @property
    def end(self) -> int:
        """One past the index of the last frame."""
        return len(self.frames)

    @cached_property
    def journal_header(self) -> dict[str, Any]:
        """First line of the drive's journal, with a digest of the first and last cloud if they can be read."""
        try:
            clouds = b"".join(self.frames[i].load().xyz.tobytes() for i in (0, -1))
        except InputError:
            digest = ""
        else:
            digest = hashlib.sha256(clouds).hexdigest()[:16]
        return make_journal_header(
            self.name,
            [f.name for f in self.frames],
            [f.stamp_ns for f in self.frames],
            digest,
            self.motion.poses is not None,
        )

    @cached_property
    def motion(self) -> Motion:
        """Times of the frames, and the sensor poses if every frame has a valid one."""
        stamps = np.array([frame.stamp_ns for frame in self.frames], np.int64)
        poses = [frame.pose() for frame in self.frames]
        if not poses or not all(map(is_valid_pose, poses)):
            return Motion.from_stamps(stamps)
        return Motion.from_stamps(stamps, np.array(poses, np.float64))

    @cached_property
    def load_scan(self) -> ScanCache:
        """Cached function that returns the scan of frame i."""
        return ScanCache(lambda i: self.make_scan(self.frames[i]))


def select_drive(recording: Recording, sequence: str | None = None) -> Drive:
    """Return the only drive of a recording, or the one with this sequence name.

    Raises:
        InputError: The recording has several drives and `sequence` is None, or it has no drive with
            this name.
    """
    all_frames = recording.frames[:]  # a slice, because iteration over a bag keeps its clouds in memory
    names = list(dict.fromkeys(frame.sequence for frame in all_frames))
    names_text = f"{', '.join(names[:10])}{', ...' if len(names) > 10 else ''}"
    if sequence is None and len(names) > 1:
        raise InputError(f"{recording.path} has {len(names)} drives; choose one with --sequence: {names_text}")
    if sequence is not None and sequence not in names:
        raise InputError(
            f"{recording.path} has no drive {sequence}; available drives: {names_text}" + suggest_name(sequence, names)
        )
    selected_name = names[0] if sequence is None else sequence
    frames = [frame for frame in all_frames if frame.sequence == selected_name]
    path = Path(recording.path).absolute()
    return Drive("_".join(filter(None, (path.name, selected_name))), replace(recording, frames=frames))


def require_clouds(drive: Drive) -> None:
    """Raise InputError if none of the first, middle and last cloud can be read."""
    errors: list[InputError] = []
    for i in sorted({0, len(drive.frames) // 2, len(drive.frames) - 1}):
        try:
            drive.frames[i].load()
            return
        except InputError as error:
            errors.append(error)
    raise errors[0]


def list_classes() -> list[dict[str, Any]]:
    """Return name, colour and mean size of each class, as JSON objects for the page."""
    rows = [row for row in TABLE if row.name != "DontCare"]
    return [
        {"name": row.name, "color": color, "size": list(row.numbers.mean_size if row.numbers else DEFAULT_SIZE_M)}
        for row, color in zip(rows, COLORS)
    ]
