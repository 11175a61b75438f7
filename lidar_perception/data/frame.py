"""One labelled frame: what every data set, bag and simulated drive gives, and all that loops know.

Nothing is read before it is asked for, so a list of a whole data set costs its file names.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from lidar_perception.camera import Calibration, Camera
from lidar_perception.types import SENSOR_HEIGHT, GroundTruth, InputError, LidarFrame


@dataclass(frozen=True)
class PointTruth:
    """Labels of the N points of a frame: classes (N,) uint16 as in SemanticKITTI (0 = unlabelled),
    instances (N,) uint16 (0 = none)."""

    classes: np.ndarray
    instances: np.ndarray


def nothing() -> None:
    """Return None for data that the recording does not contain."""


def fixed_scale() -> float:
    """Return 0, for clouds whose format fixes the scale of the intensity."""
    return 0.0


@dataclass(frozen=True, eq=False)
class Frame:
    """One scan of a recording. Each function reads its file when it is called, and raises
    InputError naming the file where it is missing or broken.

    name: unlike that of any other frame of the recording. load() gives the usable points.
    truth(): labelled objects in the LiDAR frame; point_truth(): labels of the points of load();
    calibration(): of the camera; pose(): (4, 4) float64 from the frame to a fixed one, metres;
    each None where there is none. sequence: the drive it belongs to, "" without drives; index: its
    number there. sensor_height: metres above the ground. points, image: files, where there are
    any. files: those that its points, labels and calibration are read from, there or not; () where
    nobody can know what was labelled. native: what the protocol of this data set alone asks for.
    """

    name: str
    stamp_ns: int
    load: Callable[[], LidarFrame]
    truth: Callable[[], GroundTruth | None] = nothing
    point_truth: Callable[[], PointTruth | None] = nothing
    calibration: Callable[[], Calibration | None] = nothing
    pose: Callable[[], np.ndarray | None] = nothing
    sequence: str = ""
    index: int = 0
    sensor_height: float = SENSOR_HEIGHT
    points: Path | None = None
    image: Path | None = None
    files: tuple[Path, ...] = ()
    native: Any = None
    intensity_max: Callable[[], float] = fixed_scale

    def camera(self) -> Camera | None:
        """The camera that sees the frame; None without a calibration."""
        calibration = self.calibration()
        return None if calibration is None else calibration.camera()

    def loaded_once(self) -> Frame:
        """The same frame, whose scan is read once and kept as long as the frame is."""
        return replace(self, load=cache(self.load))

    @staticmethod
    def of(name: str, scan: LidarFrame, truth: GroundTruth | None = None,
           calibration: Calibration | None = None, **more: Any) -> Frame:
        """A frame of what is in memory already."""
        return Frame(name, scan.stamp_ns, partial(_given, scan), partial(_given, truth),
                     calibration=partial(_given, calibration), **more)


def frame_id_of(frames: Sequence[Frame]) -> str:
    """The coordinate frame of their clouds, as the first one names it; "" where there is none, or
    it cannot be read, which is said when it is asked for."""
    with suppress(InputError):
        return frames[0].load().frame_id if frames else ""
    return ""


def _given(value: Any) -> Any:
    return value


BOXES, POINT_LABELS, CAMERA, POSES = "labelled boxes", "labelled points", "a camera", "poses"


@dataclass(frozen=True, eq=False)
class Recording:
    """The frames of a data set or a bag, in order of time within a drive.

    layout: what was recognised, for people. has: which of BOXES, POINT_LABELS, CAMERA and POSES
    some frames have. lost: labels whose scan is not there, name -> reason. reopen: opens the same
    recording again, in another process, too; takes what data.open.open_recording does. mounted:
    whether it says how high its sensor is; otherwise the sensor_height of its frames is KITTI's.
    drives: whether frames follow each other in time; else they were drawn from anywhere. timed:
    whether the stamps were recorded; else 10 Hz is assumed.
    """

    path: Path
    layout: str
    frames: Sequence[Frame]
    has: frozenset[str] = frozenset()
    lost: tuple[tuple[str, str], ...] = ()
    reopen: Callable[..., Recording] | None = None
    mounted: bool = True
    drives: bool = True
    timed: bool = False

    def __len__(self) -> int:
        return len(self.frames)

    def __iter__(self) -> Iterator[Frame]:
        return iter(self.frames)

    def __str__(self) -> str:
        """One line for people."""
        count = f"{len(self)} frame{'' if len(self) == 1 else 's'}"
        return ", ".join((f"{self.path}: {self.layout}", count, *sorted(self.has)))

    def require(self, what: str, verb: str) -> None:
        """InputError naming the verb if no frame can have what it needs, of BOXES and so on."""
        if what not in self.has:
            raise InputError(f"{self.path} ({self.layout}) has no {what.removeprefix('a ')}, which "
                             f"{verb} needs")

    def chosen(self, names: Sequence[str]) -> Recording:
        """The frames of these names, in their order. InputError names what is not there."""
        numbers = {frame.name: i for i, frame in enumerate(self.frames)}
        if unknown := [name for name in names if name not in numbers]:
            raise InputError(f"{self.path} has no frame {unknown[0]} ({len(unknown)} such); its "
                             f"first is {next(iter(numbers), 'none')}")
        return replace(self, frames=[self.frames[numbers[name]] for name in names], lost=())
