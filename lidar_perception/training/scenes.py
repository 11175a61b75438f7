"""Where labelled scenes come from: recordings, and simulated scenes with a cache on disk.

A source has a length, scene(i) to train on, and frame(i) to validate on. It can be sent to other
processes: files are opened where they are read.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from lidar_perception.data.frame import Frame
from lidar_perception.data.open import open_recording, with_topic
from lidar_perception.simulation.camera import (
    FORWARD_CAMERA,
    kitti_labels,
    labels_around,
    turned_camera,
    worth_a_label,
)
from lidar_perception.simulation.drive import longest_drive, scan_at
from lidar_perception.simulation.scene import ANY, Scenes
from lidar_perception.simulation.sensor import HDL64E, Sensor
from lidar_perception.training.augment import TrainingScene
from lidar_perception.training.cache import kept, path_in, size_of, state_of
from lidar_perception.types import GroundTruth, InputError, LidarFrame


@dataclass(frozen=True)
class RecordedScenes:
    """The frames of a recording with these names. view: the points in the image only, where there
    is a camera, as the labels end there. height: of the sensor above the ground, metres, where it
    is not what the recording says."""

    path: Path
    names: tuple[str, ...]
    view: bool = True
    height: float | None = None

    def __len__(self) -> int:
        return len(self.names)

    @cached_property
    def _frames(self) -> dict[str, Frame]:
        frames = open_recording(self.path, sensor_height=self.height).frames[:]
        known = {frame.name: frame for frame in frames}
        return {name: known[name] for name in self.names}

    def __getstate__(self) -> dict:
        return {k: v for k, v in self.__dict__.items() if k != "_frames"}  # open where it is read

    @property
    def sensor_height(self) -> float:
        """Of the first frame, metres above the ground."""
        return self._frames[self.names[0]].sensor_height

    def key(self, i: int) -> str:
        """All that scene i depends on: another one once a file of it was written again."""
        frame = self._frames[self.names[i]]
        return repr((*map(state_of, frame.files), with_topic(self.path)[1], frame.name, self.view,
                     frame.sensor_height))

    def scene(self, i: int) -> TrainingScene:
        """InputError naming the file that cannot be used."""
        frame, truth = self._labelled(i)
        scan, camera = frame.load(), frame.camera()
        points = scan.points()
        if self.view and camera is not None:
            points = points[camera.in_view(scan.xyz)]
        return TrainingScene(points, truth.boxes, truth.class_ids, np.ones(len(truth), bool),
                     camera is None, frame.sensor_height)

    def frame(self, i: int) -> Frame:
        """To validate on: the whole scan. InputError if it has no labels."""
        return self._labelled(i)[0]

    def _labelled(self, i: int) -> tuple[Frame, GroundTruth]:
        frame = self._frames[self.names[i]]
        truth = frame.truth()
        if truth is None:
            raise InputError(f"{frame.points or frame.name} has no labels")
        return frame, truth


@dataclass(frozen=True)
class SimulatedScenes:
    """count scans of the scenes first, first + 1, ..., of each so many, spread over its drive. To
    make a scene takes as long as to scan it. cache: folder for scans, or None; from cache_gb on
    nothing is added to it. around: frames to validate on have their labels in the image of a camera
    that looks ahead, left, behind, right in turn, not ahead only."""

    first: int
    count: int
    sensor: Sensor = HDL64E
    scenes: Scenes = ANY
    cache: Path | None = None
    cache_gb: float = 20.0
    per_scene: int = 1
    around: bool = False

    def __len__(self) -> int:
        return self.count

    def at(self, i: int) -> tuple[int, int]:
        """Scene and frame of scan i."""
        scene, part = divmod(i, self.per_scene)
        return self.first + scene, part * longest_drive(self.sensor) // self.per_scene

    def key(self, i: int) -> str:
        """All that scan i depends on."""
        return repr((self.sensor, tuple(self.scenes), self.at(i)))

    def path(self, i: int) -> Path | None:
        """The file that keeps scan i."""
        return path_in(self.cache, self.key(i))

    def scene(self, i: int) -> TrainingScene:
        """With the labels all around."""
        frame, truth = self.scan(i)
        return TrainingScene(frame.points(), truth.boxes, truth.class_ids, worth_a_label(truth),
                             True, self.sensor.height)

    def frame(self, i: int) -> Frame:
        """To validate on: with the labels that KITTI would have in the image of a camera, or all
        around where there is none."""
        scan, truth = self.scan(i)
        scene, part = self.at(i)
        if not self.scenes.camera:
            return Frame.of(f"scene {scene} frame {part}", scan, labels_around(truth),
                            sensor_height=self.sensor.height)
        camera = turned_camera(np.pi / 2 * (i % 4)) if self.around else FORWARD_CAMERA
        return Frame.of(f"street {scene} frame {part}", scan, kitti_labels(truth, camera), camera,
                        sensor_height=self.sensor.height)

    def scan(self, i: int) -> tuple[LidarFrame, GroundTruth]:
        """The frame and all its objects, from the cache if they are there."""
        return kept(self.path(i), lambda: self._simulated(i), _read_scan, _scan_arrays,
                    self.cache_gb)

    def keep(self, i: int) -> None:
        """Put scan i into the cache, if there is room."""
        if self.cache is not None and size_of(self.cache) < self.cache_gb * 1e9:
            self.scan(i)

    def _simulated(self, i: int) -> tuple[LidarFrame, GroundTruth]:
        scan = scan_at(*self.at(i), self.sensor, self.scenes)
        return scan.frame, scan.truth


EXTRAS = ("track_id", "truncated", "occluded", "num_points", "visible")


def _scan_arrays(scan: tuple[LidarFrame, GroundTruth]) -> dict[str, np.ndarray]:
    frame, truth = scan
    assert frame.intensity is not None  # as of all simulated scans
    extras = {name: np.array([e[name] for e in truth.extras]) for name in EXTRAS}
    return dict(xyz=frame.xyz, intensity=frame.intensity, boxes=truth.boxes,
                class_ids=truth.class_ids, **extras)


def _read_scan(arrays: Any) -> tuple[LidarFrame, GroundTruth]:
    columns = [arrays[name].tolist() for name in EXTRAS]
    extras = [dict(zip(EXTRAS, row)) for row in zip(*columns)]
    return (LidarFrame(arrays["xyz"], arrays["intensity"]),
            GroundTruth.of(arrays["boxes"], arrays["class_ids"], extras))
