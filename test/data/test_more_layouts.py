"""KITTI odometry, KITTI-360 and OpenPCDet: times, poses, calibration and labels."""

from __future__ import annotations

import numpy as np
import pytest
from recording_samples import kitti360_folder, make_drive_pose, odometry_folder, openpcdet_folder
from samples import CALIBRATION, INTRINSICS, LIDAR_TO_CAMERA, RECTIFY, format_numbers, make_scene, write_file

from lidar_perception.data.frame import BOXES, CAMERA, POSES
from lidar_perception.data.kitti.folder import GAP_NS, PERIOD_NS, START_NS
from lidar_perception.data.open import open_recording
from lidar_perception.types import InputError


def get_stamps(recording):
    return [frame.stamp_ns for frame in recording]


# KITTI odometry


def test_kitti_odometry_has_recorded_times_and_lidar_poses(tmp_path):
    recording = open_recording(odometry_folder(tmp_path))
    assert recording.has_times and get_stamps(recording) == [
        START_NS,
        START_NS + 103_600_000,
        START_NS + 103_600_000 + GAP_NS,
    ]
    for frame in recording:
        np.testing.assert_allclose(frame.pose(), make_drive_pose(frame.index), atol=1e-9)
        np.testing.assert_allclose(frame.calibration().lidar_to_camera, CALIBRATION.lidar_to_camera, atol=1e-9)


def test_kitti_odometry_opens_from_any_of_its_files(tmp_path):
    root = odometry_folder(tmp_path) / "dataset"
    for sequence in ("00", "11"):
        (root / f"sequences/{sequence}/times.txt").unlink()
        (root / f"poses/{sequence}.txt").unlink()
    recording = open_recording(tmp_path)
    assert recording.contents == {CAMERA} and not recording.has_times
    assert np.diff(get_stamps(recording)).tolist() == [PERIOD_NS, GAP_NS]
    assert recording.frames[0].pose() is None
    assert len(open_recording(root / "sequences/00")) == 2
    for calibration in root.rglob("calib.txt"):
        calibration.unlink()
    with pytest.raises(InputError, match=r"scans but no labels: .*calib\.txt and times\.txt"):
        open_recording(tmp_path)


def test_unix_times_are_kept_as_stamps(tmp_path):
    path = odometry_folder(tmp_path) / "dataset/sequences/00/times.txt"
    write_file(path, b"\xef\xbb\xbf1700000000.123456789\r\n1700000000.223456789\r\n")
    assert get_stamps(open_recording(tmp_path))[:2] == [1_700_000_000_123_456_789, 1_700_000_000_223_456_789]


@pytest.mark.parametrize(
    "text, words",
    [
        ("0\n", "has only 1 lines, so scan 1 has no time; download"),
        ("0\nlater\n", "not a number of seconds"),
        ("0\nnan\n", "not a number of seconds"),
    ],
)
def test_missing_or_invalid_times_are_reported(tmp_path, text, words):
    write_file(odometry_folder(tmp_path) / "dataset/sequences/00/times.txt", text)
    with pytest.raises(InputError, match=rf"times\.txt .*{words}"):
        open_recording(tmp_path)


# KITTI-360

NAME = "2013_05_28_drive_0000_sync"
CAM_TO_POSE = np.column_stack([RECTIFY @ [[0, 0, 1], [1, 0, 0], [0, 1, 0]], [1.57, 0.04, 0.9]])


def compute_world_pose(i):
    """Return the pose (4, 4) of the LiDAR in the world."""
    pose = make_drive_pose(i)
    pose[:3, 3] += [1000, 3000, 115]
    return pose


def add_calibration(root, poses):
    """Add calibration and poses; `poses` is the name of their file."""
    to_camera = (
        np.linalg.inv(np.vstack([np.column_stack([RECTIFY, [0, 0, 0]]), [0, 0, 0, 1]])) @ LIDAR_TO_CAMERA
    )  # unrectified camera
    mount = np.vstack([CAM_TO_POSE, [0, 0, 0, 1]])
    write_file(root / "calibration/calib_cam_to_velo.txt", format_numbers(np.linalg.inv(to_camera)[:3]))
    write_file(root / "calibration/calib_cam_to_pose.txt", f"image_00: {format_numbers(CAM_TO_POSE)}\n")
    write_file(
        root / "calibration/perspective.txt",
        f"calib_time: now\nS_rect_00: 1408.0 376.0\nP_rect_00: {format_numbers(INTRINSICS)}\n"
        f"R_rect_00: {format_numbers(RECTIFY)}\n",
    )
    of_file = {
        "cam0_to_world.txt": lambda i: compute_world_pose(i) @ np.linalg.inv(LIDAR_TO_CAMERA),
        "poses.txt": lambda i: (compute_world_pose(i) @ np.linalg.inv(to_camera) @ np.linalg.inv(mount))[:3],
    }
    write_file(
        root / f"data_poses/{NAME}/{poses}", "".join(f"{i} {format_numbers(of_file[poses](i))} \n" for i in (0, 3))
    )
    return root


