"""Tracks and labels in a bag: their scores and trails."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from marker_messages import make_track_markers
from tracking_samples import START, TENTH, make_crowd_detections

from lidar_perception.data.bag import BagWriter
from lidar_perception.scoring.recorded import read_results
from lidar_perception.scoring.tracking.from_bag import count_recorded_tracks, score_recorded_tracks
from lidar_perception.tracking.tracker import Tracker
from lidar_perception.tracking.trails import Trails
from lidar_perception.types import GroundTruth, InputError
from lidar_perception.wire.codec import make_bag_message
from lidar_perception.wire.messages import make_truth_markers
from lidar_perception.wire.topics import TRUTH
from lidar_perception.wire.track_markers import read_trails
from msg_utils.stamps import make_header

MARKERS, TRACKS = "visualization_msgs/msg/MarkerArray", "/tracker/output/tracks"


@pytest.fixture(params=[True, False], ids=["with track ids", "without"])
def recorded_tracks(request, tmp_path):
    """Return a bag of the tracked crowd, whether its labels have track ids, and the last array of
    tracks."""
    tracker, trails = Tracker(), Trails()
    with BagWriter(tmp_path / "bag") as bag:
        for topic in (TRUTH, TRACKS):
            bag.add_topic(topic, MARKERS)
        for i, found in enumerate(make_crowd_detections()):
            stamp = START + i * TENTH
            header = make_header(stamp, "velodyne", make_bag_message)
            tracks = tracker(found, stamp)
            extras = [
                {"track_id": k, "occluded": 0, "truncated": 0.0} if request.param else {} for k in range(len(found))
            ]
            truth = GroundTruth.of(found.boxes, found.class_ids, extras)
            message = make_track_markers(
                tracks.ids,
                tracks.detections,
                tracks.velocities,
                tracks.moving,
                trails(tracks, tracker.pose, stamp, 1.0),
                header,
                make_bag_message,
            )
            bag.write(TRUTH, stamp, make_truth_markers(truth, header, make_bag_message))
            bag.write(TRACKS, stamp, message)
    return tmp_path / "bag", request.param, message


def test_recorded_tracks_need_labels_with_ids(recorded_tracks):
    path, with_ids, _ = recorded_tracks
    frames = read_results(path, TRACKS)[0]
    assert count_recorded_tracks(frames) == {"Car": 2, "Cyclist": 1, "Pedestrian": 3}
    if with_ids:
        scores = score_recorded_tracks(frames, None)["Pedestrian"]
        assert (scores["true_tracks"], scores["switches"]) == (3, 0) and scores["HOTA"] > 0.8
        later = [
            replace(
                f, stamp_ns=f.stamp_ns + 600 * TENTH, objects=replace(f.objects, ids=np.asarray(f.objects.ids) + 100)
            )
            for f in frames
        ]
        both = score_recorded_tracks([*frames, *later], None)["Pedestrian"]  # two drives
        assert (both["true_tracks"], both["switches"], both["HOTA"]) == (6, 0, scores["HOTA"])
    else:
        with pytest.raises(InputError, match="track id"):
            score_recorded_tracks(frames, None)
    assert read_results(path, "/nothing")[0] == []


def test_recorded_tracks_have_trails(recorded_tracks):
    trails = read_trails(recorded_tracks[2])
    assert {*trails} == {1, 2, 3, 4, 5, 6} and all(len(way) > 5 for way in trails.values())
