"""Clouds of a tilted sensor are transformed to a level frame, as by a node with the sensor's parameter file."""

import numpy as np
import pytest
from cli_samples import read_error_line, run_main
from robot_bags import (
    CLOUDS,
    ON_BASE,
    compute_base_pose,
    list_stamps,
    make_mount_rows,
    make_odometry_rows,
    make_point_cloud,
    make_tf_rows,
    write_robot_bag,
)
from samples import make_walker_label, write_object_folder
from scipy.spatial.transform import Rotation

from lidar_perception.camera import Calibration
from lidar_perception.data.frame import Frame, PointTruth
from lidar_perception.data.open import open_recording
from lidar_perception.data.to_bag import write_bag
from lidar_perception.robot.poses import invert_pose, make_pose
from lidar_perception.testing.clouds import make_cloud_message
from lidar_perception.types import GroundTruth, PointCloud
from lidar_perception.wire.messages import to_point_cloud
from lidar_perception.wire.topics import ODOMETRY

ROLL, PITCH, AHEAD = 3.0, -8.0, 130.0  # degrees
# Rotation from the sensor's axes to level ones with x ahead
UPRIGHT = Rotation.from_euler("z", -AHEAD, degrees=True) * Rotation.from_euler("xy", [ROLL, PITCH], degrees=True)
BODY = np.array([[-0.3, 0.2, -0.4], [0.1, 0.0, 0.5]])
MOUNT = f"""/**:
  ros__parameters:
    input: {{ahead: {AHEAD}}}
    crop: {{body: [-0.5, -0.5, -0.5, 0.5, 0.5, 0.6]}}
    ground:
      sensor_pose: {{height: 0.9, roll: {np.radians(ROLL)}, pitch: {np.radians(PITCH)}}}
"""
LEVEL = np.random.default_rng(0).uniform([-20, -20, -0.9], [20, 20, 2], (500, 3))
LEVEL = LEVEL[np.linalg.norm(LEVEL, axis=1) > 1]
PERSON = np.array([9.0, 2.0, -0.05, 0.5, 0.6, 1.7, 0.7])
CAMERA = Calibration(
    np.array([[700.0, 0, 600, 0], [0, 700, 180, 0], [0, 0, 1, 0]]),
    np.array([[0.0, -1, 0, 0], [0, 0, -1, -0.1], [1, 0, 0, -0.3], [0, 0, 0, 1]]),
    1242,
    375,
)


def compute_level_pose(i):
    """Return the pose of a level sensor in frame i."""
    return make_pose([2.0 * i, 0.1 * i, 0.9], Rotation.from_euler("z", 0.1 * i).as_quat())


def make_tilted_frames():
    """Yield frames of the tilted sensor. Their first points are on the robot itself."""
    rotation = np.eye(4)
    rotation[:3, :3] = UPRIGHT.as_matrix()
    xyz = np.vstack([BODY, UPRIGHT.inv().apply(LEVEL)])
    box = np.concatenate([UPRIGHT.inv().apply(PERSON[:3]), PERSON[3:6], [PERSON[6] + np.radians(AHEAD)]])
    camera = Calibration(CAMERA.intrinsics, CAMERA.lidar_to_camera @ rotation, CAMERA.width, CAMERA.height)
    numbers = np.arange(len(xyz), dtype=np.uint16)
    for i in range(3):
        yield Frame.of(
            str(i),
            PointCloud.of(xyz, np.linspace(0, 1, len(xyz), dtype=np.float32), (i + 1) * 10**8, "front"),
            GroundTruth.of(box, [3]),
            camera,
            pose=lambda i=i: compute_level_pose(i) @ rotation,
            point_truth=lambda: PointTruth(numbers, numbers),
        )


def test_bag_of_tilted_sensor_is_levelled(tmp_path, monkeypatch):
    write_bag(tmp_path / "leaning", make_tilted_frames())
    (tmp_path / "robot.yaml").write_text(MOUNT)
    assert (
        run_main(
            monkeypatch,
            "convert",
            tmp_path / "leaning",
            "--robot",
            tmp_path / "robot.yaml",
            "--out",
            tmp_path / "level",
        )
        == 0
    )
    recording = open_recording(tmp_path / "level")
    assert len(recording) == 3
    for i, frame in enumerate(recording):
        cloud, truth, labels = frame.load(), frame.truth(), frame.point_truth()
        np.testing.assert_allclose(cloud.xyz, LEVEL, atol=1e-4)
        assert cloud.frame_id == "front_level" and labels.classes[0] == len(BODY)
        np.testing.assert_allclose(truth.boxes[0, :6], PERSON[:6], atol=1e-4)
        assert truth.boxes[0, 6] == pytest.approx(PERSON[6], abs=0.02)  # the z axes differ
        np.testing.assert_allclose(frame.camera().projection, CAMERA.camera().projection, atol=1e-3)
        np.testing.assert_allclose(frame.pose(), compute_level_pose(i), atol=1e-6)


