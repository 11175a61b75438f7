"""Results of single frames: records of a detector for a journal, and from them FrameResults."""

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
from lidar_perception.scoring.run import Start
from lidar_perception.tracking.drive_tracker import DriveTracker
from lidar_perception.tracking.state import Tracks
from lidar_perception.tracking.trails import Trails
from lidar_perception.types import CLASSES, Detections, InputError, class_ids

TRAIL_S = 2.0  # seconds of the way of a track that are kept, as in the nodes


@dataclass(frozen=True)
class FrameResult:
    """The result of one frame.

    detections: what reached its threshold. frame_id: of the cloud. ms: of the detector. problem: of
    the detector, None where there was none. Where tracks were wanted: tracks; drive, the name of
    theirs; trails, the recent positions (N, 3) of each, oldest first; tracking_problem.
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
        """The tracks, or without tracks the detections; in the LiDAR frame."""
        return self.detections if self.tracks is None else self.tracks.detections


def by_detector(open_: Callable[[], Detector]) -> Start:
    """Run the detector of open_() on every frame, and give its record for a journal: a JSON object
    from which detections_in() makes the same numbers."""
    return partial(_by_detector, open_)


def _by_detector(open_: Callable[[], Detector], recording: Recording) -> Callable[[Frame], str]:
    detector = open_()

    def measure(frame: Frame) -> str:
        scan = frame.load()
        begin = perf_counter()
        found = detector(scan)
        ms = (perf_counter() - begin) * 1e3
        objects = found.detections
        if not (np.isfinite(objects.boxes).all() and np.isfinite(objects.scores).all()):
            raise InputError(f"{frame.name}: the detector gave numbers that are not finite; see "
                             "whether its weights are broken")
        return json.dumps({
            "frame": frame.name, "frame_id": scan.frame_id, "ms": round(ms, 3),
            "problem": found.problem, "classes": [CLASSES[i] for i in objects.class_ids],
            "boxes": short_floats(objects.boxes), "scores": short_floats(objects.scores),
            "sources": {name: short_floats(said) for name, said in objects.sources.items()}})
    return measure


def detections_in(record: Mapping[str, Any]) -> Detections:
    """The detections of a record, exactly as they were found."""
    found = Detections.of(record["boxes"], class_ids(record["classes"]), record["scores"])
    return replace(found, sources={name: np.array(said, np.float32)
                                   for name, said in record["sources"].items()})


def short_floats(values: np.ndarray) -> Any:
    """Numbers as nested lists with the fewest digits from which float32 has the same numbers; None
    for NaN."""
    values = np.asarray(values, np.float32)
    if values.ndim > 1:
        return [short_floats(row) for row in values]
    return [None if np.isnan(value) else float(str(value)) for value in values]


def with_optional_parts(frame: Frame, say: Callable[[str], None]) -> Frame:
    """Return the frame with labels, calibration and pose None where they cannot be read; then
    say(line) is called with the reason. The scan is read once."""
    def or_none(read: Callable[[], Any], what: str) -> Callable[[], Any]:
        def read_or_none() -> Any:
            try:
                return read()
            except InputError as error:
                say(f"{what} left out: {error}")
                return None
        return cache(read_or_none)
    return replace(frame.with_cached_scan(), truth=or_none(frame.truth, "labels"),
                   calibration=or_none(frame.calibration, "camera calibration"),
                   pose=or_none(frame.pose, "pose"))


def by_record(record_of: Callable[[str], Mapping[str, Any]], min_scores: Mapping[str, float],
              tracker: Callable[[Recording], DriveTracker] | None,
              say: Callable[[str], None], scans: bool = False) -> Start:
    """Make the FrameResult of every frame from its record, record_of(name). Frames must be measured
    in order of time, in one process.

    Args:
        min_scores: the threshold of each class.
        tracker: tracker(recording) tracks all detections, weak ones too; None: no tracks.
        say: see with_optional_parts.
        scans: read the scans too; a frame whose scan cannot be read is skipped.
    """
    return partial(_by_record, record_of, min_scores, tracker, say, scans)


def _by_record(record_of: Callable[[str], Mapping[str, Any]], min_scores: Mapping[str, float],
               tracker_of: Callable[[Recording], DriveTracker] | None,
               say: Callable[[str], None], scans: bool,
               recording: Recording) -> Callable[[Frame], FrameResult]:
    least = np.array([min_scores.get(name, 0.0) for name in CLASSES], np.float32)
    tracker = None if tracker_of is None else tracker_of(recording)
    trails = Trails()

    def measure(frame: Frame) -> FrameResult:
        record = record_of(frame.name)
        if (reason := record.get("skipped")) is not None:
            raise InputError(reason)
        frame, found = with_optional_parts(frame, say), detections_in(record)
        if scans:
            frame.load()
        result = FrameResult(frame, found[found.scores >= least[found.class_ids]],
                             record["frame_id"], record["ms"], record["problem"])
        if tracker is None:
            return result
        tracks, inner = tracker(frame, found), tracker.tracker
        return replace(result, tracks=tracks, drive=tracker.drive,
                       trails=tuple(trails(tracks, inner.pose, frame.stamp_ns, TRAIL_S)),
                       tracking_problem=inner.problem)
    return measure
