"""Scores of tracks in a bag with labels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lidar_perception.camera import Calibration
from lidar_perception.data.frame import is_same_drive
from lidar_perception.scoring.recorded import RecordedResult
from lidar_perception.scoring.tracking.pairs import to_tracked_labels
from lidar_perception.scoring.tracking.report import TrackingReport, make_observation
from lidar_perception.wire.messages import to_detections, to_truth


def count_recorded_tracks(frames: Sequence[RecordedResult]) -> dict[str, int]:
    """Count the recorded tracks by class."""
    ids: dict[str, set[int]] = {}
    for frame in frames:
        for i, label in zip(frame.objects.ids.tolist(), frame.objects.labels):
            ids.setdefault(label, set()).add(i)
    return {name: len(ids[name]) for name in sorted(ids)}


def score_recorded_tracks(
    frames: Sequence[RecordedResult], calibration: Calibration | None
) -> dict[str, dict[str, Any] | None]:
    """Score recorded tracks; return the entry "classes" of TrackingReport.compute().

    Raises:
        InputError: The labels have no track ids.
    """
    report, drive, last_stamp_ns = TrackingReport(), 0, 0
    for i, frame in enumerate(frames):
        drive += not is_same_drive(last_stamp_ns, frame.stamp_ns)
        last_stamp_ns = frame.stamp_ns
        report.update(
            make_observation(
                f"drive {drive}",
                i,
                to_truth(frame.truth),
                to_tracked_labels(np.asarray(frame.objects.ids), to_detections(frame.objects)),
                calibration,
            )
        )
    return report.compute()["classes"]
