"""The tracker on real scans with the shipped weights."""

from __future__ import annotations

from functools import partial

import pytest

pytestmark = pytest.mark.no_cover  # covered by other tests

FRAMES = 20


@pytest.fixture(scope="module")
def detector(data):
    """Detections of the first frames, computed once."""
    from lidar_perception.data.open import open_recording
    from lidar_perception.detectors.open import open_detector
    from lidar_perception.detectors.params import MIN_SCORE

    found, detect = {}, open_detector("pointpillars", min_score=MIN_SCORE)
    for frame in open_recording(data / "kitti_tracking").frames[:FRAMES]:
        scan = frame.load()
        found[scan.stamp_ns] = detect(scan)
    assert len(found) == FRAMES
    return lambda scan: found[scan.stamp_ns]


@pytest.mark.parametrize("ego", ["none", "auto"])
def test_real_drive_has_no_id_switches(data, detector, ego):
    """The drive has no poses, so auto uses KISS-ICP."""
    from lidar_perception.data.frame import POSES
    from lidar_perception.data.open import open_recording
    from lidar_perception.scoring.run import fill_report
    from lidar_perception.scoring.tracking.report import TrackingReport, measure_tracking
    from lidar_perception.tracking.drive_tracker import choose_ego_source
    from lidar_perception.tracking.ego import has_odometry
    from lidar_perception.tracking.params import TrackingParams

    report, drive = TrackingReport(), open_recording(data / "kitti_tracking")
    if ego == "auto" and POSES not in drive.contents:
        assert choose_ego_source(drive) == ("kiss_icp" if has_odometry() else "none")
    fill_report(report, drive, partial(measure_tracking, lambda: detector, TrackingParams(), ego), limit=FRAMES)
    cars = report.compute()["classes"]["Car"]
    assert cars["switches"] == 0 and cars["HOTA"] > 0.7
