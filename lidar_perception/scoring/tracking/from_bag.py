"""Scores of tracks that were recorded to a bag with labels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lidar_perception.camera import Calibration
from lidar_perception.data.drives import is_same_drive
from lidar_perception.scoring.recorded import RecordedResult
from lidar_perception.scoring.tracking.pairs import to_tracked_labels
from lidar_perception.scoring.tracking.report import TrackingReport, observe
from lidar_perception.types import InputError
from lidar_perception.wire.messages import to_detections, to_truth


@dataclass(frozen=True)
class RecordedTracks:
    """Scores of recorded tracks.

    Attributes:
        count: number of tracks by class.
        scores: by class as in TrackingReport, None for a class without labels and tracks.
        problem: why there are no scores, or None.
    """

    count: dict[str, int]
    scores: dict[str, dict[str, Any] | None]
    problem: str | None = None


def score_recorded_tracks(frames: Sequence[RecordedResult], calibration: Calibration | None
                          ) -> RecordedTracks:
    """Score the tracks in recorded results."""
    labels = [(label, i) for frame in frames
              for i, label in zip(frame.found.ids.tolist(), frame.found.labels)]
    count = {name: len({i for label, i in labels if label == name})
             for name in sorted({label for label, _ in labels})}
    report, drive, before = TrackingReport(), 0, 0
    try:
        for i, frame in enumerate(frames):
            drive += not is_same_drive(before, frame.stamp_ns)
            before = frame.stamp_ns
            report.update(observe(f"drive {drive}", i, to_truth(frame.truth), to_tracked_labels(
                np.asarray(frame.found.ids), to_detections(frame.found)), calibration))
    except InputError as error:
        return RecordedTracks(count, {}, str(error))
    return RecordedTracks(count, report.compute()["classes"])
