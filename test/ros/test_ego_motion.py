"""Sensor poses in tracking nodes, compared with the library run on the true poses."""

from __future__ import annotations

import numpy as np
import pytest
from marker_messages import make_detection_markers

pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")

from rclpy.parameter import Parameter
from robot_messages import make_base_odometry, make_robot_cloud, make_walker, mount_pose, transforms
from tracking_samples import START, TENTH, make_crowd_detections, make_flat_pose

from lidar_perception.classes import CAR, CYCLIST, PEDESTRIAN
from lidar_perception.nodes import ego as ego_module
from lidar_perception.nodes import transforms as transforms_module
from lidar_perception.nodes.ego import ICP_MS
from lidar_perception.nodes.interfaces import MARKERS
from lidar_perception.nodes.perception import Perception
from lidar_perception.nodes.tracker import TrackerNode
from lidar_perception.robot.poses import invert_pose, transform_boxes
from lidar_perception.robot.transform_tree import MissingTransform
from lidar_perception.tracking.ego import has_odometry
from lidar_perception.tracking.tracker import Tracker
from lidar_perception.types import CLASSES, Detections
from lidar_perception.wire.codec import decode, encode, make_bag_message
from lidar_perception.wire.messages import to_class_ids
from msg_utils.markers import from_marker_array
from msg_utils.stamps import make_header

SENSOR = mount_pose(1.2, 0.3, 1.8, 0.6, 0.0, 0.0)  # on the base


def compute_base_pose(i):
    return make_flat_pose(0.8 * i, 0.05 * i, 0.02 * i)


def make_cloud_header(stamp, frame_id="lidar"):
    return make_header(stamp, frame_id, make_bag_message)


def read_tracks(node):
    return from_marker_array(decode(node.sent["tracks"][-1], MARKERS))


def drive_and_compare(node, tell, poses, frame_id="lidar"):
    """Send frames of a crowd, seen from poses (K, 4, 4), to a node and compare with the library. tell(i, stamp)
    is called before each frame.
    """
    library = Tracker()
    for i, (found, at) in enumerate(zip(make_crowd_detections(frames=len(poses)), poses)):
        stamp = START + i * TENTH
        tell(i, stamp)
        sensor_detections = Detections.of(transform_boxes(found.boxes, invert_pose(at)), found.class_ids, found.scores)
        node.on_markers(make_detection_markers(sensor_detections, make_cloud_header(stamp, frame_id), make_bag_message))
        tracks, published = library(sensor_detections, stamp, at), read_tracks(node)
        assert published.ids.tolist() == tracks.ids.tolist() == [1, 2, 3, 4, 5, 6]
        np.testing.assert_allclose(published.boxes, tracks.detections.boxes, atol=1e-4)
        np.testing.assert_allclose([extra["velocity"] for extra in published.extras], tracks.velocities, atol=2e-3)


@pytest.mark.parametrize("source", ["odometry", "tf", "auto"])
def test_odometry_is_transformed_to_the_sensor(start_node, source):
    """With odometry, TF gives the mount of the sensor; without it, the whole pose."""
    node = start_node(TrackerNode, **{"ego.source": source})
    node.transforms.on_tf(transforms(("base", "lidar", SENSOR, 0)), static=True)

    def tell(i, stamp):
        if source == "odometry":
            node.transforms.on_odometry(make_base_odometry(compute_base_pose(i), stamp))
        else:
            node.transforms.on_tf(transforms(("odom", "base", compute_base_pose(i), stamp)), static=False)

    drive_and_compare(node, tell, [compute_base_pose(i) @ SENSOR for i in range(20)])
    assert node.diagnostics.counts["ego"] == ("odometry" if source == "odometry" else "tf")
    assert node.diagnostics.state[1] == "tracking"


def test_detections_in_the_odometry_frame_are_not_moved(start_node):
    node = start_node(TrackerNode)
    drive_and_compare(
        node,
        lambda i, stamp: node.transforms.on_odometry(make_base_odometry(compute_base_pose(i), stamp)),
        np.tile(np.eye(4), (20, 1, 1)),
        "odom",
    )


