"""Sources of labelled scenes: recordings, and simulated scenes with a cache on disk.

A source has a length, load_scene(i) for training and load_frame(i) for validation. It can be
pickled: each process opens the files that it reads.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from lidar_perception.data.frame import Frame
from lidar_perception.data.open import open_recording, split_topic
from lidar_perception.simulation.camera import (
    FORWARD_CAMERA,
    find_labelled,
    make_kitti_labels,
    rotate_camera,
    select_labels,
)
from lidar_perception.simulation.drive import count_drive_scans, simulate_scan
from lidar_perception.simulation.scene import ALL_STREETS, Scenes
from lidar_perception.simulation.sensor import HDL64E, Sensor
from lidar_perception.training.augment import TrainingScene
from lidar_perception.training.cache import file_fingerprint, load_or_compute, make_cache_path
from lidar_perception.types import GroundTruth, InputError, PointCloud

EXTRAS = ("track_id", "truncated", "occluded", "num_points", "visible")  # keys of GroundTruth.extras to cache


@dataclass(frozen=True)
class RecordedScenes:
    """Frames of a recording.

    Attributes:
        path: Path of the recording.
        names: Names of the frames.
        view: True to use only the points in the camera image, if there is one, because KITTI labels
            only objects in it.
        height: Height of the sensor above the ground in metres; None uses that of the recording.
    """

    path: Path
    names: tuple[str, ...]
    view: bool = True
    height: float | None = None

    def __len__(self) -> int:
        return len(self.names)

    @cached_property
    def _frames(self) -> dict[str, Frame]:
        frames = open_recording(self.path, sensor_height=self.height).frames[:]
        frames_by_name = {frame.name: frame for frame in frames}
        return {name: frames_by_name[name] for name in self.names}

    def __getstate__(self) -> dict:
        return {k: v for k, v in self.__dict__.items() if k != "_frames"}

    @property
    def sensor_height(self) -> float:
        """Height of the sensor above the ground in the first frame, in metres."""
        return self._frames[self.names[0]].sensor_height

    def cache_key(self, i: int) -> str:
        """Return the cache key of scene i, which changes when one of its files changes."""
        frame = self._frames[self.names[i]]
        return repr(
            (*map(file_fingerprint, frame.files), split_topic(self.path)[1], frame.name, self.view, frame.sensor_height)
        )

    def load_scene(self, i: int) -> TrainingScene:
        """Load scene i for training. Raise InputError with the name of the file if it cannot be read."""
        frame, truth = self._find_labelled_frame(i)
        scan, camera = frame.load(), frame.camera()
        points = scan.points()
        if self.view and camera is not None:
            points = points[camera.in_view(scan.xyz)]
        return TrainingScene(
            points, truth.boxes, truth.class_ids, np.ones(len(truth), bool), camera is None, frame.sensor_height
        )

    def load_frame(self, i: int) -> Frame:
        """Return frame i for validation, with all points. Raise InputError if it has no labels."""
        return self._find_labelled_frame(i)[0]

    def _find_labelled_frame(self, i: int) -> tuple[Frame, GroundTruth]:
        frame = self._frames[self.names[i]]
        truth = frame.truth()
        if truth is None:
            raise InputError(f"{frame.points or frame.name} has no labels")
        return frame, truth


@dataclass(frozen=True)
class SimulatedScenes:
    """Simulated scans of scenes with consecutive seeds.

    Attributes:
        first_seed: Seed of the first scene.
        count: Number of scans.
        sensor: The sensor.
        scenes: Types of the scenes.
        cache: Folder of cached scans, or None.
        cache_gb: Maximum size of the cache, GB.
        scans_per_scene: Number of scans of each scene, spread over its drive. Several scans save
            time, because making a scene takes as long as simulating a scan.
        all_around: True to let the camera of the validation frames, which limits the labels, point
            ahead, left, behind and right in turn. If False, it always points ahead.
    """

    first_seed: int
    count: int
    sensor: Sensor = HDL64E
    scenes: Scenes = ALL_STREETS
    cache: Path | None = None
    cache_gb: float = 20.0
    scans_per_scene: int = 1
    all_around: bool = False

    def __len__(self) -> int:
        return self.count

    def locate(self, i: int) -> tuple[int, int]:
        """Return the seed of the scene of scan i, and the number of the scan in its drive."""
        scene, scan = divmod(i, self.scans_per_scene)
        return self.first_seed + scene, scan * count_drive_scans(self.sensor) // self.scans_per_scene

    def cache_key(self, i: int) -> str:
        """Return the cache key of scan i."""
        return repr((self.sensor, tuple(self.scenes), self.locate(i)))

    def cache_file(self, i: int) -> Path | None:
        """Return the cache file of scan i."""
        return make_cache_path(self.cache, self.cache_key(i))

    def load_scene(self, i: int) -> TrainingScene:
        """Load scan i for training, with labels in all directions."""
        frame, truth = self.load_scan(i)
        return TrainingScene(
            frame.points(), truth.boxes, truth.class_ids, find_labelled(truth), True, self.sensor.height
        )

    def load_frame(self, i: int) -> Frame:
        """Load scan i for validation. With a camera, only objects in its image are labelled, as in KITTI."""
        scan, truth = self.load_scan(i)
        seed, number = self.locate(i)
        if not self.scenes.camera:
            return Frame.of(
                f"scene {seed} frame {number}", scan, select_labels(truth), sensor_height=self.sensor.height
            )
        camera = rotate_camera(np.pi / 2 * (i % 4)) if self.all_around else FORWARD_CAMERA
        return Frame.of(
            f"street {seed} frame {number}",
            scan,
            make_kitti_labels(truth, camera),
            camera,
            sensor_height=self.sensor.height,
        )

    def load_scan(self, i: int) -> tuple[PointCloud, GroundTruth]:
        """Load scan i with all its objects from the cache, or simulate it."""
        return load_or_compute(self.cache_file(i), lambda: self._simulate(i), _from_arrays, _to_arrays, self.cache_gb)

    def _simulate(self, i: int) -> tuple[PointCloud, GroundTruth]:
        scan = simulate_scan(*self.locate(i), self.sensor, self.scenes)
        return scan.frame, scan.truth


def _to_arrays(scan: tuple[PointCloud, GroundTruth]) -> dict[str, np.ndarray]:
    frame, truth = scan
    assert frame.intensity is not None  # simulated scans always have intensity
    extras = {name: np.array([e[name] for e in truth.extras]) for name in EXTRAS}
    return dict(xyz=frame.xyz, intensity=frame.intensity, boxes=truth.boxes, class_ids=truth.class_ids, **extras)


def _from_arrays(arrays: Any) -> tuple[PointCloud, GroundTruth]:
    columns = [arrays[name].tolist() for name in EXTRAS]
    extras = [dict(zip(EXTRAS, row)) for row in zip(*columns)]
    return (
        PointCloud(arrays["xyz"], arrays["intensity"]),
        GroundTruth.of(arrays["boxes"], arrays["class_ids"], extras),
    )
