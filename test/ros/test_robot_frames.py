"""Frames and motion in the nodes, each in this process: tilted sensors, results and clicks in other
frames, clouds that are moved to their stamp."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")

from detection_samples import eager, frame, lively, tiny
from rclpy.parameter import Parameter
from robot_bags import tf, transform
from samples import WALKER
from samples import scene as walker_scene
from scipy.spatial.transform import Rotation

from lidar_perception.detectors.checkpoint import Header, save_checkpoint
from lidar_perception.detectors.pointpillars.params import DetectorParams
from lidar_perception.nodes.ground_segmentation import GroundSegmentation
from lidar_perception.nodes.perception import Perception
from lidar_perception.nodes.pointpillars_detector import PointPillarsNode
from lidar_perception.nodes.transforms import NO_TF
from lidar_perception.param_fields import flatten, with_values
from lidar_perception.robot.deskew import skewed, steady
from lidar_perception.robot.placing import tilted
from lidar_perception.robot.poses import inverse, moved_points
from lidar_perception.wire.codec import bag_message, decode, encode
from lidar_perception.wire.messages import column, to_detections, to_frame
from msg_utils.markers import from_marker_array
from msg_utils.point_cloud2 import from_array, to_array
from msg_utils.stamps import header_message, time_message

START = 1_700_000_000 * 10**9
PERIOD = 10**8
pytestmark = pytest.mark.usefixtures("one_thread")


def give(node, msg):
    """The cloud as it comes from the middleware."""
    node._receptions()[0].deliver(encode(msg), False)


def message(xyz, stamp=START, intensity=None, frame_id="lidar", **columns):
    kinds = [*((n, "<f4") for n in ("x", "y", "z", "intensity")),
             *((k, v.dtype.str) for k, v in columns.items())]
    points = np.zeros(len(xyz), kinds)
    points["x"], points["y"], points["z"] = np.asarray(xyz, np.float32).T
    points["intensity"] = 0.3 if intensity is None else intensity
    for name, values in columns.items():
        points[name] = values
    return from_array(points, header_message(stamp, frame_id, bag_message), bag_message)


def transforms(*rows):
    """tf2_msgs/TFMessage of rows of parent, child, pose (4, 4), stamp."""
    return tf(*(transform(parent, child, stamp, pose) for parent, child, pose, stamp in rows))


def odometry(pose, stamp, child="base", frame="odom"):
    t, q = pose[:3, 3].tolist(), Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
    found = bag_message("nav_msgs/msg/Odometry", child_frame_id=child,
                        header=header_message(stamp, frame, bag_message))
    for name, value in zip("xyz", t):
        setattr(found.pose.pose.position, name, value)
    for name, value in zip("xyzw", q):
        setattr(found.pose.pose.orientation, name, value)
    return found


def boxes_of(node, topic="detections"):
    objects = from_marker_array(decode(node.sent[topic][-1], "visualization_msgs/msg/MarkerArray"))
    return to_detections(objects), objects.frame_id, objects.stamp_ns


def mounted(x, y, height, yaw, pitch, roll):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    pose[:3, 3] = x, y, height
    return pose


TILTS = {"nods": (0.4, 0.1, 1.9, 0.0, 0.35, 0.0), "leans": (-0.2, 0.5, 1.2, 0.3, 0.0, -0.3),
         "upside down": (0.0, 0.0, 2.2, -0.4, 0.1, np.pi - 0.05)}
WALKING = {"seed.source": "click", "clustering.dbscan.eps": (0.5, 0.5, 0.5)}


def problems(node):
    return " ".join(p[2] for p in node._problems())


def walker(base):
    """The scene of samples.py on a floor at z = 0 of the base, as a sensor mounted there sees it;
    and where its person is in the base."""
    on_floor = walker_scene()[:, :3].astype(np.float64) + [0, 0, 1.7]
    return moved_points(on_floor, inverse(base)), WALKER[:3] + [0, 0, 1.7]


@pytest.mark.parametrize("tilt", TILTS)
def test_candidates_of_a_tilted_sensor_are_those_of_a_level_one(start, tilt):
    """In the base's frame, from a click in yet another, without a number entered by hand."""
    found = []
    x, y, height, yaw, *_ = TILTS[tilt]
    for base in (mounted(x, y, height, yaw, 0.0, 0.0), mounted(*TILTS[tilt])):
        node = start(Perception, base_frame="base", target_frame="base", **WALKING)
        camera = mounted(1.0, 0.0, 0.5, 1.0, 0.2, 0.1)
        node.transforms.on_tf(transforms(("base", "lidar", base, 0), ("base", "eye", camera, 0)),
                              static=True)
        xyz, person = walker(base)
        at = moved_points(person[None], inverse(camera))[0].tolist()
        node.seed._on_click(bag_message(
            "geometry_msgs/msg/PointStamped", header=header_message(START, "eye", bag_message),
            point=bag_message("geometry_msgs/msg/Point", **dict(zip("xyz", at)))))
        give(node, message(xyz))
        detections, frame_id, stamp = boxes_of(node)
        assert (frame_id, stamp, len(detections)) == ("base", START, 1)
        assert np.linalg.norm(detections.boxes[0, :2] - person[:2]) < 0.3
        found.append(detections.boxes[0])
        assert "base" not in problems(node)
    level, tilted_one = found
    np.testing.assert_allclose(tilted_one[:6], level[:6], atol=0.05)


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "v4.safetensors"
    save_checkpoint(path, lively(tiny("v4")), Header(tiny("v4")))
    params = with_values(eager(), {"pointpillars.weights": str(path), "pointpillars.threads": 1})
    defaults = flatten(DetectorParams())
    return {k: v for k, v in flatten(params).items() if v != defaults[k]}


