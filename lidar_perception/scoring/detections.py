"""Detections of frames, from a detector or from result files, for all scoring protocols."""

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
        name: Name of the frame.
        truth: Labels, or None.
        detections: Output of a detector, or labels with a score in extras (result files).
        calibration: Camera calibration, None without a camera.
        ms: Run time of the detector, None for result files.
        problem: Reason why the detector rejected the frame, or None. All objects of a rejected
            frame count as misses.
    """

    name: str
    truth: GroundTruth | None
    detections: BoxesT
    calibration: Calibration | None = None
    ms: float | None = None
    problem: str | None = None


def thin_scan(cloud: PointCloud, fraction: float, name: str) -> PointCloud:
    """Return a random fraction (0..1) of a frame's points to emulate a sparser sensor (paper C).

    The choice depends only on the frame's name. A smaller fraction is a subset of a larger one.
    """
    if fraction >= 1.0:
        return cloud
    return cloud.take(np.flatnonzero(draw_subset(len(cloud), fraction, name)))


def draw_subset(count: int, fraction: float, name: str) -> np.ndarray:
    """Return a random mask (count,) bool that is True for this fraction, seeded by `name`."""
    return np.random.default_rng(zlib.crc32(name.encode())).random(count) < fraction


def run_detector(
    detector: Detector, frame: Frame, truth: GroundTruth | None, calibration: Calibration | None, fraction: float = 1.0
) -> FrameDetections[Detections]:
    """Run a detector on a random fraction of the points of a frame.

    Raises:
        InputError: The scan cannot be read.
    """
    scan = thin_scan(frame.load(), fraction, frame.name)
    start = perf_counter()
    try:
        result = detector(scan)
    except RunError:
        raise
    except InputError as error:
        return FrameDetections(frame.name, truth, Detections.none(), calibration, problem=str(error))
    return FrameDetections(frame.name, truth, result.detections, calibration, (perf_counter() - start) * 1e3)


def measure_detector(
    open_detector: Callable[[], Detector], fraction: float, folder: Path | None, recording: Recording
) -> Callable[[Frame], FrameDetections[Detections] | None]:
    """Make a function that runs a detector on each labelled frame.

    partial(measure_detector, open_detector, fraction, folder) is a StartMeasurement of scoring.run.

    Args:
        open_detector: Function that loads the detector.
        fraction: Fraction of the points to pass to the detector, 0..1.
        folder: Folder for KITTI result files, or None. With a folder, frames without labels are
            processed too.
    """
    detector = open_detector()

    def measure(frame: Frame) -> FrameDetections[Detections] | None:
        truth, calibration = frame.truth(), frame.calibration()
        if truth is None and folder is None:
            return None
        result = run_detector(detector, frame, truth, calibration, fraction)
        if folder is not None:
            try:
                write_results(folder / f"{frame.name}.txt", result.detections, choose_calibration(frame)[0])
            except InputError as error:  # disk errors, or values that are not finite
                raise RunError(str(error)) from None
        return result

    return measure


def measure_result_files(folder: Path, recording: Recording) -> Callable[[Frame], FrameDetections[GroundTruth] | None]:
    """Make a function that reads the KITTI result file folder/NAME.txt of each labelled frame.

    `folder` may be the output of `detect`. Frames that `detect` skipped are skipped here too.
    partial(measure_result_files, folder) is a StartMeasurement of scoring.run.
    """
    result_folder = find_result_folder(folder)
    skipped = journal.read_skipped_frames(result_folder.parent)

    def measure(frame: Frame) -> FrameDetections[GroundTruth] | None:
        truth, calibration = frame.truth(), frame.calibration()
        if truth is None:
            return None
        if frame.name in skipped:
            raise InputError(skipped[frame.name])
        try:
            detections = read_results(result_folder / f"{frame.name}.txt", choose_calibration(frame)[0].lidar_to_camera)
        except InputError as error:
            raise RunError(str(error)) from None
        return FrameDetections(frame.name, truth, detections, calibration)

    return measure
