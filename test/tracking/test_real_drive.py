"""The tracker on real scans, detections by the weights that come with the package."""

from __future__ import annotations

from functools import partial


def test_no_identity_switches_on_a_real_drive_without_poses(data):
    from lidar_perception.data.open import open_recording
    from lidar_perception.detectors.open import open_detector
    from lidar_perception.detectors.params import MIN_SCORE
    from lidar_perception.scoring.run import fill
    from lidar_perception.scoring.tracking.report import TrackingReport, by_tracker

    report = TrackingReport()
    fill(report, open_recording(data / "kitti_tracking"),
         by_tracker(partial(open_detector, min_score=MIN_SCORE)), limit=20)
    cars = report.compute()["classes"]["Car"]
    assert cars["switches"] == 0 and cars["HOTA"] > 0.7
