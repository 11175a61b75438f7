"""Past positions of tracks, and messages of tracks."""

from __future__ import annotations

import numpy as np
import pytest
from tracking_samples import START, TENTH, make_car, make_crowd_detections, make_detections, make_flat_pose

from lidar_perception.robot.poses import transform_boxes
from lidar_perception.tracking.tracker import Tracker
from lidar_perception.tracking.trails import TRAIL_POINTS, Trails
from lidar_perception.types import CLASSES, Detections
from lidar_perception.wire.codec import decode, encode, make_bag_message
from msg_utils.detections import to_detection_array
from msg_utils.stamps import make_header


@pytest.mark.parametrize("seconds", [0.0, 0.55, 2.0])
def test_trails_are_the_past_positions_of_tracks(seconds):
    tracker, trails, positions_by_id = Tracker(), Trails(), {}
    for i, found in enumerate(make_crowd_detections(2, 40)):
        at, stamp = make_flat_pose(0.9 * i, 0.1 * i, 0.03 * i), START + i * TENTH
        local = Detections.of(transform_boxes(found.boxes, np.linalg.inv(at)), found.class_ids, found.scores)
        tracks = tracker(local, stamp, at)
        lines = trails(tracks, tracker.pose, stamp, seconds)
        for number, line, box in zip(tracks.ids.tolist(), lines, tracks.detections.boxes):
            np.testing.assert_allclose(line[-1], box[:3], atol=1e-4)
            positions_by_id.setdefault(number, []).append(at[:3, :3] @ box[:3] + at[:3, 3])
            expected = np.array(positions_by_id[number])[-min(int(seconds * 10) + 1, TRAIL_POINTS) :]
            np.testing.assert_allclose(line @ at[:3, :3].T + at[:3, 3], expected, atol=1e-4)
    assert len(trails(tracks, tracker.pose, stamp, seconds)) == len(tracks)


@pytest.mark.parametrize("rate, seconds", [(5, 5.0), (10, 2.0), (20, 1.0), (30, 2.0)])
def test_trails_last_equally_long_at_any_rate(rate, seconds):
    tracker, trails = Tracker(), Trails()
    for i in range(round(1.5 * seconds * rate)):
        stamp = START + i * 10**9 // rate + 1000 * (i % 3)  # up to 2 us late
        tracks = tracker(make_detections(make_car(2 * i / rate)), stamp, make_flat_pose(0))
        (line,) = trails(tracks, tracker.pose, stamp, seconds)
        assert len(line) <= TRAIL_POINTS and line[-1, 0] == tracks.detections.boxes[0, 0]
        assert (np.diff(line[:, 0]) > 0).all()
    assert len(line) >= min(TRAIL_POINTS / 2, rate * seconds)
    assert 0.85 * 2 * seconds < np.ptp(line[:, 0]) < 2 * seconds + 0.01  # at 2 m/s


@pytest.fixture(scope="module")
def tracks():
    tracker = Tracker()
    return [tracker(found, START + i * TENTH) for i, found in enumerate(make_crowd_detections())][-1]


def test_pose_covariances_include_position_and_heading(tracks):
    square = tracks.to_pose_covariances()
    assert square.shape == (len(tracks), 6, 6)
    np.testing.assert_array_equal(square, square.transpose(0, 2, 1))
    for k in range(len(tracks)):
        own = tracks.covariances[k]
        assert np.diag(square[k]).tolist() == [own[0, 0], own[1, 1], tracks.height_variances[k], 0, 0, own[4, 4]]
        assert square[k, 0, 5] == own[0, 4] and square[k, 1, 5] == own[1, 4]


def test_detection_array_has_ids_and_covariances_of_tracks(tracks):
    found = tracks.detections
    array = to_detection_array(
        found.boxes,
        [CLASSES[i] for i in found.class_ids],
        found.scores,
        ids=tracks.ids + 40,
        covariances=tracks.to_pose_covariances(),
        make=make_bag_message,
        header=make_header(START, "lidar", make_bag_message),
    )
    read = decode(encode(array), "vision_msgs/msg/Detection3DArray")
    assert [d.id for d in read.detections] == [str(i + 40) for i in tracks.ids.tolist()]
    for detection, square in zip(read.detections, tracks.to_pose_covariances(), strict=True):
        np.testing.assert_array_equal(detection.results[0].pose.covariance, square.ravel())
