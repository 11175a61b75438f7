"""Export and import of labels in all formats."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from format_samples import DRIVES, EXACT, KITTI, NOTES, assert_equal_labels, make_format_drive, make_labels
from samples import DATA, needs_data

from lidar_perception.data.open import open_recording
from lidar_perception.labels.drive_labels import DriveLabels
from lidar_perception.labels.exchange import FORMATS, export_labels, import_labels
from lidar_perception.labels.formats.kitti_lines import compute_occlusion_levels

VERTICES = "labelcloud-vertices"  # sizes are computed from rounded corners
REAL = {"kitti-tracking": "kitti_tracking/training/label_02", "kitti": "kitti_object/training/label_2"}


@pytest.mark.parametrize("format", FORMATS)
@pytest.mark.parametrize("name", DRIVES)
def test_exported_labels_are_imported_again(format, name, tmp_path):
    frames = make_format_drive(name)
    labels = make_labels(frames, format)
    written = export_labels(labels, format, tmp_path / "out", frames)
    assert (written.boxes, written.frames) == (labels.box_count, len(frames))
    read = import_labels(tmp_path / "out", format, frames)
    assert_equal_labels(labels, read, EXACT[format])


@pytest.mark.parametrize("format", FORMATS)
@pytest.mark.parametrize("name", DRIVES)
def test_second_export_is_identical(format, name, tmp_path):
    frames = make_format_drive(name)
    export_labels(make_labels(frames, format), format, tmp_path / "first", frames)
    read = import_labels(tmp_path / "first", format, frames)
    export_labels(read, format, tmp_path / "second", frames)
    second_labels = import_labels(tmp_path / "second", format, frames)
    assert_equal_labels(read, second_labels, max(EXACT[format], 1e-9) if format == VERTICES else 1e-9)
    assert read.extra == second_labels.extra
    for each, other in zip(read.frames, second_labels.frames):
        assert (each.extra, each.notes) == (other.extra, other.notes)


@needs_data
@pytest.mark.parametrize("format", REAL)
def test_kitti_label_files_survive_every_format(format, tmp_path):
    """Other formats get the first frames only. Some have no track ids or no DontCare regions."""
    folder = DATA / REAL[format]
    frames = [replace(frame, pose=np.eye(4).copy) for frame in open_recording(folder.parent.parent)]
    labels = import_labels(folder, format, frames)
    export_labels(labels, format, tmp_path / "own", frames)
    assert read_lines(tmp_path / "own") == read_lines(folder)
    first = DriveLabels(labels.frames[:4])
    export_labels(first, format, tmp_path / "first", frames[:4])
    for other in FORMATS:
        export_labels(first, other, tmp_path / other, frames[:4])
        through = import_labels(tmp_path / other, other, frames[:4])
        export_labels(through, format, tmp_path / f"{other}_back", frames[:4])
        found, expected = read_lines(tmp_path / f"{other}_back"), read_lines(tmp_path / "first")
        if other not in NOTES + KITTI:
            expected = [line for line in expected if "DontCare" not in line]
        if other not in KITTI:
            assert found == expected, other


def read_lines(folder):
    return sorted(line for file in folder.iterdir() for line in file.read_text().splitlines())


def test_only_moved_boxes_get_new_columns(tmp_path):
    """Two cars, one behind the other; the columns of the moved one are computed."""
    text = (
        "Car 0.13 3 -1.57 600.00 150.00 700.00 250.00 1.50 1.60 3.90 0.50 1.70 15.00 -1.57\n"
        "Car 0.27 1 -1.57 600.00 150.00 700.00 250.00 1.50 1.60 3.90 0.50 1.70 30.00 -1.57\n"
        "DontCare -1 -1 -10 10.00 20.00 30.00 40.00 -1 -1 -1 -1000 -1000 -1000 -10\n"
    )
    frames = make_format_drive("one", frames=1)
    folder = tmp_path / "label_2"
    folder.mkdir()
    (folder / "000005.txt").write_text(text)
    labels = import_labels(folder, "kitti", frames)
    export_labels(labels, "kitti", tmp_path / "same", frames)
    assert (tmp_path / "same/000005.txt").read_text() == text
    labels.frames[0].boxes[1, 0] += 1.0
    export_labels(labels, "kitti", tmp_path / "moved", frames)
    old, new = text.splitlines(), (tmp_path / "moved/000005.txt").read_text().splitlines()
    assert (new[0], new[2]) == (old[0], old[2])
    name, truncated, occluded, alpha, left, top, right, bottom, *rest = new[1].split()
    assert (name, float(truncated), occluded) == ("Car", 0.0, "1")  # occlusion is kept
    assert rest[:3] == ["1.50", "1.60", "3.90"] and float(rest[5]) == pytest.approx(31, abs=0.02)
    assert float(alpha) == pytest.approx(float(rest[6]) - np.arctan2(float(rest[3]), float(rest[5])), abs=1e-5)
    assert 600 < float(left) < float(right) < 700 and 150 < float(top) < float(bottom) < 250


def test_hidden_boxes_are_exported_as_occluded():
    pixels = np.array([[0, 0, 10, 10], [5, 0, 15, 10], [2, 2, 8, 8], [np.nan] * 4])
    assert compute_occlusion_levels(pixels, np.array([5.0, 10, 20, 1])).tolist() == [0, 2, 2, 0]
