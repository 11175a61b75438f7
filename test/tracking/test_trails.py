"""The ways of tracks."""

from __future__ import annotations

import numpy as np
import pytest
from tracking_samples import START, TENTH, crowd, pose

from lidar_perception.tracking.ego import moved_boxes
from lidar_perception.tracking.tracker import Tracker
from lidar_perception.tracking.trails import TRAIL_POINTS, Trails
from lidar_perception.types import Detections


@pytest.mark.parametrize("seconds", [0.0, 0.55, 60.0])
def test_trails_end_at_the_tracks_and_lie_where_they_were(seconds):
    tracker, trails, seen = Tracker(), Trails(), {}
    for i, found in enumerate(crowd(2, 40)):
        at, stamp = pose(0.9 * i, 0.1 * i, 0.03 * i), START + i * TENTH
        local = Detections.of(moved_boxes(found.boxes, np.linalg.inv(at)), found.class_ids,
                              found.scores)
        tracks = tracker(local, stamp, at)
        ways = trails(tracks, tracker.pose, stamp, seconds)
        for number, way, box in zip(tracks.ids.tolist(), ways, tracks.detections.boxes):
            np.testing.assert_allclose(way[-1], box[:3], atol=1e-4)
            seen.setdefault(number, []).append(at[:3, :3] @ box[:3] + at[:3, 3])
            expected = np.array(seen[number])[-min(int(seconds * 10) + 1, TRAIL_POINTS):]
            np.testing.assert_allclose(way @ at[:3, :3].T + at[:3, 3], expected, atol=1e-4)
    assert len(trails(tracks, tracker.pose, stamp, seconds)) == len(tracks)


def test_pose_covariances_are_those_of_x_y_z_and_the_heading():
    for i, found in enumerate(crowd()):
        tracks = Tracker()(found, START + i * TENTH)
    square = tracks.pose_covariances()
    assert square.shape == (len(tracks), 6, 6)
    np.testing.assert_array_equal(square, square.transpose(0, 2, 1))
    for k in range(len(tracks)):
        own = tracks.covariances[k]
        assert np.diag(square[k]).tolist() == [own[0, 0], own[1, 1], tracks.height_variances[k],
                                               0, 0, own[4, 4]]
        assert square[k, 0, 5] == own[0, 4] and square[k, 1, 5] == own[1, 4]
