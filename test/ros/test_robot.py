"""What belongs to the robot, over DDS: the crop before everything."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")

from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.pipeline import find_candidates
from lidar_perception.candidates.seed_sources import fixed_seed
from lidar_perception.candidates.seeds import load_seed
from lidar_perception.data.bag import Bag
from lidar_perception.param_fields import with_values
from lidar_perception.wire.messages import column, to_detections, to_frame
from lidar_perception.wire.topics import POINTS
from msg_utils.markers import from_marker_array

CLOUD, MARKERS = "sensor_msgs/msg/PointCloud2", "visualization_msgs/msg/MarkerArray"


@pytest.fixture(scope="module")
def cloud(drive_bag):
    with Bag(drive_bag) as bag:
        return next(m for _, _, m in bag.messages({POINTS}))


def test_a_cropped_cloud_over_dds_is_the_cropped_frame_offline(processes, peer, cloud):
    """Candidates equal those of the offline pipeline with the same parameters; what is cropped is
    not in view. A parameter that was empty can be set while the node runs, with whole numbers."""
    values = {"crop.body": [-2, -1, -2, 3, 1, 1], "crop.min_range": 3.0,
              "crop.sectors": [60.0, 300.0], "crop.max_range": 40.0}
    params = with_values(PipelineParams(), values)
    processes.start("perception", {"~/input/points": "/in"}, values)
    processes.start("ground_segmentation", {"~/input/points": "/in"}, values)
    found = peer.listen("/perception/output/detections", MARKERS)
    clouds = peer.listen("/ground_segmentation/output/points", CLOUD)
    talker = peer.talker("/in", CLOUD)
    peer.send(talker, cloud, lambda: found and clouds, "both results")
    frame, usable = to_frame(cloud)
    segmented, candidates = find_candidates(frame, fixed_seed(load_seed("")), params=params)
    expected, received = candidates.final, to_detections(from_marker_array(found[-1]))
    assert len(expected) and 0 < len(segmented.indices) < len(frame)
    np.testing.assert_array_equal(received.boxes, expected.boxes)
    np.testing.assert_array_equal(received.scores, expected.scores)
    everything = np.arange(cloud.height * cloud.width)
    in_view = np.flatnonzero(column(clouds[-1], "in_view", everything))
    np.testing.assert_array_equal(in_view, usable.take(segmented.indices))
    np.testing.assert_array_equal(column(clouds[-1], "ground", in_view) > 0, segmented.ground)
    cropped = str(len(frame) - len(segmented.indices))
    peer.wait(lambda: peer.value_of("perception", "cropped") == cropped, "the count")

    peer.set_parameter("/ground_segmentation", "crop.sectors", [0, 360])
    peer.send(talker, cloud, lambda: not column(clouds[-1], "in_view", everything).any(),
              "a cloud of which nothing is left")
    peer.wait(lambda: "crop.* leaves none" in peer.message_of("ground_segmentation"), "the reason")
