"""Our tracker against a plain AB3DMOT, on the same detections and poses."""

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
from lidar_perception.scoring.tracking.report import TrackingReport, observe
from lidar_perception.tracking.drive_tracker import choose_ego_source
from lidar_perception.tracking.ego import make_pose_reader
from lidar_perception.tracking.params import TrackingParams
from lidar_perception.tracking.tracker import Tracker
from lidar_perception.types import Detections, GroundTruth

OPERATING = ScoreParams().car  # minimum score of the peer's input, because the peer ignores scores
SHOWN = ("HOTA", "DetA", "AssA", "MOTA", "sAMOTA", "AMOTA", "switches", "fragments", "labels", "true_tracks", "tracks")
Step = Callable[["TrackedFrame"], tuple[np.ndarray, Detections]]


@dataclass(frozen=True)
class TrackedFrame:
    """One frame: detections, weak ones included, and labels with track ids."""

    found: Detections
    truth: GroundTruth
    stamp_ns: int = 0
    pose: np.ndarray | None = None
    calibration: Calibration | None = None


def measure_recording(recording: Recording) -> dict:
    """Track PointPillars' detections in a recording with both trackers; {} without track ids."""
    if not recording.frames or not recording.frames[0].sequence:
        return {}
    detector = open_detector("pointpillars", min_score=MIN_SCORE, sensor_height=recording.frames[0].sensor_height)
    drives: dict[str, list[TrackedFrame]] = {}
    source = choose_ego_source(recording)
    for frame in show_progress(recording, "detecting", len(recording)):
        truth, frame = frame.truth(), frame.with_cached_scan()
        if truth is not None and all("track_id" in extra for extra in truth.extras):
            if frame.sequence not in drives:
                pose_of = make_pose_reader(source)
            drives.setdefault(frame.sequence, []).append(
                TrackedFrame(
                    detector(frame.load()).detections, truth, frame.stamp_ns, pose_of(frame), frame.calibration()
                )
            )
    return measure_tracking(drives) if drives else {}


def measure_tracking(drives: Mapping[str, Sequence[TrackedFrame]], params: TrackingParams = TrackingParams()) -> dict:
    """Measure both trackers, "ours" and "plain AB3DMOT".

    Returns the scores of TrackingReport by centres, and ms, the median time per frame.
    """
    return {
        name: _measure(drives, make)
        for name, make in (("plain AB3DMOT", lambda: peer(PlainAb3dmot())), ("ours", lambda: tracker(params)))
    }


def peer(plain: PlainAb3dmot, operating: float = OPERATING) -> Step:
    """Track one drive with the peer, which gets detections of score `operating` or more."""
    return lambda seen: plain(seen.found[seen.found.scores >= operating], seen.pose)


def tracker(params: TrackingParams) -> Step:
    """Track one drive with our tracker."""
    ours = Tracker(params)

    def step(seen: TrackedFrame) -> tuple[np.ndarray, Detections]:
        tracks = ours(seen.found, seen.stamp_ns, seen.pose)
        return tracks.ids, tracks.detections

    return step


def _measure(drives: Mapping[str, Sequence[TrackedFrame]], make: Callable[[], Step]) -> dict:
    report, ms = TrackingReport(), []
    for name, frames in drives.items():
        step = make()
        for i, seen in enumerate(frames):
            start = perf_counter()
            ids, found = step(seen)
            ms.append((perf_counter() - start) * 1e3)
            report.update(observe(name, i, seen.truth, to_tracked_labels(ids, found), seen.calibration))
    return {**report.compute(), "ms": float(np.median(ms)) if ms else None}


def print_tracking(content: dict) -> None:
    """Print a row per class and tracker."""
    table = Table(title="Tracks by centres, similarity 1 - d / 2 m")
    for name in ("class", "tracker", *SHOWN):
        table.add_column(name, justify="left" if name in ("class", "tracker") else "right")
    for kind in next(iter(content.values()))["classes"]:
        table.add_section()
        for tracker, scores in content.items():
            own = scores["classes"][kind]
            if own is not None:
                table.add_row(
                    kind,
                    tracker,
                    *(str(own[name]) if isinstance(own[name], int) else f"{100 * own[name]:.1f}" for name in SHOWN),
                )
    console.print(table)