def test_a_network_sees_a_tilted_sensors_cloud_as_a_level_ones(start, weights):
    """Boxes in the base equal those of a level sensor at the same place and heading, and the same
    boxes by parameters entered by hand; without a target they are in the cloud's frame."""
    scan = frame()
    place = mounted(0.7, -0.3, 1.73, 0.2, 0.0, 0.0)
    tilt = tilted(-0.2, 0.3)
    seen = moved_points(scan.xyz.astype(np.float64), inverse(tilt))
    level = start(PointPillarsNode, target_frame="base", **weights)
    level.transforms.on_tf(transforms(("base", "lidar", place, 0)), static=True)
    give(level, message(scan.xyz, intensity=scan.intensity))
    expected, frame_id, _ = boxes_of(level)
    assert frame_id == "base" and len(expected) > 5
    for values, name in (({"target_frame": "base"}, "base"), ({}, "lidar")):
        node = start(PointPillarsNode, base_frame="base", **values, **weights)
        node.transforms.on_tf(transforms(("base", "lidar", place @ tilt, 0)), static=True)
        give(node, message(seen, intensity=scan.intensity))
        detections, frame_id, _ = boxes_of(node)
        assert frame_id == name and len(detections) == len(expected)
        boxes = detections.boxes.astype(np.float64)
        if name == "lidar":
            boxes[:, :3] = moved_points(boxes[:, :3], place @ tilt)
            by_hand = start(PointPillarsNode, **{
                **weights, "ground.sensor_pose.roll": -0.2, "ground.sensor_pose.pitch": 0.3})
            give(by_hand, message(seen, intensity=scan.intensity))
            hand, _, _ = boxes_of(by_hand)
            assert len(hand) == len(detections)
            np.testing.assert_allclose(np.sort(hand.boxes, axis=0),
                                       np.sort(detections.boxes, axis=0), atol=2e-2)
        order, other = (np.lexsort(b[:, 1::-1].round(1).T) for b in (boxes, expected.boxes))
        np.testing.assert_allclose(boxes[order][:, :6], expected.boxes[other][:, :6], atol=2e-2)
        if name == "base":
            turned = boxes[order][:, 6] - expected.boxes[other][:, 6]
            np.testing.assert_allclose(np.sin(turned), 0, atol=1e-2)


