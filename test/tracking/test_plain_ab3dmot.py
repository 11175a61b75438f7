"""AB3DMOT as peer of the tracking benchmark: births and deaths, and the comparison."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmark.plain_ab3dmot import PlainAb3dmot
from benchmark.tracking import TrackedFrame, measure_tracking
from lidar_perception.types import CLASSES, Detections, GroundTruth

CAR = CLASSES.index("Car")


def make_detection(x):
    return Detections.of([[x, 0, -1, 4, 1.8, 1.5, 0]], CAR, 0.9)


def test_track_starts_after_three_hits_and_ends_after_two_misses():
    tracker, none = PlainAb3dmot(), Detections.none()
    for _ in range(4):
        tracker(none)
    track_counts = [
        len(tracker(found)[0])
        for found in (make_detection(10), make_detection(11), make_detection(12), none, none, make_detection(15))
    ]
    assert track_counts == [0, 0, 1, 1, 0, 0]


def test_plain_tracker_follows_car_and_compensates_poses():
    tracker = PlainAb3dmot()
    for i in range(20):
        pose = np.eye(4)
        pose[0, 3] = 0.9 * i
        ids, found = tracker(make_detection(30 - 0.9 * i), pose)
        assert ids.tolist() == [1] and found.boxes[0, 0] == pytest.approx(30 - 0.9 * i, abs=0.05)
    assert np.abs(tracker.tracks[CAR][0].state[7:]).max() < 0.05


def test_both_trackers_are_scored_on_the_same_frames():
    frames = [
        TrackedFrame(
            make_detection(10 + i),
            GroundTruth.of(make_detection(10 + i).boxes, [CAR], [{"track_id": 5, "occluded": 0, "truncated": 0.0}]),
            10**18 + i * 10**8,
        )
        for i in range(12)
    ]
    content = measure_tracking({"a": frames})
    assert list(content) == ["plain AB3DMOT", "ours"]
    for scores in content.values():
        car = scores["classes"]["Car"]
        assert (car["labels"], car["switches"], car["tracks"]) == (12, 0, 1)
        assert car["HOTA"] > 0.8


def test_only_recordings_with_track_ids_are_tracked(monkeypatch):
    from types import SimpleNamespace

    from benchmark import tracking
    from lidar_perception.data.frame import Frame, Recording
    from lidar_perception.types import PointCloud

    scans = [PointCloud(make_detection(10 + i).boxes[:, :3], None, 10**18 + i * 10**8) for i in range(6)]
    monkeypatch.setattr(
        tracking,
        "open_detector",
        lambda *_, **__: lambda scan: SimpleNamespace(detections=make_detection(scan.xyz[0, 0])),
    )

    def recording(sequence, extra):
        return Recording(
            Path("drive"),
            "made up",
            [
                Frame.of(
                    str(i),
                    scan,
                    GroundTruth.of(make_detection(10 + i).boxes, [CAR], [extra]),
                    sequence=sequence,
                    index=i,
                )
                for i, scan in enumerate(scans)
            ],
        )

    content = tracking.measure_recording(recording("0000", {"track_id": 5}))
    assert content["ours"]["classes"]["Car"]["tracks"] == 1
    assert tracking.measure_recording(recording("", {"track_id": 5})) == {}
    assert tracking.measure_recording(recording("0000", {})) == {}


def test_intervals_of_drives_are_paired():
    from benchmark.drives import _compute_interval, resample

    values = [1.0, 2.0, 4.0]
    means = resample(values, lambda chosen: sum(chosen) / 3)
    np.testing.assert_array_equal(means, resample(values, lambda chosen: sum(chosen) / 3))
    low, high = _compute_interval(means)
    assert 1.0 <= low < np.mean(values) < high <= 4.0