def test_level_sensor_at_another_height_is_rotated(tmp_path, monkeypatch):
    floor = np.random.default_rng(2).uniform([-20, -20, -0.61], [20, 20, -0.59], (3000, 3))
    write_bag(
        tmp_path / "drive", [Frame.of(str(i), PointCloud.of(floor, None, (i + 1) * 10**8, "front")) for i in range(3)]
    )
    (tmp_path / "robot.yaml").write_text(
        "/**:\n  ros__parameters:\n    input: {ahead: 90.0}\n    ground: {sensor_pose: {height: 0.6}}\n"
    )
    assert (
        run_main(
            monkeypatch, "convert", tmp_path / "drive", "--robot", tmp_path / "robot.yaml", "--out", tmp_path / "level"
        )
        == 0
    )
    cloud = next(iter(open_recording(tmp_path / "level"))).load()
    np.testing.assert_allclose(cloud.xyz, floor[:, [1, 0, 2]] * [1, -1, 1], atol=1e-4)


WORLD = np.random.default_rng(1).uniform(-20, 20, (400, 3)) + [1, 0, 0]


def make_moving_cloud(stamp):
    """Return the cloud of static points, measured while the sensor moves for 0.1 s."""
    seconds = np.linspace(0, 0.1, len(WORLD))
    points = [
        invert_pose(compute_base_pose(stamp + t * 1e9) @ ON_BASE) @ [*point, 1] for point, t in zip(WORLD, seconds)
    ]
    return make_cloud_message(np.array(points)[:, :3], stamp, "lidar", time=seconds.astype(np.float32))


@pytest.mark.parametrize("moves", [make_odometry_rows(ODOMETRY), make_tf_rows()], ids=["odometry", "TF"])
def test_clouds_of_a_bag_are_deskewed(moves, tmp_path, monkeypatch):
    write_robot_bag(tmp_path / "robot", list(moves), make_mount_rows(), cloud=make_moving_cloud)
    assert run_main(monkeypatch, "convert", tmp_path / "robot", "--deskew", "--out", tmp_path / "still") == 0
    for i, frame in enumerate(open_recording(tmp_path / "still")):
        world_to_sensor = invert_pose(compute_base_pose(list_stamps()[i]) @ ON_BASE)
        expected = WORLD @ world_to_sensor[:3, :3].T + world_to_sensor[:3, 3]
        np.testing.assert_allclose(frame.load().xyz, expected, atol=0.01)
        blurred = to_point_cloud(make_moving_cloud(list_stamps()[i]))[0].xyz
        assert np.abs(blurred - expected).max() > 0.4
    assert i == CLOUDS - 1


@pytest.mark.parametrize(
    "parts, cloud, words",
    [
        ([make_odometry_rows(ODOMETRY), make_mount_rows()], make_point_cloud, "no time column"),
        ([], make_moving_cloud, "neither odometry nor a TF"),
    ],
    ids=["no times", "no poses"],
)
def test_missing_times_or_poses_are_reported(parts, cloud, words, tmp_path, monkeypatch, capsys):
    write_robot_bag(tmp_path / "robot", *map(list, parts), cloud=cloud)
    assert run_main(monkeypatch, "convert", tmp_path / "robot", "--deskew", "--out", tmp_path / "out") == 2
    assert words in read_error_line(capsys) and not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "content, more, words",
    [
        (MOUNT.replace("0.9", "-9"), [], "ground.sensor_pose.height"),
        ("[]", [], "is not a parameter file"),
        ("/**: {ros__parameters: {autostart: true}}", [], "does not describe a mounting"),
        (
            "/**: {ros__parameters: {base_frame: base, crop: {body: [-1.0, -1.0, 0.0, 1.0, 1.0, 1.0]}}}",
            [],
            "crop.body in 'base'",
        ),
        (MOUNT, ["--to", "openlabel"], "require a recording with clouds"),
    ],
)
def test_unusable_parameters_are_reported(content, more, words, tmp_path, monkeypatch, capsys):
    write_bag(tmp_path / "bag", make_tilted_frames())
    (tmp_path / "robot.yaml").write_text(content)
    assert (
        run_main(
            monkeypatch,
            "convert",
            tmp_path / "bag",
            "--robot",
            tmp_path / "robot.yaml",
            "--out",
            tmp_path / "out",
            *more,
        )
        == 2
    )
    assert words in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_data_set_is_not_levelled(tmp_path, monkeypatch, capsys):
    root = write_object_folder(tmp_path / "kitti", make_walker_label())
    (tmp_path / "robot.yaml").write_text(MOUNT)
    assert run_main(monkeypatch, "convert", root, "--robot", tmp_path / "robot.yaml", "--out", tmp_path / "out") == 2
    assert "has level clouds" in read_error_line(capsys)