@pytest.mark.parametrize("by", ["hand", "TF", "nothing"])
def test_the_detectors_look_ahead_wherever_x_of_the_clouds_looks(start, weights, by):
    """Boxes of a sensor that is turned, and leans, are those of one that is not, in its frame; and
    what is behind is cropped there, too."""
    scan, ahead = frame(), 150.0
    weights = {**weights, "crop.sectors": [100.0, 260.0]}
    plain = start(PointPillarsNode, **weights)
    give(plain, message(scan.xyz, intensity=scan.intensity))
    expected, _, _ = boxes_of(plain)
    tilt = np.eye(4) if by == "nothing" else tilted(-0.2, 0.3)
    level = inverse(mounted(0, 0, 0, np.radians(ahead), 0, 0)) @ tilt
    seen = moved_points(scan.xyz.astype(np.float64), inverse(level))
    leans = {"hand": {"ground.sensor_pose.roll": -0.2, "ground.sensor_pose.pitch": 0.3},
             "TF": {"base_frame": "base"}, "nothing": {}}[by]
    node = start(PointPillarsNode, **{**weights, **leans, "input.ahead": ahead})
    if by == "TF":
        place = mounted(0.7, -0.3, 1.73, 1.0, 0.0, 0.0)  # where it looks in the base matters not
        node.transforms.on_tf(transforms(("base", "lidar", place @ tilt, 0)), static=True)
    give(node, message(seen, intensity=scan.intensity))
    found, frame_id, _ = boxes_of(node)
    assert frame_id == "lidar" and len(found) == len(expected) > 5
    assert node.counts["cropped"] == plain.counts["cropped"]
    back = found.boxes.astype(np.float64)
    back[:, :3] = moved_points(back[:, :3], level)
    order, other = (np.lexsort(b[:, 1::-1].round(1).T) for b in (back, expected.boxes))
    np.testing.assert_allclose(back[order][:, :6], expected.boxes[other][:, :6], atol=2e-2)
    if by == "nothing":
        turned = back[order][:, 6] - expected.boxes[other][:, 6] - np.radians(ahead)
        np.testing.assert_allclose(np.sin(turned), 0, atol=1e-2)


def test_a_click_and_candidates_are_where_they_are_in_a_turned_cloud(start):
    turn = mounted(0, 0, 0, np.radians(-100), 0, 0)
    node = start(Perception, **WALKING, **{"input.ahead": -100.0})
    xyz, person = moved_points(walker_scene()[:, :3].astype(np.float64), turn), WALKER[:3]
    at = moved_points(np.array(person, np.float64)[None], turn)[0]
    node.seed._on_click(bag_message(
        "geometry_msgs/msg/PointStamped", header=header_message(START, "lidar", bag_message),
        point=bag_message("geometry_msgs/msg/Point", **dict(zip("xyz", at.tolist())))))
    give(node, message(xyz))
    detections, frame_id, _ = boxes_of(node)
    assert frame_id == "lidar" and len(detections) == 1
    assert np.linalg.norm(detections.boxes[0, :2] - at[:2]) < 0.3


def test_without_the_frames_the_parameters_stand_and_the_names_are_said(start):
    """Columns and boxes are bit for bit those of a node that asks for no frame."""
    xyz, _ = walker(mounted(0.0, 0.0, 1.7, 0.0, 0.0, 0.0))
    plain = start(Perception)
    asks = start(Perception, base_frame="base_footprint", target_frame="odom")
    for node in plain, asks:
        give(node, message(xyz))
    assert asks.sent["detections"] == plain.sent["detections"]
    said = problems(asks)
    for words in ("base_frame 'base_footprint'", "'lidar' is not in TF", "sensor_pose stands",
                  "target_frame 'odom'", "results are in 'lidar'"):
        assert words in said
    assert "frame" not in problems(plain)
    asks.transforms.on_tf(transforms(
        ("odom", "base_footprint", np.eye(4), START),
        ("base_footprint", "lidar", mounted(0, 0, -1.0, 0, 0, 0), START)), static=True)
    give(asks, message(xyz, START + 1))
    assert "-1.00 m above 'base_footprint', which is to be on the ground" in problems(asks)
    assert "odom" not in problems(asks)


