"""Conversion of messages, with the message classes of rosbags and of ROS."""

from __future__ import annotations

import numpy as np
import pytest
from marker_messages import make_detection_markers
from samples import CALIBRATION, each_make, make_any_header

from lidar_perception.camera import Calibration, Camera
from lidar_perception.classes import CAR, CLASSES, PEDESTRIAN
from lidar_perception.intensity import find_scale_problem
from lidar_perception.types import Detections, InputError
from lidar_perception.wire.codec import decode, encode, make_bag_message
from lidar_perception.wire.messages import (
    make_camera_info,
    make_extrinsics,
    make_pose_covariances,
    read_calibration,
    read_column,
    to_point_cloud,
)
from lidar_perception.wire.topics import CAMERA_FRAME
from msg_utils.messages import load_message_class, make_ros_message
from msg_utils.point_cloud2 import from_array


@each_make
def test_extrinsics_are_accepted_in_either_direction(make):
    info = make_camera_info(CALIBRATION, make_any_header(make, frame_id=CAMERA_FRAME), make)
    forth = make_extrinsics(CALIBRATION, make_any_header(make), make)
    back = make_extrinsics(CALIBRATION, make_any_header(make, frame_id=CAMERA_FRAME), make)
    back.child_frame_id = "velodyne"
    inverse = np.linalg.inv(CALIBRATION.lidar_to_camera)
    inverse_pose = Calibration(CALIBRATION.intrinsics, inverse, 1, 1).pose
    q, t = back.transform.rotation, back.transform.translation
    (q.x, q.y, q.z, q.w), (t.x, t.y, t.z) = (map(float, v) for v in inverse_pose)
    expected = CALIBRATION.intrinsics @ CALIBRATION.lidar_to_camera
    for transform in (forth, back):
        camera = read_calibration(info, transform).camera()
        np.testing.assert_allclose(camera.projection, expected, atol=1e-9)
        assert (camera.width, camera.height) == (1242, 375)


@each_make
@pytest.mark.parametrize(
    "change, words",
    [
        (
            lambda info, tf: setattr(info.header, "frame_id", "rear"),
            "'rear', but the transform connects 'velodyne' and 'camera_optical'",
        ),
        (lambda info, tf: setattr(info, "width", 0), "no image size"),
        (lambda info, tf: setattr(info, "p", np.zeros(12)), "no projection matrix"),
        (lambda info, tf: setattr(tf.transform.rotation, "w", 5.0), "not normalized"),
        (lambda info, tf: setattr(tf.transform.rotation, "w", float("nan")), "not normalized"),
        (lambda info, tf: setattr(tf.transform.translation, "y", float("nan")), "not finite"),
        (lambda info, tf: setattr(info, "p", np.full(12, np.nan)), "not finite"),
        (lambda info, tf: setattr(info, "p", np.r_[info.p[:11], np.inf]), "not finite"),
        (lambda info, tf: setattr(info, "width", 2**32 - 1), "image size 4294967295 x 375 is out of range"),
    ],
)
def test_unusable_camera_raises_input_error(make, change, words):
    info = make_camera_info(CALIBRATION, make_any_header(make, frame_id=CAMERA_FRAME), make)
    transform = make_extrinsics(CALIBRATION, make_any_header(make), make)
    change(info, transform)
    with pytest.raises(InputError, match=words):
        read_calibration(info, transform).camera()


def test_pose_covariances_of_detections_depend_on_the_class():
    square = make_pose_covariances(np.array([CAR, PEDESTRIAN, CLASSES.index("Misc")]))
    assert square.shape == (3, 6, 6) and not square[2].any()  # zero is unknown
    np.testing.assert_array_equal(square, square * np.eye(6))
    assert (square[:2, [0, 1, 2, 5], [0, 1, 2, 5]] > 0).all() and not square[:, [3, 4], [3, 4]].any()
    assert square[1, 5, 5] == pytest.approx(np.pi**2 / 3)  # the heading of people is not measured
    assert make_pose_covariances(np.zeros(0, np.int32)).shape == (0, 6, 6)


def test_point_is_in_view_if_it_projects_into_the_image():
    camera = Camera(np.array([[10.0, 0, 50, 0], [0, 10, 20, 0], [0, 0, 1, 0]]), 100, 40)
    points = np.array(
        [[0, 0, 1], [0, 0, -1], [-5.01, 0, 1], [4.99, 0, 1], [5.01, 0, 1], [0, 1.99, 1], [0, 2.01, 1], [0, -2.01, 1]],
        np.float32,
    )
    assert camera.in_view(points).tolist() == [True, False, False, True, False, True, False, False]


