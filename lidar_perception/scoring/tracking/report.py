"""Tracking scores by class. Frames may come in any order."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

from lidar_perception.camera import Calibration
from lidar_perception.classes import DETECTED
from lidar_perception.data.frame import Frame, Recording
from lidar_perception.detectors.contract import Detector
from lidar_perception.scoring.tracking.clear import ClearCounts, count_clear
from lidar_perception.scoring.tracking.hota import HotaCounts, count_hota
from lidar_perception.scoring.tracking.over_recall import score_over_recall
from lidar_perception.scoring.tracking.pairs import Pairs, drop_ignored, make_pairs, read_track_ids, to_tracked_labels
from lidar_perception.tracking.drive_tracker import DriveTracker
from lidar_perception.tracking.params import TrackingParams
from lidar_perception.types import GroundTruth, InputError


@dataclass(frozen=True)
class Observation:
    """Labels and tracks of one frame, by class.

    Attributes:
        sequence: Name of the sequence.
        index: Index of the frame in the sequence.
        pairs: Labels and tracks by class.
        has_pose: False if the frame has no pose.
    """

    sequence: str
    index: int
    pairs: dict[str, Pairs]
    has_pose: bool = True


def make_observation(
    sequence: str, index: int, truth: GroundTruth, tracks: GroundTruth, calibration: Calibration | None = None
) -> Observation:
    """Make the Observation of a frame. See make_pairs for the other arguments.

    Raises:
        InputError: The frame cannot be scored. The message contains the sequence and frame.
    """
    try:
        return Observation(sequence, index, make_pairs(truth, tracks, calibration))
    except InputError as error:
        raise InputError(f"{sequence}/{index}: {error}") from None


def measure_tracking(
    open_detector: Callable[[], Detector], params: TrackingParams, ego: str, recording: Recording
) -> Callable[[Frame], Observation | None]:
    """Make a function that runs a detector and a DriveTracker on each frame.

    Frames must be measured in order of time, in one process.
    partial(measure_tracking, open_detector, params, ego) is a StartMeasurement of scoring.run.
    """
    tracker = DriveTracker(recording, params, ego)
    detector = open_detector()

    def measure(frame: Frame) -> Observation | None:
        truth = frame.truth()
        if truth is not None:
            read_track_ids(truth, "label")  # checked before the detector runs
        frame = frame.with_cached_scan()
        tracks = tracker(frame, detector(frame.load()).detections)
        if truth is None:
            return None
        tracked_labels = to_tracked_labels(tracks.ids, tracks.detections)
        return replace(
            make_observation(tracker.drive, frame.index, truth, tracked_labels, frame.calibration()),
            has_pose=tracker.has_pose,
        )

    return measure


@dataclass
class TrackingReport:
    """Frames of all sequences. A frame that is added again replaces the earlier one."""

    frames: dict[tuple[str, int], dict[str, Pairs]] = field(default_factory=dict)
    without_pose: set[tuple[str, int]] = field(default_factory=set)
    skipped: list[str] = field(default_factory=list)

    def update(self, observation: Observation) -> None:
        """Add one frame."""
        key = observation.sequence, observation.index
        self.frames[key] = observation.pairs
        (self.without_pose.discard if observation.has_pose else self.without_pose.add)(key)

    def compute(self) -> dict:
        """Return the content of the JSON file: numbers of frames, and scores (0..1) by class.

        The scores are None for a class without labels and tracks.
        """
        names = sorted({sequence for sequence, _ in self.frames})
        sequences = {name: [self.frames[key] for key in sorted(self.frames) if key[0] == name] for name in names}
        return {
            "frames": len(self.frames),
            "without_pose": len(self.without_pose),
            "sequences": len(names),
            "skipped": self.skipped,
            "classes": {
                name: _score_class([[frame[name] for frame in frames] for frames in sequences.values()])
                for name in DETECTED
            },
        }


def _score_class(sequences: list[list[Pairs]]) -> dict | None:
    scored_sequences = [[drop_ignored(f) for f in frames] for frames in sequences]
    hota, clear = HotaCounts(), ClearCounts()
    for frames in scored_sequences:
        hota, clear = hota + count_hota(frames), clear + count_clear(frames)
    if clear.tp + clear.fn + clear.fp == 0:
        return None
    return {
        **hota.compute_scores(),
        **clear.compute_scores(),
        **score_over_recall(sequences),
        "labels": clear.tp + clear.fn,
        "boxes": clear.tp + clear.fp,
        "true_tracks": _count_tracks(scored_sequences, "true_ids"),
        "tracks": _count_tracks(scored_sequences, "track_ids"),
        "hits": clear.tp,
        "misses": clear.fn,
        "false": clear.fp,
        "switches": clear.switches,
        "fragments": clear.fragments,
        "mostly_tracked": clear.mostly_tracked,
        "partly_tracked": clear.partly_tracked,
        "mostly_lost": clear.mostly_lost,
    }


def _count_tracks(sequences: list[list[Pairs]], name: str) -> int:
    return sum(len({i for f in frames for i in getattr(f, name).tolist()}) for frames in sequences)