def test_missing_odometry_to_sensor_transform_is_reported(start_node):
    node = start_node(TrackerNode)
    drive_and_compare(
        node,
        lambda i, stamp: node.transforms.on_odometry(make_base_odometry(compute_base_pose(i), stamp)),
        [compute_base_pose(i) for i in range(10)],
    )
    assert "odometry is for 'base', the detections are in 'lidar'" in node.diagnostics.state[1]
    node.transforms.on_tf(transforms(("base", "lidar", SENSOR, 0)), static=True)
    stamp = START + 10 * TENTH
    node.transforms.on_odometry(make_base_odometry(compute_base_pose(10), stamp))
    found = next(make_crowd_detections())
    node.on_markers(make_detection_markers(found, make_cloud_header(stamp), make_bag_message))
    assert min(read_tracks(node).ids) > 6  # the source of poses changed, so all tracks ended


def test_error_names_the_missing_transform(start_node):
    node = start_node(TrackerNode, **{"ego.source": "tf", "input.fixed_frame": "map"})
    node.on_markers(make_detection_markers(next(make_crowd_detections()), make_cloud_header(START), make_bag_message))
    assert "TF does not connect 'lidar' with 'map'" in node.diagnostics.state[1]


@pytest.mark.parametrize("better", ["odometry", "tf"])
def test_auto_falls_back_to_scans_and_returns_to_poses(start_node, better):
    if not has_odometry():
        pytest.skip("needs kiss-icp, the extra [odometry]")
    node = start_node(TrackerNode)
    found = node.inputs.receptions[0]
    xyz, _ = make_walker(mount_pose(0.0, 0.0, 1.7, 0.0, 0.0, 0.0))

    def frames(first, count):
        for i in range(first, first + count):
            if len(node.inputs.receptions) > node_inputs:
                give_to_points(make_robot_cloud(xyz, START + i * TENTH))
            found.deliver(
                encode(
                    make_detection_markers(
                        next(make_crowd_detections()), make_cloud_header(START + i * TENTH), make_bag_message
                    )
                ),
                False,
            )

    def give_to_points(cloud):
        points = next(r for r in node.inputs.receptions if r.topic.endswith("/points"))
        points.deliver(encode(cloud), False)

    node_inputs = len(node.inputs.receptions)
    frames(0, 10)
    assert node.diagnostics.counts["ego"] == "none" and len(node.inputs.receptions) == node_inputs
    frames(10, 4)
    assert node.diagnostics.counts["ego"] == "kiss_icp" and float(node.diagnostics.counts[ICP_MS]) > 0
    before = max(read_tracks(node).ids)
    for i in (13, 14, 15):
        stamp = START + i * TENTH
        if better == "odometry":
            node.transforms.on_odometry(make_base_odometry(compute_base_pose(i), stamp, "lidar"))
        else:
            node.transforms.on_tf(transforms(("odom", "lidar", compute_base_pose(i), stamp)), static=False)
    frames(14, 2)
    assert node.diagnostics.counts["ego"] == better and min(read_tracks(node).ids) > before
    assert ICP_MS not in node.diagnostics.counts  # scans are no longer registered


def test_detector_cloud_waits_for_its_pose_with_timeout(start_node):
    node = start_node(Perception, **{"tracking.enabled": True, "ego.max_wait": 100.0})
    deliver = node.inputs.receptions[0].deliver
    xyz, _ = make_walker(mount_pose(0.0, 0.0, 1.7, 0.0, 0.0, 0.0))
    clouds = [encode(make_robot_cloud(xyz, START + i * TENTH)) for i in range(20)]
    assert deliver(clouds[0], True) is None  # no pose yet
    node.transforms.on_odometry(make_base_odometry(compute_base_pose(0), START, "lidar"))
    assert deliver(clouds[1], True) == "the pose at its stamp"
    node.transforms.on_odometry(make_base_odometry(compute_base_pose(1), START + TENTH, "lidar"))
    assert deliver(clouds[1], True) is None and len(node.sent["tracks"]) == 2
    np.testing.assert_allclose(node.results.final.tracks.tracker.pose, compute_base_pose(1), atol=1e-9)
    assert deliver(clouds[2], True) == "the pose at its stamp"
    assert node.set_parameters([Parameter("ego.max_wait", value=0.0)])[0].successful
    assert deliver(clouds[2], True) is None  # the waiting time has expired
    assert deliver(clouds[19], True) is None  # the odometry has stopped
    assert len(node.sent["tracks"]) == 4