MESSAGES = {
    "cloud": lambda make: from_array(
        np.arange(24, dtype="<f4").view([("x", "<f4"), ("", "V4"), ("y", "<f4"), ("z", "<f4")])[["x", "y", "z"]],
        make_any_header(make),
        make,
        height=2,
    ),
    "no points": lambda make: from_array(np.zeros(0, [("x", "<f4")]), make_any_header(make), make),
    "markers": lambda make: make_detection_markers(
        Detections.of([[1, 2, 3, 4, 5, 6, 0.5]] * 2, [3, 0], [0.25, 1]), make_any_header(make), make, {("Car", 9)}
    ),
    "camera": lambda make: make_camera_info(CALIBRATION, make_any_header(make), make),
    "transform": lambda make: make_extrinsics(CALIBRATION, make_any_header(make), make),
}


@pytest.mark.parametrize("build", MESSAGES.values(), ids=MESSAGES)
def test_messages_of_ros_and_rosbags_are_interchangeable(build):
    serialization = pytest.importorskip("rclpy.serialization", reason="needs rclpy")
    ours, theirs = build(make_bag_message), build(make_ros_message)
    name = ours.__msgtype__
    raw = serialization.serialize_message(theirs)
    as_ros = load_message_class(name)
    assert serialization.deserialize_message(encode(ours), as_ros) == serialization.deserialize_message(raw, as_ros)
    assert encode(decode(raw, name)) == encode(ours)


@pytest.mark.parametrize(
    "name",
    [
        "sensor_msgs/msg/PointCloud2",
        "geometry_msgs/msg/Pose",
        "sensor_msgs/msg/CameraInfo",
        "visualization_msgs/msg/Marker",
        "diagnostic_msgs/msg/DiagnosticArray",
    ],
)
def test_message_fields_default_to_zero_as_in_ros(name):
    serialization = pytest.importorskip("rclpy.serialization", reason="needs rclpy")
    theirs = make_ros_message(name)
    if name.endswith(("Pose", "Marker")):  # ROS initialises the unit quaternion
        pose = theirs if name.endswith("Pose") else theirs.pose
        pose.orientation.w = 0.0
    result = serialization.deserialize_message(encode(make_bag_message(name)), load_message_class(name))
    assert result == theirs


def test_unknown_field_raises_type_error():
    with pytest.raises(TypeError, match="has no field 'colour'"):
        make_bag_message("visualization_msgs/msg/Marker", colour=1)


def test_truncated_message_raises_input_error():
    raw = encode(MESSAGES["markers"](make_bag_message))
    for size in range(0, len(raw), 7):
        with pytest.raises(InputError, match=f"^{size} bytes are not a valid visualization_msgs"):
            decode(raw[:size], "visualization_msgs/msg/MarkerArray")


@each_make
@pytest.mark.parametrize("name", ["in_view", "ground", "cluster_id"])
def test_field_with_several_numbers_per_point_is_rejected(make, name):
    kind = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), (name, "<u4", 2)]
    msg = from_array(np.ones(3, kind), make_any_header(make), make)
    with pytest.raises(InputError, match=f"'{name}' has count > 1"):
        read_column(msg, name, to_point_cloud(msg)[1])


@pytest.mark.parametrize("kind, full", [("<f4", 1), ("<f4", 255), ("<f8", 65535), ("u1", 255), ("<u2", 65535)])
def test_intensities_of_every_driver_are_scaled_to_1(kind, full):
    expected = np.random.default_rng(0).uniform(0, 1, 3000) ** 3
    expected[0] = 1.0
    points = np.ones(len(expected), [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", kind)])
    points["intensity"] = np.round(expected * full) if full > 1 else expected
    read = to_point_cloud(from_array(points, make_any_header(make_bag_message), make_bag_message), 0.0)[0]
    np.testing.assert_allclose(read.intensity, expected, atol=0.5 / 255)
    assert read.intensity.dtype == np.float32 and find_scale_problem(read.intensity) is None
    if np.dtype(kind).kind == "f":
        points["intensity"][1:4] = np.nan, np.inf, -np.inf
        invalid_intensity = to_point_cloud(
            from_array(points, make_any_header(make_bag_message), make_bag_message), 0.0
        )[0].intensity
        assert not invalid_intensity[1:4].any() and np.array_equal(invalid_intensity[4:], read.intensity[4:])
    points["intensity"] = points["intensity"] * 0.02  # an unusual scale
    dark = to_point_cloud(from_array(points, make_any_header(make_bag_message), make_bag_message), float(full))[0]
    assert "input.intensity_max" in find_scale_problem(dark.intensity)
    assert "input.intensity_max" in find_scale_problem(read.intensity * 2)
    assert find_scale_problem(dark.intensity[:100]) is None
