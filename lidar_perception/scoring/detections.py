"""Detections of a frame, from a detector or from result files, for any scoring protocol."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Generic, TypeVar

import numpy as np

from lidar_perception.camera import Calibration
from lidar_perception.data.frame import Frame, Recording
from lidar_perception.data.kitti.results import choose_calibration, find_result_folder, read_results, write_results
from lidar_perception.detectors.contract import Detector
from lidar_perception.runs import journal
from lidar_perception.types import Detections, GroundTruth, InputError, PointCloud, RunError

BoxesT = TypeVar("BoxesT", bound=Detections | GroundTruth)


@dataclass(frozen=True)
class FrameDetections(Generic[BoxesT]):
    """Detections and labels of one frame.

    Attributes:
        name: name of the frame.
        truth: labels, or None.
        detections: of a detector, or labels with a score in extras (result files).
        calibration: None without a camera.
        ms: duration of the detector, None for result files.
        problem: why the detector rejected the frame, whose objects then count as missed, or None.
    """

    name: str
    truth: GroundTruth | None
    detections: BoxesT
    calibration: Calibration | None = None
    ms: float | None = None
    problem: str | None = None


def thin_scan(frame: PointCloud, share: float, name: str) -> PointCloud:
    """Return a random share (0..1) of the points of a frame, as of a sparser sensor (paper C).

    The choice depends on the name of the frame only. A smaller share is a subset of a larger one.
    """
    if share >= 1.0:
        return frame
    return frame.take(np.flatnonzero(draw_subset(len(frame), share, name)))


def draw_subset(count: int, share: float, name: str) -> np.ndarray:
    """Return a mask (count,) bool of a random share of the points, seeded by name."""
    return np.random.default_rng(zlib.crc32(name.encode())).random(count) < share


def run_detector(
    detector: Detector, frame: Frame, truth: GroundTruth | None, calibration: Calibration | None, keep: float = 1.0
) -> FrameDetections[Detections]:
    """Run a detector on a share `keep` of the points of a frame.

    Raises InputError if the scan cannot be read.
    """
    scan = thin_scan(frame.load(), keep, frame.name)
    begin = perf_counter()
    try:
        found = detector(scan)
    except RunError:
        raise
    except InputError as error:
        return FrameDetections(frame.name, truth, Detections.none(), calibration, problem=str(error))
    return FrameDetections(frame.name, truth, found.detections, calibration, (perf_counter() - begin) * 1e3)


def measure_detector(
    open_: Callable[[], Detector], keep: float, folder: Path | None, recording: Recording
) -> Callable[[Frame], FrameDetections[Detections] | None]:
    """Make a function that runs the detector of open_() on each labelled frame.

    partial(measure_detector, open_, keep, folder) is a Start of scoring.run.

    Args:
        keep: share of the points that the detector gets, 0..1.
        folder: also run on frames without labels, and write KITTI result files there.
    """
    detector = open_()

    def measure(frame: Frame) -> FrameDetections[Detections] | None:
        truth, calibration = frame.truth(), frame.calibration()
        if truth is None and folder is None:
            return None
        result = run_detector(detector, frame, truth, calibration, keep)
        if folder is not None:
            try:
                write_results(folder / f"{frame.name}.txt", result.detections, choose_calibration(frame)[0])
            except InputError as error:  # disk errors, or values that are not finite
                raise RunError(str(error)) from None
        return result

    return measure


def measure_result_files(folder: Path, recording: Recording) -> Callable[[Frame], FrameDetections[GroundTruth] | None]:
    """Make a function that reads the KITTI result file folder/NAME.txt of each labelled frame.

    folder may be a run of `detect`; frames that the run skipped are skipped.
    partial(measure_result_files, folder) is a Start of scoring.run.
    """
    files = find_result_folder(folder)
    skipped = journal.read_skipped_frames(files.parent)

    def measure(frame: Frame) -> FrameDetections[GroundTruth] | None:
        truth, calibration = frame.truth(), frame.calibration()
        if truth is None:
            return None
        if frame.name in skipped:
            raise InputError(skipped[frame.name])
        try:
            found = read_results(files / f"{frame.name}.txt", choose_calibration(frame)[0].lidar_to_camera)
        except InputError as error:
            raise RunError(str(error)) from None
        return FrameDetections(frame.name, truth, found, calibration)

    return measure
