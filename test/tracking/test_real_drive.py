"""The tracker on real scans, detections by the weights that come with the package."""

from __future__ import annotations

import pytest

pytestmark = pytest.mark.no_cover  # others run these lines

FRAMES = 20


@pytest.fixture(scope="module")
def detector(data):
    """What the detector finds, once for all tests."""
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
def test_no_identity_switches_on_a_real_drive(data, detector, ego):
    """Which has no poses: auto takes them from the scans."""
    from lidar_perception.data.frame import POSES
    from lidar_perception.data.open import open_recording
    from lidar_perception.scoring.run import fill
    from lidar_perception.scoring.tracking.report import TrackingReport, by_tracker
    from lidar_perception.tracking.drive_tracker import ego_of
    from lidar_perception.tracking.ego import has_odometry

    report, drive = TrackingReport(), open_recording(data / "kitti_tracking")
    if ego == "auto" and POSES not in drive.has:
        assert ego_of(drive) == ("kiss_icp" if has_odometry() else "none")
    fill(report, drive, by_tracker(lambda: detector, ego=ego), limit=FRAMES)
    cars = report.compute()["classes"]["Car"]
    assert cars["switches"] == 0 and cars["HOTA"] > 0.7