def test_empty_cloud_has_a_result_and_scan_poses_continue(start_node):
    if not has_odometry():
        pytest.skip("needs kiss-icp, the extra [odometry]")
    node = start_node(Perception, **{"tracking.enabled": True, "ego.source": "kiss_icp"})
    xyz, _ = make_walker(mount_pose(0.0, 0.0, 1.7, 0.0, 0.0, 0.0))
    for i in range(6):
        node.inputs.receptions[0].deliver(
            encode(make_robot_cloud(xyz[:0] if i == 3 else xyz, START + i * TENTH)), False
        )
        assert node.diagnostics.counts["frames"] == len(node.sent["tracks"]) == i + 1
    assert node.diagnostics.counts["ego"] == "kiss_icp" and node.results.final.tracks.ego.icp_restarts == 1


def test_late_poses_delay_frames_by_max_wait_once(start_node, monkeypatch):
    """A newer cloud replaces a waiting one."""
    node, now = start_node(TrackerNode), [100.0]
    monkeypatch.setattr(ego_module, "monotonic", lambda: now[0])
    ego, wait = node.tracks.ego, node.params.ego.max_wait
    ego.node.transforms.on_odometry(make_base_odometry(compute_base_pose(0), START, "lidar"))
    held = []
    for i in range(1, 9):  # up to half a second after the last pose, so the poses are late
        held.append(ego.find_missing_pose(make_cloud_header(START + i * TENTH // 2)) is not None)
        now[0] += 0.06
    assert held == [0.06 * i < wait for i in range(8)] and not all(held)
    now[0] = 100.0 + wait + ego_module.PAUSE_S + 0.01  # the node waits again
    assert ego.find_missing_pose(make_cloud_header(START + TENTH // 2)) is not None
    ego.node.transforms.on_odometry(make_base_odometry(compute_base_pose(1), START + TENTH, "lidar"))
    assert ego.find_missing_pose(make_cloud_header(START + TENTH)) is None and ego.late_since is None


def test_stopped_or_foreign_clock_odometry_is_reported(start_node, monkeypatch):
    node, now = start_node(TrackerNode), [100.0]
    for module in ego_module, transforms_module:
        monkeypatch.setattr(module, "monotonic", lambda: now[0])
    found = node.inputs.receptions[0]

    def report(seconds):
        stamp = make_cloud_header(START + round(seconds * 10 * TENTH))
        found.deliver(encode(make_detection_markers(next(make_crowd_detections()), stamp, make_bag_message)), False)
        return node.diagnostics.state[1]

    node.transforms.on_odometry(make_base_odometry(compute_base_pose(0), START + 1000 * 10 * TENTH, "lidar"))
    assert "1000 s ahead of the detections" in report(0) and "same clock" in node.diagnostics.state[1]
    node.transforms.on_odometry(make_base_odometry(compute_base_pose(0), START, "lidar"))
    now[0] += 5.0
    report(2)  # at first the tracker still publishes
    assert "no odometry on /tracker/input/odometry for 5 s" in report(2.1)


@pytest.mark.parametrize("source, lag", [("odometry", 3.0), ("tf", 0.7)])
def test_pose_source_that_is_always_late_is_reported(start_node, source, lag):
    """The lag is longer than ego.max_gap, but too short to indicate another clock."""
    node = start_node(TrackerNode, **{"ego.source": source})
    for i in range(15):
        stamp = START + i * TENTH
        past = stamp - round(lag * 10 * TENTH)
        if source == "odometry":
            node.transforms.on_odometry(make_base_odometry(compute_base_pose(i), past, "lidar"))
        else:
            node.transforms.on_tf(transforms(("odom", "lidar", compute_base_pose(i), past)), static=False)
        node.on_markers(
            make_detection_markers(next(make_crowd_detections()), make_cloud_header(stamp), make_bag_message)
        )
        assert f"{lag:.3f} s older than needed" in node.diagnostics.state[1]
    assert node.diagnostics.counts["ego"] == source


def test_first_of_two_odometry_publishers_is_used(start_node, monkeypatch):
    node, now = start_node(TrackerNode), [100.0]
    monkeypatch.setattr(transforms_module, "monotonic", lambda: now[0])

    def send_odometry(i, stamp):
        node.transforms.on_odometry(make_base_odometry(compute_base_pose(i), stamp, "lidar"))
        if i % 2:
            node.transforms.on_odometry(make_base_odometry(compute_base_pose(3 * i), stamp + 1, "lidar", "map"))

    drive_and_compare(node, send_odometry, [compute_base_pose(i) for i in range(8)])
    assert "of 'lidar' in 'map' are ignored" in node.transforms.problems()[0][2]
    now[0] += transforms_module.ODOMETRY_TIMEOUT_S + 1
    node.transforms.on_odometry(make_base_odometry(compute_base_pose(0), START + 10 * TENTH, "lidar", "map"))
    assert node.transforms.odometry_frame == "map" and not node.transforms.problems()


def test_odometry_without_child_frame_is_ignored(start_node):
    node = start_node(TrackerNode)
    drive_and_compare(
        node,
        lambda i, stamp: node.transforms.on_odometry(make_base_odometry(compute_base_pose(i), stamp, "")),
        [compute_base_pose(i) for i in range(10)],
    )
    assert "child_frame_id is empty" in node.diagnostics.state[1]
    with pytest.raises(MissingTransform, match="child_frame_id"):
        node.transforms.look_up_sensor_poses("odometry", "lidar", np.array([START]))


def test_scan_poses_are_converted_to_detection_frame(start_node):
    """A sensor that looks to the rear moves backwards; without a transform there is no pose."""
    if not has_odometry():
        pytest.skip("needs kiss-icp, the extra [odometry]")
    node = start_node(TrackerNode, **{"ego.source": "kiss_icp"})
    ego, rear = node.tracks.ego, mount_pose(-1.0, 0.2, 1.8, np.pi, 0.0, 0.0)
    xyz, _ = make_walker(SENSOR)
    for i in range(3):
        ego._on_cloud(make_robot_cloud(xyz, START + i * TENTH))
    assert ego.find_pose(make_cloud_header(START, "base")) is None
    assert "TF does not connect them" in ego.find_problem("base", START)
    node.transforms.on_tf(transforms(("base", "lidar", rear, 0)), static=True)
    np.testing.assert_allclose(
        ego.find_pose(make_cloud_header(START, "base")),
        ego.find_pose(make_cloud_header(START)) @ invert_pose(rear),
        atol=1e-6,
    )
    assert ego.find_problem("base", START) is None
    for late in (0, 1):  # repeated or late clouds do not change the map
        ego._on_cloud(make_robot_cloud(xyz, START + (2 - late) * TENTH))
    assert ego.icp_restarts == 1
    ego._on_cloud(make_robot_cloud(xyz, START + 10**11))  # a new map with another origin
    assert ego.icp_restarts == 2


def test_foreign_class_names_are_mapped_or_reported(start_node):
    found = next(make_crowd_detections())
    there = make_detection_markers(found, make_cloud_header(START), make_bag_message)
    for marker in there.markers:
        marker.ns = {"Pedestrian": "person", "Car": "car", "Cyclist": "BICYCLE"}.get(marker.ns, marker.ns)
    node = start_node(TrackerNode)
    node.on_markers(there)
    assert node.diagnostics.state[1] == "tracking"
    assert to_class_ids(["person", "CAR", "bicycle", "tree"]) == [PEDESTRIAN, CAR, CYCLIST, CLASSES.index("Misc")]
    there.markers[-1].ns = "sofa"
    node.on_markers(there)
    assert "sofa" in node.diagnostics.state[1] and "Pedestrian" in node.diagnostics.state[1]
