"""Poses between those that are known, and the ways of tracks."""

from __future__ import annotations

import numpy as np
import pytest
from tracking_samples import START, TENTH, crowd, pose

from lidar_perception.tracking.ego import moved_boxes, usable
from lidar_perception.tracking.poses import CAPACITY, TRAIL_POINTS, PoseHistory, Trails, between
from lidar_perception.tracking.tracker import Tracker
from lidar_perception.types import Detections


def test_between_two_poses_it_goes_straight_and_turns_evenly():
    history = PoseHistory()
    for i in (0, 2, 1):  # in any order
        assert history.add(START + i * TENTH, pose(i, 2 * i, 0.2 * i))
    for share in (0.0, 0.3, 1.0, 1.75, 2.0, 2.5):  # the last one lies beyond
        found = history.at(START + int(share * TENTH), 0.5)
        np.testing.assert_allclose(found, pose(share, 2 * share, 0.2 * share), atol=1e-6)
        assert usable(found)
    np.testing.assert_allclose(between(pose(1), pose(2), 0.0), pose(1), atol=1e-12)


def test_what_is_too_far_away_or_no_pose_is_not_known():
    history = PoseHistory()
    assert history.at(START, 0.5) is None
    assert not history.add(START, np.full((4, 4), np.nan)) and not len(history)
    history.add(START, pose(0))
    assert history.at(START - 1, 0.5) is None and history.at(START + 1, 0.5) is None
    history.add(START + TENTH, pose(1))
    assert history.at(START + 5 * TENTH, 0.5) is not None
    assert history.at(START + 7 * TENTH, 0.5) is None
    history.add(START + 20 * TENTH, pose(2))
    assert history.at(START + 15 * TENTH, 0.5) is None  # a gap that is too long
    assert history.at(START + TENTH, 0.0) is not None   # its very stamp


def test_a_bag_that_starts_again_begins_anew_and_memory_is_bounded():
    history = PoseHistory()
    for i in range(3 * CAPACITY):
        history.add(START + i * TENTH, pose(i))
        assert len(history) <= CAPACITY
    history.add(START, pose(5))
    assert len(history) == 1 and history.at(START, 0.5)[0, 3] == 5


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
