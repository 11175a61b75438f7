"""Where labelled scenes come from: recordings, and simulated streets with a cache on disk.

A source has a length, scene(i) to train on, and frame(i) to validate on. It can be sent to other
processes: files are opened where they are read.
"""

from __future__ import annotations

import hashlib
import io
import os
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from lidar_perception import __version__
from lidar_perception.data.frame import Frame
from lidar_perception.data.open import open_recording
from lidar_perception.runs.files import write_bytes
from lidar_perception.simulation.camera import FORWARD_CAMERA, kitti_labels, worth_a_label
from lidar_perception.simulation.drive import longest_drive, scan_at
from lidar_perception.simulation.scene import ANY, Streets
from lidar_perception.simulation.sensor import Sensor, sensor_named
from lidar_perception.training.augment import TrainingScene
from lidar_perception.types import SENSOR_HEIGHT, GroundTruth, InputError, LidarFrame


@dataclass(frozen=True)
class RecordedScenes:
    """The frames of a recording with these names. view: the points in the image only, where there
    is a camera, as the labels end there."""

    path: Path
    names: tuple[str, ...]
    view: bool = True

    def __len__(self) -> int:
        return len(self.names)

    @cached_property
    def _frames(self) -> dict[str, Frame]:
        recording = open_recording(self.path)
        numbers = {frame.name: i for i, frame in enumerate(recording)}
        return {name: recording.frames[numbers[name]] for name in self.names}

    def __getstate__(self) -> dict:
        return {k: v for k, v in self.__dict__.items() if k != "_frames"}  # open where it is read

    def scene(self, i: int) -> TrainingScene:
        """InputError naming the file that cannot be used."""
        frame = self.frame(i)
        scan, truth, camera = frame.load(), frame.truth(), frame.camera()
        intensity = np.zeros(len(scan), np.float32) if scan.intensity is None else scan.intensity
        points = np.column_stack([scan.xyz, intensity])
        if self.view and camera is not None:
            points = points[camera.in_view(scan.xyz)]
        return TrainingScene(points, truth.boxes, truth.class_ids, np.ones(len(truth), bool),
                     around=camera is None)

    def frame(self, i: int) -> Frame:
        """To validate on: the whole scan. InputError if it has no labels."""
        frame = self._frames[self.names[i]]
        if frame.truth() is None:
            raise InputError(f"{frame.points or frame.name} has no labels")
        return frame


def random_split(names: tuple[str, ...], share: float,
                 seed: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """names to train on and to validate on, drawn by the seed, each in the order given; both have
    one at least. InputError if there are not two."""
    if len(names) < 2:
        raise InputError("one frame cannot be split into frames to train and to validate on; give "
                         "--val")
    held = min(max(round(share * len(names)), 1), len(names) - 1)
    chosen = set(np.random.default_rng(seed).choice(len(names), held, replace=False).tolist())
    return (tuple(name for i, name in enumerate(names) if i not in chosen),
            tuple(name for i, name in enumerate(names) if i in chosen))


@dataclass(frozen=True)
class SimulatedScenes:
    """count scans of the streets first, first + 1, ..., of each so many, spread over its drive. To
    make a street takes as long as to scan it. cache: folder for scans, or None; from cache_gb on
    nothing is added to it."""

    first: int
    count: int
    sensor: str = "hdl64e"
    streets: Streets = ANY
    cache: Path | None = None
    cache_gb: float = 20.0
    per_street: int = 1

    def __len__(self) -> int:
        return self.count

    def _at(self, i: int) -> tuple[int, int]:
        """Street and frame of scan i."""
        street, part = divmod(i, self.per_street)
        return self.first + street, part * longest_drive(self._sensor) // self.per_street

    @cached_property
    def _sensor(self) -> Sensor:
        return replace(sensor_named(self.sensor), height=SENSOR_HEIGHT)

    def scene(self, i: int) -> TrainingScene:
        """With the labels all around."""
        frame, truth = self.scan(i)
        return TrainingScene(np.column_stack([frame.xyz, frame.intensity]), truth.boxes,
                             truth.class_ids, worth_a_label(truth), around=True)

    def frame(self, i: int) -> Frame:
        """To validate on: with the labels that KITTI would have, in the image of a camera that
        looks ahead."""
        scan, truth = self.scan(i)
        street, part = self._at(i)
        return Frame.of(f"street {street} frame {part}", scan, kitti_labels(truth), FORWARD_CAMERA)

    def scan(self, i: int) -> tuple[LidarFrame, GroundTruth]:
        """The frame and all its objects, from the cache if they are there."""
        path = self._path(i)
        if path is not None and path.is_file():
            try:
                return _read_scan(path)
            except (OSError, ValueError, KeyError, EOFError, BadZipFile):
                path.unlink(missing_ok=True)  # it is made again
        scan = scan_at(*self._at(i), self._sensor, self.streets)
        if path is not None and _size(path.parent) < self.cache_gb * 1e9:
            _write_scan(path, scan.frame, scan.truth)
        return scan.frame, scan.truth

    def _path(self, i: int) -> Path | None:
        if self.cache is None:
            return None
        # One folder, so that its size is soon known; the name says all that the scan depends on.
        made = hashlib.sha1(repr((self._sensor, tuple(self.streets), __version__)).encode())
        street, part = self._at(i)
        return self.cache / f"{made.hexdigest()[:12]}_{street:08}_{part:03}.npz"


EXTRAS = ("track_id", "truncated", "occluded", "num_points", "visible")


def _write_scan(path: Path, frame: LidarFrame, truth: GroundTruth) -> None:
    content = io.BytesIO()
    extras = {name: np.array([e[name] for e in truth.extras]) for name in EXTRAS}
    np.savez(content, xyz=frame.xyz, intensity=frame.intensity, boxes=truth.boxes,
             class_ids=truth.class_ids, **extras)
    write_bytes(path, content.getbuffer())


def _read_scan(path: Path) -> tuple[LidarFrame, GroundTruth]:
    with np.load(path) as arrays:
        columns = [arrays[name].tolist() for name in EXTRAS]
        extras = [dict(zip(EXTRAS, row)) for row in zip(*columns)]
        return (LidarFrame(arrays["xyz"], arrays["intensity"]),
                GroundTruth.of(arrays["boxes"], arrays["class_ids"], extras))


def _size(folder: Path) -> int:
    """Bytes of the files in a folder; 0 where there is none."""
    try:
        with os.scandir(folder) as entries:
            return sum(entry.stat().st_size for entry in entries if entry.is_file())
    except OSError:
        return 0
