"""The tracker on real scans, detections by the weights that come with the package."""

from __future__ import annotations


def test_no_identity_switches_on_a_real_drive_without_poses(data):
    from lidar_perception.data.kitti.folder import open_kitti
    from lidar_perception.detectors.open import open_detector
    from lidar_perception.detectors.pointpillars.params import DetectionParams
    from lidar_perception.detectors.pointpillars.weights_file import weights_file
    from lidar_perception.scoring.tracking.pairs import tracked_labels
    from lidar_perception.scoring.tracking.report import TrackingReport, observe
    from lidar_perception.tracking.tracker import Tracker

    detector = open_detector(weights_file(DetectionParams(version="v4", size="compact")), "cpu",
                             least_score=0.05)
    tracker, report = Tracker(), TrackingReport()
    for i, frame in enumerate(open_kitti(data / "kitti_tracking")[:20]):
        tracks = tracker(detector(frame.load()), frame.stamp_ns)
        report.update(observe("a", i, frame.truth(),
                              tracked_labels(tracks.ids, tracks.detections), frame.calibration()))
    cars = report.compute()["classes"]["Car"]
    assert cars["switches"] == 0 and cars["HOTA"] > 0.7