def test_the_body_is_cropped_only_where_the_frame_that_it_is_given_in_is_known(start):
    """Else it could be a person; and a body under the floor is said to be in another frame."""
    node = start(GroundSegmentation, base_frame="base", **{
        "crop.body": [-0.5, -0.4, 0.2, 0.5, 0.4, 1.0]})
    floor = np.random.default_rng(0).uniform(-20, 20, (2000, 3)) * [1, 1, 0]
    sensor = mounted(0.5, 0.0, 1.2, 0.0, 0.0, 0.0)  # the base's origin is behind it
    seen = moved_points(np.vstack([floor, [[0.3, 0.0, 0.8]], [[0.9, 0.0, 0.8]]]), inverse(sensor))
    give(node, message(seen))
    assert not node.counts["cropped"] and "crop.body is not left out" in problems(node)
    node.transforms.on_tf(transforms(("base", "lidar", sensor, START)), static=True)
    give(node, message(seen, START + 1))
    assert node.counts["cropped"] == 1 and "crop.body" not in problems(node)
    low = start(GroundSegmentation, base_frame="base", **{
        "crop.body": [-0.5, -0.4, -1.0, 0.5, 0.4, -0.2]})
    low.transforms = node.transforms.__class__(low)
    low.transforms.on_tf(transforms(("base", "lidar", sensor, START)), static=True)
    give(low, message(seen))
    assert "crop.body ends 0.20 m below the ground of 'base'" in problems(low)


def test_where_tf_does_not_connect_the_odometry_what_moves_is_listened_to(start):
    node = start(GroundSegmentation, **{"input.deskew": "odometry"})
    for stamp in (START, START + PERIOD):
        node.transforms.on_odometry(odometry(np.eye(4), stamp, "base"))
    assert not node.transforms._listening
    give(node, message(np.ones((50, 3)), t=np.arange(50, dtype="<u4") * 10**6))
    assert node.transforms._listening and "'lidar' is not in TF" in problems(node)


def test_a_template_that_cannot_be_read_costs_the_candidates_alone(start):
    node = start(Perception, **{"seed.source": "file"})
    assert node.set_parameters([Parameter("seed.file", value="/nowhere.npz")])[0].successful
    give(node, message(walker_scene()[:, :3]))
    assert len(boxes_of(node)[0]) == 0 and "/nowhere.npz" in node.state[1]


def test_a_cloud_waits_for_a_transform_that_is_late_or_that_never_came(start):
    """Not for one that has stopped; nor where TF cannot be listened to."""
    xyz, _ = walker(mounted(0.0, 0.0, 1.7, 0.0, 0.0, 0.0))
    node = start(Perception, target_frame="odom")
    deliver, msg = node._receptions()[0].deliver, encode(message(xyz))
    node.transforms.lacking["TF"] = NO_TF
    assert deliver(msg, True) is None and boxes_of(node)[1] == "lidar"
    del node.transforms.lacking["TF"]
    assert "'odom'" in deliver(msg, True) and len(node.sent["detections"]) == 1
    node.transforms.on_tf(transforms(("odom", "lidar", np.eye(4), START - PERIOD)), static=False)
    assert "0.100 s older than needed" in deliver(msg, True)
    assert deliver(encode(message(xyz, START - PERIOD)), True) is None
    assert len(node.sent["detections"]) == 2 and boxes_of(node)[1] == "odom"
    node.transforms.on_tf(transforms(("odom", "lidar", np.eye(4), START + PERIOD)), static=False)
    assert deliver(msg, True) is None and boxes_of(node)[1:] == ("odom", START)
    assert "odom" not in problems(node)
    deliver(encode(message(xyz, START + 2 * PERIOD)), False)  # it has waited for long enough
    assert boxes_of(node)[1] == "lidar" and "0.100 s older than needed" in problems(node)
    assert deliver(encode(message(xyz, START + 20 * PERIOD)), True) is None  # odom has stopped


