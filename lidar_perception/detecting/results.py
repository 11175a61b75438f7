"""Results of single frames: JSON records for a journal, and FrameResults made from these records."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache, partial
from time import perf_counter
from typing import Any

import numpy as np

from lidar_perception.data.frame import Frame, Recording
from lidar_perception.detectors.contract import Detector
from lidar_perception.tracking.drive_tracker import DriveTracker
from lidar_perception.tracking.state import Tracks
from lidar_perception.tracking.trails import Trails
from lidar_perception.types import CLASSES, Detections, InputError, find_class_ids

TRAIL_S = 2.0  # duration of the trail of a track, as in the nodes


@dataclass(frozen=True)
class FrameResult:
    """The result of one frame.

    Attributes:
        frame: frame of the recording.
        detections: detections that reach the threshold of their class.
        frame_id: coordinate frame of the cloud.
        ms: duration of detection in milliseconds.
        problem: problem reported by the detector, or None.
        tracks: tracks, or None without tracking.
        drive: name of the drive that the tracks belong to.
        trails: recent positions (N, 3) of each track, oldest first.
        tracking_problem: problem reported by the tracker, or None.
    """

    frame: Frame
    detections: Detections
    frame_id: str
    ms: float
    problem: str | None = None
    tracks: Tracks | None = None
    drive: str = ""
    trails: tuple[np.ndarray, ...] = ()
    tracking_problem: str | None = None

    @property
    def objects(self) -> Detections:
        """Tracks, or detections without tracking, in the LiDAR frame."""
        return self.detections if self.tracks is None else self.tracks.detections


def start_detection(open_detector: Callable[[], Detector], recording: Recording) -> Callable[[Frame], str]:
    """Return a function that runs the detector on a frame and returns the record as a JSON string.

    partial(start_detection, open_detector) is a StartMeasurement of scoring.run.

    Args:
        open_detector: opens the detector.
    """
    detector = open_detector()

    def measure(frame: Frame) -> str:
        scan = frame.load()
        begin = perf_counter()
        result = detector(scan)
        ms = (perf_counter() - begin) * 1e3
        detections = result.detections
        if not (np.isfinite(detections.boxes).all() and np.isfinite(detections.scores).all()):
            raise InputError(f"{frame.name}: the detector returned values that are not finite; check its weights")
        return json.dumps(
            {
                "frame": frame.name,
                "frame_id": scan.frame_id,
                "ms": round(ms, 3),
                "problem": result.problem,
                "classes": [CLASSES[i] for i in detections.class_ids],
                "boxes": to_short_floats(detections.boxes),
                "scores": to_short_floats(detections.scores),
                "sources": {name: to_short_floats(p) for name, p in detections.sources.items()},
            }
        )

    return measure


def read_detections(record: Mapping[str, Any]) -> Detections:
    """Read the detections of a record; the float32 values are restored exactly."""
    detections = Detections.of(record["boxes"], find_class_ids(record["classes"]), record["scores"])
    return replace(
        detections,
        sources={name: np.array(probabilities, np.float32) for name, probabilities in record["sources"].items()},
    )


def to_short_floats(values: np.ndarray) -> Any:
    """Convert an array to nested lists of numbers with the fewest digits that restore the same float32.

    NaN becomes None.
    """
    values = np.asarray(values, np.float32)
    if values.ndim > 1:
        return [to_short_floats(row) for row in values]
    return [None if np.isnan(value) else float(str(value)) for value in values]


def with_optional_parts(frame: Frame, report: Callable[[str], None]) -> Frame:
    """Return a frame whose labels, calibration and pose are None if they cannot be read.

    The scan is read only once.

    Args:
        report: called with the reason for each part that cannot be read.
    """

    def read_or_none(read: Callable[[], Any], name: str) -> Any:
        try:
            return read()
        except InputError as error:
            report(f"{name} left out: {error}")
            return None

    return replace(
        frame.with_cached_scan(),
        truth=cache(partial(read_or_none, frame.truth, "labels")),
        calibration=cache(partial(read_or_none, frame.calibration, "camera calibration")),
        pose=cache(partial(read_or_none, frame.pose, "pose")),
    )


def start_results(
    read_record: Callable[[str], Mapping[str, Any]],
    min_scores: Mapping[str, float],
    make_tracker: Callable[[Recording], DriveTracker] | None,
    report: Callable[[str], None],
    needs_scans: bool,
    recording: Recording,
) -> Callable[[Frame], FrameResult]:
    """Return a function that makes the FrameResult of a frame from its record.

    Frames must be processed in chronological order, in one process. A partial() with all arguments
    except the last one is a StartMeasurement of scoring.run.

    Args:
        read_record: returns the record of a frame by its name.
        min_scores: threshold of each class.
        make_tracker: returns a tracker for a recording, which also uses detections below the
            thresholds; None: no tracks.
        report: see with_optional_parts.
        needs_scans: True to also read the scans and skip frames whose scan cannot be read.
        recording: recording that contains the frames.
    """
    thresholds = np.array([min_scores.get(name, 0.0) for name in CLASSES], np.float32)
    tracker = None if make_tracker is None else make_tracker(recording)
    trails = Trails()

    def measure(frame: Frame) -> FrameResult:
        record = read_record(frame.name)
        if (reason := record.get("skipped")) is not None:
            raise InputError(reason)
        frame, detections = with_optional_parts(frame, report), read_detections(record)
        if needs_scans:
            frame.load()
        result = FrameResult(
            frame,
            detections[detections.scores >= thresholds[detections.class_ids]],
            record["frame_id"],
            record["ms"],
            record["problem"],
        )
        if tracker is None:
            return result
        tracks, inner_tracker = tracker(frame, detections), tracker.tracker
        return replace(
            result,
            tracks=tracks,
            drive=tracker.drive,
            trails=tuple(trails(tracks, inner_tracker.pose, frame.stamp_ns, TRAIL_S)),
            tracking_problem=inner_tracker.problem,
        )

    return measure