def test_kitti360_has_recorded_times(tmp_path):
    recording = open_recording(kitti360_folder(tmp_path))
    start = 1_369_730_762_004_700_000
    assert get_stamps(recording) == [start + i * PERIOD_NS for i in (0, 1, 3)]
    assert recording.has_times and [frame.index for frame in recording] == [0, 1, 3]
    (tmp_path / f"data_3d_raw/{NAME}/velodyne_points/timestamps.txt").unlink()
    assert not open_recording(tmp_path).has_times


@pytest.mark.parametrize("poses", ["cam0_to_world.txt", "poses.txt"])
def test_kitti360_has_lidar_poses_and_a_camera(tmp_path, poses):
    root = add_calibration(kitti360_folder(tmp_path), poses)
    recording = open_recording(root)
    assert recording.contents == {CAMERA, POSES}
    first, second, last = recording.frames
    assert second.pose() is None
    for frame in (first, last):
        np.testing.assert_allclose(frame.pose(), compute_world_pose(frame.index), atol=1e-6)
        np.testing.assert_allclose(frame.calibration().lidar_to_camera, LIDAR_TO_CAMERA, atol=1e-9)
        assert (frame.calibration().width, frame.calibration().height) == (1408, 376)
        assert type(frame.calibration().width) is int  # required by JSON
    write_file(root / f"data_poses/{NAME}/{poses}", "0 1 2 3\n")
    with pytest.raises(InputError, match=rf"{poses} has a line without 1\d finite numbers"):
        open_recording(root).frames[0].pose()


# OpenPCDet


def test_openpcdet_labels_are_boxes_in_the_lidar_frame(tmp_path):
    root = openpcdet_folder(tmp_path)
    write_file(
        root / "labels/000000.txt",
        b"\xef\xbb\xbf12 0 -0.98 3.9 1.6 1.5 0.1 Vehicle \r\n\r\n"
        b"1 2 3 0.8 0.6 1.7 -2 pedestrian\r\n"
        b"5 5 0 1 1 1 0 traffic cone\r\n5 5 0 1 1 1 0 DONTCARE\r\n",
    )
    write_file(root / "labels/000001.txt", "")
    (root / "labels/000002.txt").unlink()
    write_file(root / "labels/000007.txt", "")
    first, second, third = recording = open_recording(root)
    truth = first.truth()
    assert truth.labels == ["Car", "Pedestrian", "Misc", "DontCare"]
    assert truth.boxes[0].tolist() == [12, 0, -0.98, 3.9, 1.6, 1.5, 0.1]
    assert [extra.get("class_name") for extra in truth.extras] == [None, None, "traffic cone", None]
    assert len(second.truth()) == 0 and third.truth() is None
    assert [name for name, _ in recording.missing_scans] == ["000007"]
    assert np.array_equal(first.load().xyz, make_scene(0)[:, :3])
    assert [f.name for f in open_recording(root, split=root / "ImageSets/train.txt")] == ["000000", "000002"]


def test_openpcdet_accepts_more_columns_and_no_labels(tmp_path):
    root = openpcdet_folder(tmp_path)
    np.save(root / "points/000000.npy", np.column_stack([make_scene(0)] * 2))
    for label in (root / "labels").iterdir():
        label.unlink()
    recording = open_recording(root)
    assert recording.contents == set() and recording.frames[0].truth() is None
    assert np.array_equal(recording.frames[0].load().points(), make_scene(0))


@pytest.mark.parametrize(
    "line", ["1 2 3 4 5 6 7", "1 2 3 4 5 6 left Car", "Car 1 2 3 4 5 6 7", "1 2 3 4 0 6 7 Car", "1 nan 3 4 5 6 7 Car"]
)
def test_invalid_openpcdet_line_is_reported(tmp_path, line):
    root = openpcdet_folder(tmp_path)
    write_file(root / "labels/000000.txt", f"12 0 0 4 2 1 0 Car\n{line}\n")
    with pytest.raises(InputError, match=r"000000\.txt:2 is not a label \(x y z dx dy dz heading class"):
        open_recording(root).frames[0].truth()
    assert BOXES in open_recording(root).contents


@pytest.mark.parametrize(
    "file, content, words",
    [
        ("dataset/poses/00.txt", "1 0 0 0 0 1 0 0 0 0 1 nan\n", "is not a rigid transform"),
        ("dataset/poses/00.txt", "1 9 0 0 0 1 0 0 0 0 1 0\n", "is not a rigid transform"),
        (
            "dataset/sequences/00/calib.txt",
            "P2: 1 0 0 0 0 1 0 0 0 0 1 0\nTr: 1 0 0 0 1 0 0 0 1 0 0 0\n",
            "is not a rigid transform",
        ),
    ],
)
def test_invalid_poses_are_reported(tmp_path, file, content, words):
    write_file(odometry_folder(tmp_path) / file, content)
    with pytest.raises(InputError, match=words) as error:
        open_recording(tmp_path).frames[0].pose()
    assert str(tmp_path / file) in str(error.value)
