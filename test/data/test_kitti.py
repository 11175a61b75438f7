"""KITTI folders: scans, calibrations and stamps of every layout."""

from __future__ import annotations

import numpy as np
import pytest
from kitti_samples import LAYOUTS, each_layout, write_raw_folder, write_tracking_folder
from samples import (
    CALIBRATION,
    INTRINSICS,
    LIDAR_TO_CAMERA,
    make_calibration_text,
    make_png_header,
    make_scene,
    write_file,
    write_object_folder,
)

from lidar_perception.data.kitti.calibration import IMAGE_SIZES, read_calibration
from lidar_perception.data.kitti.folder import START_NS, read_velodyne
from lidar_perception.data.open import open_recording


@pytest.mark.parametrize("layout, count", [("object", 2), ("tracking", 5), ("raw", 3)])
def test_scans_are_read_unchanged(tmp_path, layout, count):
    frames = open_recording(LAYOUTS[layout](tmp_path)).frames
    assert len(frames) == count
    for frame in frames:
        expected = make_scene(int(frame.points.stem))
        assert np.array_equal(read_velodyne(frame.points), expected)
        assert np.array_equal(frame.load().xyz, expected[:, :3])
        assert np.array_equal(frame.load().intensity, expected[:, 3])
        assert frame.load().stamp_ns == frame.stamp_ns
        assert frame.load().frame_id == "velodyne"


@each_layout
def test_calibration_is_the_product_of_its_matrices(tmp_path, layout):
    for frame in open_recording(LAYOUTS[layout](tmp_path)):
        calibration = frame.calibration()
        np.testing.assert_allclose(calibration.lidar_to_camera, LIDAR_TO_CAMERA, atol=1e-12)
        assert np.array_equal(calibration.intrinsics, INTRINSICS)
        assert (calibration.width, calibration.height) == (1242, 375)


@each_layout
def test_frames_have_ascending_stamps_and_unique_names(tmp_path, layout):
    frames = open_recording(LAYOUTS[layout](tmp_path)).frames
    stamps = [f.stamp_ns for f in frames]
    assert stamps == sorted({*stamps}) and len({f.name for f in frames}) == len(frames)


def test_object_and_tracking_frames_are_stamped_at_10_hz(tmp_path):
    frames = open_recording(write_object_folder(tmp_path / "o", count=3))
    assert [f.stamp_ns - START_NS for f in frames] == [0, 10**8, 2 * 10**8]
    frames = open_recording(write_tracking_folder(tmp_path / "t")).frames
    first, second = ([f for f in frames if f.name.startswith(s)] for s in ("0000/", "0007/"))
    assert [f.stamp_ns - first[0].stamp_ns for f in first] == [0, 10**8, 2 * 10**8]
    assert [f.stamp_ns - second[0].stamp_ns for f in second] == [0, 10**8]
    assert second[0].stamp_ns - first[-1].stamp_ns > 10**9


def test_missing_frame_leaves_a_gap_in_time(tmp_path):
    root = write_tracking_folder(tmp_path)
    (root / "training/velodyne/0000/000001.bin").unlink()
    assert [f.stamp_ns - START_NS for f in open_recording(root).frames[:2]] == [0, 2 * 10**8]


def test_raw_stamps_have_nanosecond_resolution(tmp_path):
    second = 1317042145 * 10**9  # date -u -d '2011-09-26 13:02:25' +%s
    assert [f.stamp_ns - second for f in open_recording(write_raw_folder(tmp_path))] == [
        594360375,
        700000000,
        1000000001,
    ]


@pytest.mark.parametrize("inner", ["", "training", "2011_09_26", "2011_09_26/2011_09_26_drive_0001_sync"])
def test_outer_and_inner_folders_are_the_same_recording(tmp_path, inner):
    folders = {layout: make(tmp_path / layout) for layout, make in LAYOUTS.items()}
    for root in folders.values():
        if (root / inner).is_dir():
            assert [f.points for f in open_recording(root / inner)] == [f.points for f in open_recording(root)]


def test_full_scan_is_preferred_to_reduced_one(tmp_path):
    root = write_object_folder(tmp_path)
    for i in (1, 2):
        write_file(root / f"training/velodyne_reduced/{i:06}.bin", make_scene(i)[:50].tobytes())
    assert [len(f.load()) for f in open_recording(root)] == [len(make_scene()), len(make_scene()), 50]


def test_unusable_returns_are_dropped(tmp_path):
    root = write_object_folder(tmp_path)
    cloud = np.array([[1, 2, 3, 0.5], [0, 0, 0, 0.1], [np.nan, 1, 1, 0.2], [4, 5, 6, 0.7]], "f4")
    write_file(root / "training/velodyne/000000.bin", cloud.tobytes())
    frame = open_recording(root).frames[0]
    assert frame.load().xyz.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert frame.load().intensity.tolist() == [0.5, np.float32(0.7)]
    assert read_velodyne(frame.points).tobytes() == cloud.tobytes()


def test_empty_scan_is_read(tmp_path):
    assert read_velodyne(write_file(tmp_path / "empty.bin", b"")).shape == (0, 4)


def test_image_size_is_read_from_the_png(tmp_path):
    root = write_object_folder(tmp_path)
    write_file(root / "training/image_2/000001.png", make_png_header(640, 480))
    sizes = [(f.calibration().width, f.calibration().height) for f in open_recording(root)]
    assert sizes == [(1242, 375), (640, 480)]


@pytest.mark.parametrize("content", [b"", b"\x89PNG", b"JFIF" * 10])
def test_invalid_png_does_not_change_the_image_size(tmp_path, content):
    path, image = write_file(tmp_path / "c.txt", make_calibration_text()), write_file(tmp_path / "i.png", content)
    calibration = read_calibration(path, image)
    assert (calibration.width, calibration.height) == (1242, 375)


@pytest.mark.parametrize("focal, size", [*IMAGE_SIZES.items(), (1000.0, (1242, 375))])
def test_image_size_follows_from_focal_length_without_image(tmp_path, focal, size):
    text = make_calibration_text().replace("721.5377", str(focal))
    calibration = read_calibration(write_file(tmp_path / "c.txt", text))
    assert (calibration.width, calibration.height) == size


def test_camera_pose_is_the_inverse_of_lidar_to_camera():
    camera, direct = CALIBRATION.camera(), INTRINSICS @ LIDAR_TO_CAMERA
    np.testing.assert_allclose(camera.projection, direct, atol=1e-9)
    assert (camera.width, camera.height) == (1242, 375)
