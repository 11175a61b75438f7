"""A drive to be labelled: its frames, where the sensor was, and the clouds that were looked at."""

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
from lidar_perception.types import InputError, PointCloud, did_you_mean
from lidar_studio.interpolation import Motion
from lidar_studio.journal import header

Array = np.ndarray[Any, Any]
CACHE_BYTES = 200 * 10**6  # of clouds that are kept
MAGIC = b"LPC1"
COLORS = ("#e69f00", "#56b4e9", "#009e73", "#f0e442", "#cc79a7", "#0072b2", "#d55e00", "#999999",
          "#666666")  # Okabe and Ito's, which the colour-blind can tell apart, and two greys
SIZE = (1.0, 1.0, 1.0)     # of a new box of a class without a usual size


@dataclass(frozen=True)
class Scan:
    """N points of a frame in a random order that is always the same, so that the first ones are a
    thinned cloud: xyz (N, 3) float32, intensity (N,) uint8, ground (N,) bool, cluster_ids (N,)
    int32, 0 none."""

    xyz: Array
    intensity: Array
    ground: Array
    cluster_ids: Array

    @property
    def size(self) -> int:
        """Of memory."""
        return sum(a.nbytes for a in (self.xyz, self.intensity, self.ground, self.cluster_ids))

    def encoded(self) -> bytes:
        """As the page reads it: LPC1, N, the columns."""
        count = len(self.xyz)
        return b"".join((MAGIC, np.uint32(count).tobytes(), self.xyz.tobytes(),
                         self.intensity.tobytes(), self.ground.astype(np.uint8).tobytes(),
                         bytes(-2 * count % 4), self.cluster_ids.astype(np.uint32).tobytes()))


def settings(frame: Frame) -> PipelineParams:
    """How ground, clusters and candidates of a frame are found: as `best`, all around."""
    return with_values(BEST, {"view.enabled": False,
                              "ground.sensor_pose.height": frame.sensor_height})


def scanned(frame: Frame) -> Scan:
    """The cloud of a frame with ground and clusters. InputError where it cannot be read."""
    cloud = frame.load()
    found = segment_cloud(cloud, None, settings(frame))
    return scan_of(cloud, found.ground, found.cluster_ids)


def scan_of(cloud: PointCloud, ground: Array, cluster_ids: Array) -> Scan:
    """The scan of a cloud of N points with ground (N,) bool and cluster_ids (N,) int."""
    order = np.random.default_rng(0).permutation(len(cloud))
    intensity = np.zeros(len(cloud)) if cloud.intensity is None else cloud.intensity
    shown = np.nan_to_num(np.clip(intensity, 0.0, 1.0)) * 255
    return Scan(cloud.xyz[order], shown[order].astype(np.uint8), ground[order],
                cluster_ids[order].astype(np.int32))


class Clouds:
    """The scans of a drive, the last used ones kept, up to CACHE_BYTES. May be called from several
    threads; a scan is made once."""

    def __init__(self, make: Callable[[int], Scan], limit: int = CACHE_BYTES) -> None:
        self._make, self._limit, self._size = make, limit, 0
        self._kept: OrderedDict[int, Scan] = OrderedDict()
        self._making: dict[int, threading.Lock] = {}
        self._lock = threading.Lock()

    def __call__(self, i: int) -> Scan:
        """The scan of frame i."""
        with self._lock:
            making = self._making.setdefault(i, threading.Lock())
        with making:
            with self._lock:
                if (scan := self._kept.get(i)) is not None:
                    self._kept.move_to_end(i)
                    return scan
            scan = self._make(i)
            with self._lock:
                self._kept[i] = scan
                self._size += scan.size
                while self._size > self._limit and len(self._kept) > 1:
                    old, dropped = self._kept.popitem(last=False)
                    self._making.pop(old, None)
                    self._size -= dropped.size
            return scan


@dataclass(frozen=True, eq=False)
class Drive:
    """name and layout for people; recording: of one sequence; frames in the order of time; scan:
    makes the scan of a frame, by default with our own ground and clusters."""

    name: str
    recording: Recording
    scan: Callable[[Frame], Scan] = scanned

    @cached_property
    def frames(self) -> list[Frame]:
        """In the order of time."""
        return list(self.recording.frames)

    @property
    def first(self) -> int:
        """Number of the first frame."""
        return 0

    @property
    def end(self) -> int:
        """One more than the number of the last frame."""
        return len(self.frames)

    @cached_property
    def known_by(self) -> dict[str, Any]:
        """Its journal's header: names, stamps, a digest of the first and the last cloud, "" where
        they cannot be read, and whether there are poses."""
        try:
            clouds = b"".join(self.frames[i].load().xyz.tobytes() for i in (0, -1))
        except InputError:
            digest = ""
        else:
            digest = hashlib.sha256(clouds).hexdigest()[:16]
        return header(self.name, [f.name for f in self.frames],
                      [f.stamp_ns for f in self.frames], digest, self.motion.poses is not None)

    @cached_property
    def motion(self) -> Motion:
        """Times, and poses where every frame has one."""
        stamps = np.array([frame.stamp_ns for frame in self.frames], np.int64)
        poses = [frame.pose() for frame in self.frames]
        if not poses or not all(map(is_valid_pose, poses)):
            return Motion.of(stamps)
        return Motion.of(stamps, np.array(poses, np.float64))

    @cached_property
    def clouds(self) -> Clouds:
        """Its scans."""
        return Clouds(lambda i: self.scan(self.frames[i]))


def one_drive(recording: Recording, sequence: str | None = None) -> Drive:
    """The drive of a recording, or that of one of its sequences. InputError where there are
    several, or none of that name."""
    every = recording.frames[:]  # of a bag, without the clouds that iterating would keep
    names = list(dict.fromkeys(frame.sequence for frame in every))
    listed = f"{', '.join(names[:10])}{', ...' if len(names) > 10 else ''}"
    if sequence is None and len(names) > 1:
        raise InputError(f"{recording.path} has {len(names)} drives; name one with --sequence: "
                         f"{listed}")
    if sequence is not None and sequence not in names:
        raise InputError(f"{recording.path} has no drive {sequence}; it has {listed}"
                         + did_you_mean(sequence, names))
    chosen = names[0] if sequence is None else sequence
    frames = [frame for frame in every if frame.sequence == chosen]
    path = Path(recording.path).absolute()
    return Drive("_".join(filter(None, (path.name, chosen))), replace(recording, frames=frames))


def require_clouds(drive: Drive) -> None:
    """Raise the InputError of the first frame if neither its cloud nor the middle or last one can
    be read."""
    problems: list[InputError] = []
    for i in sorted({0, len(drive.frames) // 2, len(drive.frames) - 1}):
        try:
            drive.frames[i].load()
            return
        except InputError as error:
            problems.append(error)
    raise problems[0]


def classes() -> list[dict[str, Any]]:
    """What the page offers as classes: name, usual size, colour."""
    named = [row for row in TABLE if row.name != "DontCare"]
    return [{"name": row.name, "color": color,
             "size": list(row.numbers.mean_size if row.numbers else SIZE)}
            for row, color in zip(named, COLORS)]
