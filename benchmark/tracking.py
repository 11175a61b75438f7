"""Comparison of our tracker with a plain AB3DMOT, on the same detections and poses."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from time import perf_counter

import numpy as np
from rich.table import Table

from benchmark.plain_ab3dmot import PlainAb3dmot
from lidar_perception.camera import Calibration
from lidar_perception.data.frame import Recording
from lidar_perception.detectors.open import open_detector
from lidar_perception.detectors.params import MIN_SCORE, ScoreParams
from lidar_perception.runs.terminal import console, show_progress
from lidar_perception.scoring.tracking.pairs import to_tracked_labels
from lidar_perception.scoring.tracking.report import TrackingReport, make_observation
from lidar_perception.tracking.drive_tracker import choose_ego_source
from lidar_perception.tracking.ego import make_pose_reader
from lidar_perception.tracking.params import TrackingParams
from lidar_perception.tracking.tracker import Tracker
from lidar_perception.types import Detections, GroundTruth

PEER_MIN_SCORE = ScoreParams().car  # minimum score of the detections for the peer, which ignores scores
SHOWN_METRICS = (
    "HOTA",
    "DetA",
    "AssA",
    "MOTA",
    "sAMOTA",
    "AMOTA",
    "switches",
    "fragments",
    "labels",
    "true_tracks",
    "tracks",
)
Step = Callable[["TrackedFrame"], tuple[np.ndarray, Detections]]


@dataclass(frozen=True)
class TrackedFrame:
    """A frame with detections, including those with low scores, and labels with track ids."""

    detections: Detections
    truth: GroundTruth
    stamp_ns: int = 0
    pose: np.ndarray | None = None
    calibration: Calibration | None = None


def measure_recording(recording: Recording) -> dict:
    """Track PointPillars' detections in a recording with both trackers. Return {} if there are no track ids."""
    if not recording.frames or not recording.frames[0].sequence:
        return {}
    detector = open_detector("pointpillars", min_score=MIN_SCORE, sensor_height=recording.frames[0].sensor_height)
    drives: dict[str, list[TrackedFrame]] = {}
    source = choose_ego_source(recording)
    for frame in show_progress(recording, "detecting", len(recording)):
        truth, frame = frame.truth(), frame.with_cached_scan()
        if truth is not None and all("track_id" in extra for extra in truth.extras):
            if frame.sequence not in drives:
                read_pose = make_pose_reader(source)
            drives.setdefault(frame.sequence, []).append(
                TrackedFrame(
                    detector(frame.load()).detections, truth, frame.stamp_ns, read_pose(frame), frame.calibration()
                )
            )
    return measure_tracking(drives) if drives else {}


def measure_tracking(drives: Mapping[str, Sequence[TrackedFrame]], params: TrackingParams = TrackingParams()) -> dict:
    """Measure both trackers, "ours" and "plain AB3DMOT".

    Returns:
        For each tracker the scores of TrackingReport, and `ms`, the median time per frame.
    """
    return {
        name: _measure(drives, make_step)
        for name, make_step in (
            ("plain AB3DMOT", lambda: make_peer_step(PlainAb3dmot())),
            ("ours", lambda: make_tracker_step(params)),
        )
    }


def make_peer_step(plain: PlainAb3dmot, min_score: float = PEER_MIN_SCORE) -> Step:
    """Return a function that tracks one drive with the peer, which gets detections of at least min_score."""
    return lambda frame: plain(frame.detections[frame.detections.scores >= min_score], frame.pose)


def make_tracker_step(params: TrackingParams) -> Step:
    """Return a function that tracks one drive with our tracker."""
    our_tracker = Tracker(params)

    def step(frame: TrackedFrame) -> tuple[np.ndarray, Detections]:
        tracks = our_tracker(frame.detections, frame.stamp_ns, frame.pose)
        return tracks.ids, tracks.detections

    return step


def _measure(drives: Mapping[str, Sequence[TrackedFrame]], make_step: Callable[[], Step]) -> dict:
    report, ms = TrackingReport(), []
    for name, frames in drives.items():
        step = make_step()
        for i, frame in enumerate(frames):
            start = perf_counter()
            ids, detections = step(frame)
            ms.append((perf_counter() - start) * 1e3)
            report.update(make_observation(name, i, frame.truth, to_tracked_labels(ids, detections), frame.calibration))
    return {**report.compute(), "ms": float(np.median(ms)) if ms else None}


def print_tracking(content: dict) -> None:
    """Print a row per class and tracker."""
    table = Table(title="Tracks matched by centre distance d, similarity 1 - d / 2 m")
    for name in ("class", "tracker", *SHOWN_METRICS):
        table.add_column(name, justify="left" if name in ("class", "tracker") else "right")
    for class_name in next(iter(content.values()))["classes"]:
        table.add_section()
        for tracker, scores in content.items():
            class_scores = scores["classes"][class_name]
            if class_scores is not None:
                table.add_row(
                    class_name,
                    tracker,
                    *(
                        str(class_scores[name])
                        if isinstance(class_scores[name], int)
                        else f"{100 * class_scores[name]:.1f}"
                        for name in SHOWN_METRICS
                    ),
                )
    console.print(table)