def drive(at_ns):
    """The base's pose in odom: 15 m/s on a left turn."""
    return steady([15.0, 0.0, 0.0], [0.0, 0.0, 0.5])(np.array([(at_ns - START) * 1e-9]))[0]


@pytest.mark.parametrize("source", ["odometry", "tf"])
def test_a_cloud_of_a_moving_sensor_is_moved_to_its_stamp(start, source):
    """Later nodes get the moved points, all at the stamp; the robot's own body stays where it is;
    without odometry the cloud is used as it is, and this is said."""
    rng = np.random.default_rng(0)
    sensor = mounted(1.2, 0.1, 1.8, 0.5, 0.0, 0.0)
    still = np.vstack([rng.uniform(-30, 30, (3000, 3)) * [1, 1, 0.001] - [0, 0, 1.8],
                       rng.uniform(-0.5, 0.5, (50, 3)) + [-1.0, 0, -0.6]]).astype(np.float32)
    body = np.arange(3000, 3050)
    seconds = rng.uniform(0.0, 0.1, len(still))

    def poses(at):
        return np.array([drive(START + round(s * 1e9)) @ sensor for s in at])
    raw = skewed(still, seconds, poses)
    raw[body] = still[body]
    node = start(GroundSegmentation, **{
        "input.deskew": source, "base_frame": "base",
        "crop.body": [-1.5, -1.5, 0.2, 2.0, 1.5, 2.5]})
    node.transforms.on_tf(transforms(("base", "lidar", sensor, 0)), static=True)
    msg = message(raw, t=np.rint(seconds * 1e9).astype("<u4"))

    give(node, msg)
    as_it_is = decode(node.sent["points"][-1], "sensor_msgs/msg/PointCloud2")
    np.testing.assert_array_equal(to_array(as_it_is)["x"], raw[:, 0])
    assert node.counts["not_deskewed"] == 1
    assert "clouds are used as they are" in problems(node)

    for i in range(-5, 16):
        stamp = START + i * PERIOD // 10
        if source == "tf":
            node.transforms.on_tf(transforms(("odom", "base", drive(stamp), stamp)), static=False)
        else:
            node.transforms.on_odometry(odometry(drive(stamp), stamp))
    give(node, msg)
    assert "deskew" not in problems(node) and node.counts["deskewed"] == 1
    after = decode(node.sent["points"][-1], "sensor_msgs/msg/PointCloud2")
    moved = np.column_stack([to_array(after)[n] for n in "xyz"])
    others = np.setdiff1d(np.arange(len(still)), body)
    wrong = np.linalg.norm(raw - still, axis=1)[others]
    np.testing.assert_allclose(moved[others], still[others], atol=5e-3)
    assert np.median(wrong) > 0.5
    np.testing.assert_array_equal(moved[body], still[body])
    assert not column(after, "in_view", body).any() and not to_array(after)["t"].any()
    frame_, _ = to_frame(after)
    again = start(GroundSegmentation, **{"input.deskew": source})
    again.transforms = node.transforms
    give(again, after)
    np.testing.assert_array_equal(  # moved once
        to_array(decode(again.sent["points"][-1], "sensor_msgs/msg/PointCloud2"))["x"],
        moved[:, 0])
    give(node, message(raw, START + PERIOD))
    assert "no column of times" in problems(node) and len(node.sent["points"]) == 3
    assert time_message(START, bag_message).sec == after.header.stamp.sec and len(frame_)


