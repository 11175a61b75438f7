"""The robot's crop, and TF from other nodes, over DDS."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")

from robot_messages import PERIOD, START, WALKING, make_robot_cloud, make_walker, mount_pose, transforms

from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.pipeline import find_candidates
from lidar_perception.candidates.seed_sources import make_fixed_source
from lidar_perception.candidates.seeds import load_seed
from lidar_perception.data.bag import Bag
from lidar_perception.nodes.transforms import STATIC_QOS
from lidar_perception.param_fields import with_values
from lidar_perception.wire.codec import encode, make_bag_message
from lidar_perception.wire.messages import read_column, to_detections, to_point_cloud
from lidar_perception.wire.topics import POINTS
from msg_utils.markers import from_marker_array
from msg_utils.stamps import make_header

TF_MESSAGE = "tf2_msgs/msg/TFMessage"
CLOUD, MARKERS = "sensor_msgs/msg/PointCloud2", "visualization_msgs/msg/MarkerArray"


@pytest.fixture(scope="module")
def cloud(drive_bag):
    with Bag(drive_bag) as bag:
        return next(m for _, _, m in bag.messages({POINTS}))


def test_cropped_cloud_gives_the_offline_candidates(processes, peer, cloud):
    """Candidates equal those of the offline pipeline, and cropped points are not in view.

    An empty parameter can be set at run time, also with integers.
    """
    values = {
        "crop.body": [-2, -1, -2, 3, 1, 1],
        "crop.min_range": 3.0,
        "crop.sectors": [60.0, 300.0],
        "crop.max_range": 40.0,
    }
    params = with_values(PipelineParams(), values)
    processes.start("perception", {"~/input/points": "/in"}, values)
    processes.start("ground_segmentation", {"~/input/points": "/in"}, values)
    found = peer.listen("/perception/output/detections", MARKERS)
    clouds = peer.listen("/ground_segmentation/output/points", CLOUD)
    talker = peer.advertise("/in", CLOUD)
    peer.send(talker, cloud, lambda: found and clouds, "both results")
    frame, usable = to_point_cloud(cloud)
    segmented, candidates = find_candidates(frame, make_fixed_source(load_seed("")), params=params)
    expected, received = candidates.final, to_detections(from_marker_array(found[-1]))
    assert len(expected) and 0 < len(segmented.indices) < len(frame)
    np.testing.assert_array_equal(received.boxes, expected.boxes)
    np.testing.assert_array_equal(received.scores, expected.scores)
    everything = np.arange(cloud.height * cloud.width)
    in_view = np.flatnonzero(read_column(clouds[-1], "in_view", everything))
    np.testing.assert_array_equal(in_view, usable.take(segmented.indices))
    np.testing.assert_array_equal(read_column(clouds[-1], "ground", in_view) > 0, segmented.ground)
    cropped = str(len(frame) - len(segmented.indices))
    peer.wait(lambda: peer.get_value("perception", "cropped") == cropped, "the count")

    peer.set_parameter("/ground_segmentation", "crop.sectors", [0, 360])
    peer.send(
        talker,
        cloud,
        lambda: not read_column(clouds[-1], "in_view", everything).any(),
        "a cloud of which nothing is left",
    )
    peer.wait(lambda: "crop.* removes all of its points" in peer.get_message("ground_segmentation"), "the reason")


def test_tilted_sensor_gets_its_mount_from_tf(processes, peer):
    """Boxes in odom are those of a level sensor, moved with the robot. The cloud waits for a late
    transform."""
    pytest.importorskip("tf2_msgs", reason="the wheels of the pip environment lack tf2_msgs")
    base = mount_pose(0.5, 0.2, 1.7, 0.0, 0.3, -0.2)
    base_pose = mount_pose(30.0, -4.0, 0.0, 0.0, 0.0, 0.0)
    xyz, person = make_walker(base)
    processes.start("perception", {"~/input/points": "/in"}, {**WALKING, "base_frame": "base", "target_frame": "odom"})
    static = peer.advertise("/tf_static", TF_MESSAGE, STATIC_QOS)
    static.publish(encode(transforms(("base", "lidar", base, 0))))
    moving = peer.advertise("/tf", TF_MESSAGE)
    click = peer.advertise("/clicked_point", "geometry_msgs/msg/PointStamped")
    found = peer.listen("/perception/output/detections", MARKERS)
    talker = peer.advertise("/in", CLOUD)
    at = (person + base_pose[:3, 3]).tolist()
    peer.send(
        click,
        make_bag_message(
            "geometry_msgs/msg/PointStamped",
            header=make_header(START, "odom", make_bag_message),
            point=make_bag_message("geometry_msgs/msg/Point", **dict(zip("xyz", at))),
        ),
        click.get_subscription_count,
        "a subscriber of the click",
    )
    early, late = (transforms(("odom", "base", base_pose, START + i * PERIOD)) for i in (-1, 1))
    peer.send(moving, early, moving.get_subscription_count, "a subscriber of /tf")
    peer.send(
        talker,
        make_robot_cloud(xyz),
        lambda: "waits for the newest transform of 'odom' -> 'base'" in peer.get_message("perception"),
        "a cloud, once /tf_static is there, to wait",
    )
    peer.send(
        moving,
        late,
        lambda: found and from_marker_array(found[-1]).frame_id == "odom",
        "the person, in a cloud that has waited",
    )
    objects = from_marker_array(found[-1])
    assert (len(objects), objects.stamp_ns) == (1, START)
    np.testing.assert_allclose(objects.boxes[0, :2], at[:2], atol=0.3)
    assert abs(objects.boxes[0, 2] - objects.boxes[0, 5] / 2) < 0.1  # the box stands on the ground
