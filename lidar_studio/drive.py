"""A drive to label or view: its frames, sensor poses, and a cache of segmented clouds."""

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
DEFAULT_SIZE_M = (1.0, 1.0, 1.0)  # size of a new box if its class has no usual size


@dataclass(frozen=True)
class Scan:
    """A segmented cloud. The points are in random order, so that the first ones are a sample.

    xyz (N, 3) float32 in metres, intensity (N,) uint8, ground (N,) bool, cluster_ids (N,) int32
    with 0 for no cluster.
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
        """Return the bytes of /api/cloud: the magic LPC1, N, then the columns."""
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
    """Return the parameters of the configuration `best`, for all directions and the sensor height of a
    frame."""
    return with_values(BEST, {"view.enabled": False, "ground.sensor_pose.height": frame.sensor_height})


def segment_frame(frame: Frame) -> Scan:
    """Load the cloud of a frame and segment it. InputError if it cannot be read."""
    cloud = frame.load()
    segmented = segment_cloud(cloud, None, make_pipeline_params(frame))
    return to_scan(cloud, segmented.ground, segmented.cluster_ids)


def to_scan(cloud: PointCloud, ground: Array, cluster_ids: Array) -> Scan:
    """Make the scan of N points with ground (N,) bool and cluster_ids (N,) int."""
    order = np.random.default_rng(0).permutation(len(cloud))
    intensity = np.zeros(len(cloud)) if cloud.intensity is None else cloud.intensity
    scaled = np.nan_to_num(np.clip(intensity, 0.0, 1.0)) * 255
    return Scan(cloud.xyz[order], scaled[order].astype(np.uint8), ground[order], cluster_ids[order].astype(np.int32))


class ScanCache:
    """Thread-safe LRU cache of scans, up to `limit` bytes. Concurrent requests make a scan only once."""

    def __init__(self, make: Callable[[int], Scan], limit: int = MAX_CACHE_BYTES) -> None:
        self._make, self._limit, self._size = make, limit, 0
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
            scan = self._make(i)
            with self._lock:
                self._scans[i] = scan
                self._size += scan.nbytes
                while self._size > self._limit and len(self._scans) > 1:
                    index, oldest = self._scans.popitem(last=False)
                    self._locks.pop(index, None)
                    self._size -= oldest.nbytes
            return scan


@dataclass(frozen=True, eq=False)
class Drive:
    """A recording of one sequence.

    scan: makes the scan of a frame; by default it segments the cloud.
    """

    name: str
    recording: Recording
    scan: Callable[[Frame], Scan] = segment_frame

    @cached_property
    def frames(self) -> list[Frame]:
        """The frames in order of time."""
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
        """Header of the drive's journal, with a digest of the first and last cloud, or "" if they
        cannot be read."""
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
        """Times of the frames, with poses if every frame has one."""
        stamps = np.array([frame.stamp_ns for frame in self.frames], np.int64)
        poses = [frame.pose() for frame in self.frames]
        if not poses or not all(map(is_valid_pose, poses)):
            return Motion.of(stamps)
        return Motion.of(stamps, np.array(poses, np.float64))

    @cached_property
    def load_scan(self) -> ScanCache:
        """Function that returns the scan of a frame by its index, with a cache."""
        return ScanCache(lambda i: self.scan(self.frames[i]))


def select_drive(recording: Recording, sequence: str | None = None) -> Drive:
    """Return the drive of a recording, or of one of its sequences.

    Raises:
        InputError: the recording has several drives and `sequence` is None, or has none of this
            name.
    """
    all_frames = recording.frames[:]  # a slice, because iterating over a bag keeps the clouds in memory
    names = list(dict.fromkeys(frame.sequence for frame in all_frames))
    names_text = f"{', '.join(names[:10])}{', ...' if len(names) > 10 else ''}"
    if sequence is None and len(names) > 1:
        raise InputError(f"{recording.path} has {len(names)} drives; name one with --sequence: {names_text}")
    if sequence is not None and sequence not in names:
        raise InputError(
            f"{recording.path} has no drive {sequence}; it has {names_text}" + suggest_name(sequence, names)
        )
    selected = names[0] if sequence is None else sequence
    frames = [frame for frame in all_frames if frame.sequence == selected]
    path = Path(recording.path).absolute()
    return Drive("_".join(filter(None, (path.name, selected))), replace(recording, frames=frames))


def require_clouds(drive: Drive) -> None:
    """Raise InputError if the first, middle and last cloud are all unreadable."""
    problems: list[InputError] = []
    for i in sorted({0, len(drive.frames) // 2, len(drive.frames) - 1}):
        try:
            drive.frames[i].load()
            return
        except InputError as error:
            problems.append(error)
    raise problems[0]


def list_classes() -> list[dict[str, Any]]:
    """Return the classes of the page: name, usual size, colour."""
    named = [row for row in TABLE if row.name != "DontCare"]
    return [
        {"name": row.name, "color": color, "size": list(row.numbers.mean_size if row.numbers else DEFAULT_SIZE_M)}
        for row, color in zip(named, COLORS)
    ]