def test_the_first_cloud_waits_for_odometry_that_lags_behind_the_end_of_its_turn(start):
    rng = np.random.default_rng(0)
    xyz = (rng.uniform(-30, 30, (2000, 3)) * [1, 1, 0.001] - [0, 0, 1.8]).astype(np.float32)
    msg = message(xyz, t=np.linspace(0, 1e8, len(xyz)).astype("<u4"))
    node = start(GroundSegmentation, **{"input.deskew": "odometry"})
    deliver = node._receptions()[0].deliver
    for i in range(-2, 9):
        node.transforms.on_odometry(odometry(np.eye(4), START + i * PERIOD // 10, "lidar"))
    needed = deliver(encode(msg), True)
    assert "/ground_segmentation/input/odometry" in needed and "0.020 s older" in needed
    assert "'lidar'" in needed and "child_frame_id" not in needed
    assert node.counts["frames"] == 0
    for i in (9, 10):
        node.transforms.on_odometry(odometry(np.eye(4), START + i * PERIOD // 10, "lidar"))
    assert deliver(encode(msg), True) is None
    assert node.counts["deskewed"] == 1 and "not_deskewed" not in node.counts


@pytest.mark.parametrize("first, begin, sectors", [(0.3, 0.0, ()), (1.0, -1.0, (120.0, 240.0))])
def test_later_clouds_wait_for_the_end_of_their_turn_whatever_the_first_one_was(start, first, begin,
                                                                                sectors):
    """A part of a turn, where the driver starts in the middle of one; or one that is stamped at its
    end, near which points are cropped. The odometry comes every 0.02 s."""
    node = start(GroundSegmentation, **{"input.deskew": "odometry", "crop.sectors": sectors})
    deliver = node._receptions()[0].deliver
    heard = iter(range(START, START + 20 * PERIOD, PERIOD // 5))

    def hear():
        stamp = next(heard)
        node.transforms.on_odometry(odometry(np.eye(4), stamp, "lidar"))
        return stamp
    known = hear()
    for i in range(1, 8):
        share = np.linspace(0, 1, 400)[:round(400 * (first if i == 1 else 1.0))]
        angle, seconds = np.pi - 2 * np.pi * share, 0.0999 * (begin + share)
        xyz = np.column_stack([20 * np.cos(angle), 20 * np.sin(angle), np.full(len(angle), -1.7)])
        stamp = START + i * PERIOD + PERIOD // 10
        while known < stamp + 1e9 * seconds[-1] - PERIOD // 5:
            known = hear()
        while deliver(encode(message(xyz, stamp, time=seconds.astype("<f4"))), True):
            known = hear()
    assert node.counts["deskewed"] == 7 - (first < 1.0)  # the second cannot know


def test_tracks_of_a_tilted_sensor_stay_in_the_clouds_frame(start, weights):
    """Where its detections are in the base, its tracks are in the cloud."""
    scan, tilt = frame(), tilted(-0.2, 0.3, 1.73)
    node = start(PointPillarsNode, **{**weights, "base_frame": "base", "target_frame": "base",
                                      "tracking.enabled": True, "tracking.report": 0.0})
    node.transforms.on_tf(transforms(("base", "lidar", tilt, 0)), static=True)
    seen = moved_points(scan.xyz.astype(np.float64), tilted(-0.2, 0.3).T)
    for i in range(4):
        give(node, message(seen, START + i * PERIOD, scan.intensity))
    (found, base, _), (tracks, cloud, _) = boxes_of(node), boxes_of(node, "tracks")
    assert (base, cloud) == ("base", "lidar") and len(found) and len(tracks)
    centres = moved_points(tracks.boxes[:, :3].astype(np.float64), tilt)
    apart = np.linalg.norm(centres[:, None] - found.boxes[None, :, :3], axis=2).min(axis=1)
    assert np.median(apart) < 0.3
