"""Frames and motion in the nodes: tilted sensors, results and clicks in other frames."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")

from detection_samples import lower_thresholds, make_random_network, make_scan, make_tiny_config
from rclpy.parameter import Parameter
from robot_messages import (
    PERIOD,
    START,
    WALKING,
    deliver_cloud,
    list_problems,
    make_base_odometry,
    make_robot_cloud,
    make_walker,
    mount_pose,
    transforms,
)
from samples import WALKER
from samples import make_scene as walker_scene

from lidar_perception.detectors.checkpoint import Header, save_checkpoint
from lidar_perception.detectors.pointpillars.params import DetectorParams
from lidar_perception.nodes.ground_segmentation import GroundSegmentation
from lidar_perception.nodes.perception import Perception
from lidar_perception.nodes.pointpillars_detector import PointPillarsNode
from lidar_perception.nodes.transforms import NO_TF
from lidar_perception.param_fields import flatten, with_values
from lidar_perception.robot.placement import make_tilted_pose
from lidar_perception.robot.poses import invert_pose, transform_points
from lidar_perception.wire.codec import decode, encode, make_bag_message
from lidar_perception.wire.messages import to_detections
from msg_utils.markers import from_marker_array
from msg_utils.stamps import make_header

pytestmark = pytest.mark.usefixtures("one_thread")


def read_detections(node, topic="detections"):
    objects = from_marker_array(decode(node.sent[topic][-1], "visualization_msgs/msg/MarkerArray"))
    return to_detections(objects), objects.frame_id, objects.stamp_ns


TILTS = {
    "nods": (0.4, 0.1, 1.9, 0.0, 0.35, 0.0),
    "leans": (-0.2, 0.5, 1.2, 0.3, 0.0, -0.3),
    "upside down": (0.0, 0.0, 2.2, -0.4, 0.1, np.pi - 0.05),
}


@pytest.mark.parametrize("tilt", TILTS)
def test_candidates_of_tilted_and_level_sensor_are_equal(start_node, tilt):
    """The candidates are in the base frame, the click in a third frame. TF contains the poses of all mounts."""
    found = []
    x, y, height, yaw, *_ = TILTS[tilt]
    for base in (mount_pose(x, y, height, yaw, 0.0, 0.0), mount_pose(*TILTS[tilt])):
        node = start_node(Perception, base_frame="base", target_frame="base", **WALKING)
        camera = mount_pose(1.0, 0.0, 0.5, 1.0, 0.2, 0.1)
        node.transforms.on_tf(transforms(("base", "lidar", base, 0), ("base", "eye", camera, 0)), static=True)
        xyz, person = make_walker(base)
        at = transform_points(person[None], invert_pose(camera))[0].tolist()
        node.seed._on_click(
            make_bag_message(
                "geometry_msgs/msg/PointStamped",
                header=make_header(START, "eye", make_bag_message),
                point=make_bag_message("geometry_msgs/msg/Point", **dict(zip("xyz", at))),
            )
        )
        deliver_cloud(node, make_robot_cloud(xyz))
        detections, frame_id, stamp = read_detections(node)
        assert (frame_id, stamp, len(detections)) == ("base", START, 1)
        assert np.linalg.norm(detections.boxes[0, :2] - person[:2]) < 0.3
        found.append(detections.boxes[0])
        assert "base" not in list_problems(node)
    level, tilted_one = found
    np.testing.assert_allclose(tilted_one[:6], level[:6], atol=0.05)


def test_seed_bank_keeps_recent_clicks_and_skips_invalid_one(start_node):
    node = start_node(Perception, **WALKING, **{"seed.bank": 2})
    cloud = make_robot_cloud(walker_scene()[:, :3])

    def click(*places):
        for place in places:
            node.seed._on_click(
                make_bag_message(
                    "geometry_msgs/msg/PointStamped",
                    header=make_header(START, "lidar", make_bag_message),
                    point=make_bag_message("geometry_msgs/msg/Point", **dict(zip("xyz", place))),
                )
            )
        deliver_cloud(node, cloud)
        return len(node.seed.clicked_seeds)

    person, nowhere = WALKER[:3].tolist(), [90.0, 90.0, 0.0]
    assert click(nowhere) == 0
    assert click(nowhere, person) == 1 and len(read_detections(node)[0]) == 1
    assert click(person, person) == click(person) == 2


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "v4.safetensors"
    save_checkpoint(path, make_random_network(make_tiny_config("v4")), Header(make_tiny_config("v4")))
    params = with_values(lower_thresholds(), {"pointpillars.weights": str(path), "pointpillars.threads": 1})
    defaults = flatten(DetectorParams())
    return {k: v for k, v in flatten(params).items() if v != defaults[k]}


def test_detections_of_tilted_and_level_sensor_are_equal(start_node, weights):
    """Boxes in the base frame equal those of a level sensor, whether the mount is from TF or parameters. Without
    target_frame they are in the frame of the cloud.
    """
    scan = make_scan()
    place = mount_pose(0.7, -0.3, 1.73, 0.2, 0.0, 0.0)
    tilt = make_tilted_pose(-0.2, 0.3)
    tilted_xyz = transform_points(scan.xyz.astype(np.float64), invert_pose(tilt))
    level = start_node(PointPillarsNode, target_frame="base", **weights)
    level.transforms.on_tf(transforms(("base", "lidar", place, 0)), static=True)
    deliver_cloud(level, make_robot_cloud(scan.xyz, intensity=scan.intensity))
    expected, frame_id, _ = read_detections(level)
    assert frame_id == "base" and len(expected) > 5
    for values, name in (({"target_frame": "base"}, "base"), ({}, "lidar")):
        node = start_node(PointPillarsNode, base_frame="base", **values, **weights)
        node.transforms.on_tf(transforms(("base", "lidar", place @ tilt, 0)), static=True)
        deliver_cloud(node, make_robot_cloud(tilted_xyz, intensity=scan.intensity))
        detections, frame_id, _ = read_detections(node)
        assert frame_id == name and len(detections) == len(expected)
        boxes = detections.boxes.astype(np.float64)
        if name == "lidar":
            boxes[:, :3] = transform_points(boxes[:, :3], place @ tilt)
            by_hand = start_node(
                PointPillarsNode, **{**weights, "ground.sensor_pose.roll": -0.2, "ground.sensor_pose.pitch": 0.3}
            )
            deliver_cloud(by_hand, make_robot_cloud(tilted_xyz, intensity=scan.intensity))
            hand, _, _ = read_detections(by_hand)
            assert len(hand) == len(detections)
            np.testing.assert_allclose(np.sort(hand.boxes, axis=0), np.sort(detections.boxes, axis=0), atol=2e-2)
        order, other = (np.lexsort(b[:, 1::-1].round(1).T) for b in (boxes, expected.boxes))
        np.testing.assert_allclose(boxes[order][:, :6], expected.boxes[other][:, :6], atol=2e-2)
        if name == "base":
            yaw_difference = boxes[order][:, 6] - expected.boxes[other][:, 6]
            np.testing.assert_allclose(np.sin(yaw_difference), 0, atol=1e-2)


@pytest.mark.parametrize("by", ["hand", "TF", "nothing"])
def test_ahead_parameter_rotates_the_range_of_the_detectors(start_node, weights, by):
    """A rotated and tilted sensor gives the boxes of a level one, and points behind it are cropped."""
    scan, ahead = make_scan(), 150.0
    weights = {**weights, "crop.sectors": [100.0, 260.0]}
    plain = start_node(PointPillarsNode, **weights)
    deliver_cloud(plain, make_robot_cloud(scan.xyz, intensity=scan.intensity))
    expected, _, _ = read_detections(plain)
    tilt = np.eye(4) if by == "nothing" else make_tilted_pose(-0.2, 0.3)
    level = invert_pose(mount_pose(0, 0, 0, np.radians(ahead), 0, 0)) @ tilt
    rotated_xyz = transform_points(scan.xyz.astype(np.float64), invert_pose(level))
    leans = {
        "hand": {"ground.sensor_pose.roll": -0.2, "ground.sensor_pose.pitch": 0.3},
        "TF": {"base_frame": "base"},
        "nothing": {},
    }[by]
    node = start_node(PointPillarsNode, **{**weights, **leans, "input.ahead": ahead})
    if by == "TF":
        place = mount_pose(0.7, -0.3, 1.73, 1.0, 0.0, 0.0)  # its heading in the base has no effect
        node.transforms.on_tf(transforms(("base", "lidar", place @ tilt, 0)), static=True)
    deliver_cloud(node, make_robot_cloud(rotated_xyz, intensity=scan.intensity))
    found, frame_id, _ = read_detections(node)
    assert frame_id == "lidar" and len(found) == len(expected) > 5
    assert node.diagnostics.counts["cropped"] == plain.diagnostics.counts["cropped"]
    back = found.boxes.astype(np.float64)
    back[:, :3] = transform_points(back[:, :3], level)
    order, other = (np.lexsort(b[:, 1::-1].round(1).T) for b in (back, expected.boxes))
    np.testing.assert_allclose(back[order][:, :6], expected.boxes[other][:, :6], atol=2e-2)
    if by == "nothing":
        yaw_difference = back[order][:, 6] - expected.boxes[other][:, 6] - np.radians(ahead)
        np.testing.assert_allclose(np.sin(yaw_difference), 0, atol=1e-2)


def test_click_and_candidates_in_rotated_cloud(start_node):
    turn = mount_pose(0, 0, 0, np.radians(-100), 0, 0)
    node = start_node(Perception, **WALKING, **{"input.ahead": -100.0})
    xyz, person = transform_points(walker_scene()[:, :3].astype(np.float64), turn), WALKER[:3]
    at = transform_points(np.array(person, np.float64)[None], turn)[0]
    node.seed._on_click(
        make_bag_message(
            "geometry_msgs/msg/PointStamped",
            header=make_header(START, "lidar", make_bag_message),
            point=make_bag_message("geometry_msgs/msg/Point", **dict(zip("xyz", at.tolist()))),
        )
    )
    deliver_cloud(node, make_robot_cloud(xyz))
    detections, frame_id, _ = read_detections(node)
    assert frame_id == "lidar" and len(detections) == 1
    assert np.linalg.norm(detections.boxes[0, :2] - at[:2]) < 0.3


def test_missing_frames_are_reported_and_parameters_used(start_node):
    """Columns and boxes equal those of a node without frame parameters, bit for bit."""
    xyz, _ = make_walker(mount_pose(0.0, 0.0, 1.7, 0.0, 0.0, 0.0))
    plain = start_node(Perception)
    asks = start_node(Perception, base_frame="base_footprint", target_frame="odom")
    for node in plain, asks:
        deliver_cloud(node, make_robot_cloud(xyz))
    assert asks.sent["detections"] == plain.sent["detections"]
    problems = list_problems(asks)
    for words in (
        "base_frame 'base_footprint'",
        "'lidar' is not in TF",
        "using ground.sensor_pose",
        "target_frame 'odom'",
        "results are in 'lidar'",
    ):
        assert words in problems
    assert "frame" not in list_problems(plain)
    asks.transforms.on_tf(
        transforms(
            ("odom", "base_footprint", np.eye(4), START),
            ("base_footprint", "lidar", mount_pose(0, 0, -1.0, 0, 0, 0), START),
        ),
        static=True,
    )
    deliver_cloud(asks, make_robot_cloud(xyz, START + 1))
    assert "-1.00 m above 'base_footprint', which must be on the ground" in list_problems(asks)
    assert "odom" not in list_problems(asks)


def test_body_crop_needs_a_known_frame(start_node):
    """Cropping in an unknown frame could remove people. A body below the ground is reported."""
    node = start_node(GroundSegmentation, base_frame="base", **{"crop.body": [-0.5, -0.4, 0.2, 0.5, 0.4, 1.0]})
    floor = np.random.default_rng(0).uniform(-20, 20, (2000, 3)) * [1, 1, 0]
    sensor = mount_pose(0.5, 0.0, 1.2, 0.0, 0.0, 0.0)  # the base's origin is behind it
    sensor_xyz = transform_points(np.vstack([floor, [[0.3, 0.0, 0.8]], [[0.9, 0.0, 0.8]]]), invert_pose(sensor))
    deliver_cloud(node, make_robot_cloud(sensor_xyz))
    assert not node.diagnostics.counts["cropped"] and "crop.body is not applied" in list_problems(node)
    node.transforms.on_tf(transforms(("base", "lidar", sensor, START)), static=True)
    deliver_cloud(node, make_robot_cloud(sensor_xyz, START + 1))
    assert node.diagnostics.counts["cropped"] == 1 and "crop.body" not in list_problems(node)
    low = start_node(GroundSegmentation, base_frame="base", **{"crop.body": [-0.5, -0.4, -1.0, 0.5, 0.4, -0.2]})
    low.transforms.on_tf(transforms(("base", "lidar", sensor, START)), static=True)
    deliver_cloud(low, make_robot_cloud(sensor_xyz))
    assert "the top of crop.body is 0.20 m below 'base'" in list_problems(low)


def test_odometry_without_tf_connection_is_still_used(start_node):
    node = start_node(GroundSegmentation, **{"input.deskew": "odometry"})
    for stamp in (START, START + PERIOD):
        node.transforms.on_odometry(make_base_odometry(np.eye(4), stamp, "base"))
    assert not node.transforms._has_tf_subscription
    deliver_cloud(node, make_robot_cloud(np.ones((50, 3)), t=np.arange(50, dtype="<u4") * 10**6))
    assert node.transforms._has_tf_subscription and "'lidar' is not in TF" in list_problems(node)


def test_unreadable_template_affects_candidates_only(start_node):
    node = start_node(Perception, **{"seed.source": "file"})
    assert node.set_parameters([Parameter("seed.file", value="/nowhere.npz")])[0].successful
    deliver_cloud(node, make_robot_cloud(walker_scene()[:, :3]))
    assert len(read_detections(node)[0]) == 0 and "/nowhere.npz" in node.diagnostics.state[1]


def test_cloud_waits_for_late_or_missing_transform(start_node):
    """It does not wait if a transform has stopped or if there is no TF."""
    xyz, _ = make_walker(mount_pose(0.0, 0.0, 1.7, 0.0, 0.0, 0.0))
    node = start_node(Perception, target_frame="odom")
    deliver, msg = node.inputs.receptions[0].deliver, encode(make_robot_cloud(xyz))
    node.transforms.problem_by_source["TF"] = NO_TF
    assert deliver(msg, True) is None and read_detections(node)[1] == "lidar"
    del node.transforms.problem_by_source["TF"]
    assert "'odom'" in deliver(msg, True) and len(node.sent["detections"]) == 1
    node.transforms.on_tf(transforms(("odom", "lidar", np.eye(4), START - PERIOD)), static=False)
    assert "0.100 s older than needed" in deliver(msg, True)
    assert deliver(encode(make_robot_cloud(xyz, START - PERIOD)), True) is None
    assert len(node.sent["detections"]) == 2 and read_detections(node)[1] == "odom"
    node.transforms.on_tf(transforms(("odom", "lidar", np.eye(4), START + PERIOD)), static=False)
    assert deliver(msg, True) is None and read_detections(node)[1:] == ("odom", START)
    assert "odom" not in list_problems(node)
    deliver(encode(make_robot_cloud(xyz, START + 2 * PERIOD)), False)  # the waiting time has expired
    assert read_detections(node)[1] == "lidar" and "0.100 s older than needed" in list_problems(node)
    assert deliver(encode(make_robot_cloud(xyz, START + 20 * PERIOD)), True) is None  # odom has stopped


def test_tracks_of_tilted_sensor_are_in_the_cloud_frame(start_node, weights):
    """Tracks are in the cloud frame although detections are in the base frame."""
    scan, tilt = make_scan(), make_tilted_pose(-0.2, 0.3, 1.73)
    node = start_node(
        PointPillarsNode,
        **{**weights, "base_frame": "base", "target_frame": "base", "tracking.enabled": True, "tracking.report": 0.0},
    )
    node.transforms.on_tf(transforms(("base", "lidar", tilt, 0)), static=True)
    tilted_xyz = transform_points(scan.xyz.astype(np.float64), make_tilted_pose(-0.2, 0.3).T)
    for i in range(4):
        deliver_cloud(node, make_robot_cloud(tilted_xyz, START + i * PERIOD, scan.intensity))
    (found, base, _), (tracks, cloud, _) = read_detections(node), read_detections(node, "tracks")
    assert (base, cloud) == ("base", "lidar") and len(found) and len(tracks)
    centres = transform_points(tracks.boxes[:, :3].astype(np.float64), tilt)
    apart = np.linalg.norm(centres[:, None] - found.boxes[None, :, :3], axis=2).min(axis=1)
    assert np.median(apart) < 0.3
