"""Frames and recordings, the common interface of all data sets, bags and simulated drives.

Files are read only when their content is used.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, overload

import numpy as np

from lidar_perception.camera import Calibration, Camera
from lidar_perception.types import SENSOR_HEIGHT, GroundTruth, InputError, PointCloud


@dataclass(frozen=True)
class PointTruth:
    """Labels of the N points of a frame.

    Attributes:
        classes: (N,) uint16 class of each point, numbered as in SemanticKITTI; 0 = unlabelled.
        instances: (N,) uint16 instance of each point; 0 = none.
    """

    classes: np.ndarray
    instances: np.ndarray


def return_none() -> None:
    """Return None, for data that a recording does not contain."""


def return_zero() -> float:
    """Return 0, for formats that fix the scale of the intensity."""
    return 0.0


@dataclass(frozen=True, eq=False)
class Frame:
    """One scan of a recording.

    Its functions read files, and raise InputError if a file is missing or malformed.

    Attributes:
        name: name of the frame, unique within the recording.
        load: returns the usable points.
        truth: returns the labelled objects in the LiDAR frame, or None.
        point_truth: returns the labels of the points of load(), or None.
        calibration: returns the calibration of the camera, or None.
        pose: returns the pose (4, 4) float64 of the LiDAR in a fixed frame, metres, or None.
        sequence: name of the drive; "" if the recording has no drives.
        index: number of the frame in its drive.
        sensor_height: height of the sensor above the ground in metres.
        points, image: files of the scan and the camera image, or None.
        files: all files with points, labels and calibration, existing or not; () if unknown.
        native: data for the evaluation protocol of this data set.
        intensity_max: returns the intensity of a full reflection; 0 if it is fixed by the format.
    """

    name: str
    stamp_ns: int
    load: Callable[[], PointCloud]
    truth: Callable[[], GroundTruth | None] = return_none
    point_truth: Callable[[], PointTruth | None] = return_none
    calibration: Callable[[], Calibration | None] = return_none
    pose: Callable[[], np.ndarray | None] = return_none
    sequence: str = ""
    index: int = 0
    sensor_height: float = SENSOR_HEIGHT
    points: Path | None = None
    image: Path | None = None
    files: tuple[Path, ...] = ()
    native: Any = None
    intensity_max: Callable[[], float] = return_zero

    def camera(self) -> Camera | None:
        """Return the camera of the frame; None without a calibration."""
        calibration = self.calibration()
        return None if calibration is None else calibration.camera()

    def with_cached_scan(self) -> Frame:
        """Return a copy of the frame that reads its scan once and then caches it."""
        return replace(self, load=cache(self.load))

    @staticmethod
    def of(
        name: str,
        scan: PointCloud,
        truth: GroundTruth | None = None,
        calibration: Calibration | None = None,
        **attributes: Any,
    ) -> Frame:
        """Make a frame from data in memory."""
        return Frame(
            name,
            scan.stamp_ns,
            partial(_identity, scan),
            partial(_identity, truth),
            calibration=partial(_identity, calibration),
            **attributes,
        )


def read_frame_id(frames: Sequence[Frame]) -> str:
    """Return the coordinate frame of the first cloud; "" if it cannot be read or is missing."""
    with suppress(InputError):
        return frames[0].load().frame_id if frames else ""
    return ""


def _identity(value: Any) -> Any:
    return value


MAX_GAP_S = 2.0  # maximum time between two frames of a drive
BOXES, POINT_LABELS, CAMERA, POSES = "labelled boxes", "labelled points", "a camera", "poses"


class ComputedFrames(Sequence[Frame]):
    """Frames that are computed when they are read, such as simulated ones."""

    @abstractmethod
    def compute_frame(self, number: int) -> Frame:
        """Return frame `number` (0 <= number < len(self))."""

    @overload
    def __getitem__(self, index: int) -> Frame: ...

    @overload
    def __getitem__(self, index: slice) -> list[Frame]: ...

    def __getitem__(self, index: int | slice) -> Frame | list[Frame]:
        numbers = range(len(self))[index]
        if isinstance(numbers, range):
            return [self.compute_frame(number) for number in numbers]
        return self.compute_frame(numbers)


@dataclass(frozen=True, eq=False)
class Recording:
    """The frames of a data set or bag, in order of time within a drive.

    Attributes:
        layout: description of the recognised layout.
        frames: all frames.
        contents: BOXES, POINT_LABELS, CAMERA and POSES, each if at least some frames have it.
        missing_scans: (name, reason) of each label without a scan.
        reopen: opens the recording again, also in another process; it takes the arguments of
            data.open.open_recording.
        has_sensor_height: True if the recording states the sensor height; otherwise KITTI's height
            is assumed.
        is_sequential: True if the frames follow each other in time, False if they are unrelated.
        has_times: True if the stamps were recorded; otherwise 10 Hz is assumed.
    """

    path: Path
    layout: str
    frames: Sequence[Frame]
    contents: frozenset[str] = frozenset()
    missing_scans: tuple[tuple[str, str], ...] = ()
    reopen: Callable[..., Recording] | None = None
    has_sensor_height: bool = True
    is_sequential: bool = True
    has_times: bool = False

    def __len__(self) -> int:
        return len(self.frames)

    def __iter__(self) -> Iterator[Frame]:
        return iter(self.frames)

    def __str__(self) -> str:
        """Return a one-line description."""
        count = f"{len(self)} frame{'' if len(self) == 1 else 's'}"
        return ", ".join((f"{self.path}: {self.layout}", count, *sorted(self.contents)))

    def require(self, content: str, command: str) -> None:
        """Raise InputError if no frame has the content, such as BOXES, that a command needs."""
        if content not in self.contents:
            raise InputError(f"{self.path} ({self.layout}) has no {content.removeprefix('a ')}, which {command} needs")

    def select(self, names: Sequence[str]) -> Recording:
        """Return a recording of the frames with these names, in this order.

        Raises InputError if a name is unknown.
        """
        numbers = {frame.name: i for i, frame in enumerate(self.frames)}
        if unknown_names := [name for name in names if name not in numbers]:
            raise InputError(
                f"{self.path} has no frame {unknown_names[0]} ({len(unknown_names)} unknown names in all); names there "
                f"look like {next(iter(numbers), 'none')}"
            )
        return replace(self, frames=[self.frames[numbers[name]] for name in names], missing_scans=())


def is_same_drive(previous_ns: int, stamp_ns: int) -> bool:
    """Return True if a frame belongs to the same drive as the previous one, given their stamps."""
    return 0 <= stamp_ns - previous_ns <= MAX_GAP_S * 1e9


def split_drives(frames: Sequence[Frame]) -> dict[str, list[list[int]]]:
    """Return the frame numbers of each drive, by sequence.

    A new drive starts after a gap of more than MAX_GAP_S, and where stamps go back.
    """
    drives: dict[str, list[list[int]]] = {}
    for number, frame in enumerate(frames):
        parts = drives.setdefault(frame.sequence, [])
        if not parts or not is_same_drive(frames[parts[-1][-1]].stamp_ns, frame.stamp_ns):
            parts.append([])
        parts[-1].append(number)
    return drives
