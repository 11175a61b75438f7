"""Invalid or missing files in KITTI folders are reported and do not affect other frames."""

from __future__ import annotations

import pytest
from kitti_samples import LAYOUTS, TRACKING_LABELS, TRACKLETS, write_raw_folder
from samples import LABELS, make_calibration_text, write_file, write_object_folder

from lidar_perception.data.open import open_recording
from lidar_perception.types import InputError

INVALID_FILES = {  # invalid file -> its content (None: removed), words of the error
    "velodyne/000000.bin": [(b"123", "multiple of 16")],
    "calib/000000.txt": [
        (None, "cannot read"),
        (b"\xff\xfe\x00", "cannot read"),
        ("", "no P2"),
        (make_calibration_text().replace("P2", "P3"), "no P2 with 12 finite numbers"),
        (make_calibration_text().replace("R0_rect", "x"), "no R0_rect with 9 finite numbers"),
        (make_calibration_text().replace("Tr_velo_to_cam", "x"), "no Tr_velo_to_cam with 12 finite"),
        (make_calibration_text().replace("P2: ", "P2: 1 "), "no P2 with 12 finite numbers"),
        (make_calibration_text().replace("P2: 721.5377", "P2: wide"), "no P2 with 12 finite numbers"),
        (make_calibration_text().replace("P2: 721.5377", "P2: nan"), "no P2 with 12 finite numbers"),
    ],
    "label_2/000000.txt": [
        (LABELS + "Car 0 0 0\n", ":4 is not a KITTI label"),
        (LABELS.replace("1.52", "tall"), ":2 is not a KITTI label"),
        (b"\xff\xfe\x00", "cannot read"),
    ],
}


def read_frame(frame):
    """Read all parts of a frame."""
    return frame.load(), frame.truth(), frame.calibration()


@pytest.mark.parametrize(
    "file, content, words",
    [(file, content, words) for file, cases in INVALID_FILES.items() for content, words in cases],
)
def test_invalid_file_affects_only_its_frame(tmp_path, file, content, words):
    root = write_object_folder(tmp_path)
    path = root / "training" / file
    path.unlink()
    if content is not None:
        write_file(path, content)
    broken_frame, valid_frame = open_recording(root)
    with pytest.raises(InputError) as error:
        read_frame(broken_frame)
    assert str(path) in str(error.value) and words in str(error.value)
    assert "\n" not in str(error.value)
    read_frame(valid_frame)
    assert valid_frame.name == "000001"


@pytest.mark.parametrize(
    "layout, file, content, words",
    [
        ("tracking", "training/calib/0000.txt", "", "no P2"),
        ("tracking", "training/label_02/0000.txt", "0 1 Car", ":1 is not a KITTI label"),
        ("tracking", "training/label_02/0000.txt", "zero " + TRACKING_LABELS[2:], ":1 is not a tracking label"),
        ("tracking", "training/label_02/0000.txt", "\n7\n", ":2 is not a tracking label"),
        ("raw", "2011_09_26/calib_cam_to_cam.txt", "", "no S_rect_02"),
        ("raw", "2011_09_26/calib_velo_to_cam.txt", "", "no R with 9 finite numbers"),
        ("raw", "2011_09_26/2011_09_26_drive_0001_sync/tracklet_labels.xml", "<cut", "cannot read"),
        ("raw", "2011_09_26/2011_09_26_drive_0001_sync/tracklet_labels.xml", "<a/>", "cannot read"),
        (
            "raw",
            "2011_09_26/2011_09_26_drive_0001_sync/tracklet_labels.xml",
            TRACKLETS.replace("<h>1.8</h>", "<h>tall</h>"),
            "cannot read",
        ),
    ],
)
def test_invalid_file_of_a_sequence_is_reported(tmp_path, layout, file, content, words):
    root = LAYOUTS[layout](tmp_path)
    write_file(root / file, content)
    with pytest.raises(InputError) as error:
        read_frame(open_recording(root).frames[0])
    assert str(root / file) in str(error.value) and words in str(error.value)


@pytest.mark.parametrize("text", [None, "yesterday\n" * 3, "2011-09-26 13:02:25.5\n"])
def test_invalid_time_stamps_are_reported(tmp_path, text):
    path = next(write_raw_folder(tmp_path).rglob("timestamps.txt"))
    path.unlink()
    if text is not None:
        write_file(path, text)
    with pytest.raises(InputError, match=r"velodyne_points/timestamps\.txt"):
        open_recording(tmp_path)


@pytest.mark.parametrize(
    "layout, scan",
    [
        ("tracking", "training/velodyne/0000/notes.bin"),
        ("raw", "2011_09_26/2011_09_26_drive_0001_sync/velodyne_points/data/notes.bin"),
    ],
)
def test_scan_without_number_is_reported(tmp_path, layout, scan):
    root = LAYOUTS[layout](tmp_path)
    write_file(root / scan, b"")
    with pytest.raises(InputError, match=r"notes\.bin"):
        open_recording(root)
