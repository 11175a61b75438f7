"""KITTI folders and labels of other tools, and with missing parts."""

from __future__ import annotations

import numpy as np
import pytest
from kitti_samples import TRACKLETS, write_raw_folder, write_tracking_folder
from samples import LABELS, make_scene, write_file, write_object_folder

from lidar_perception.data.kitti.labels import parse_label, read_tracklets
from lidar_perception.data.open import open_recording
from lidar_perception.types import CLASSES, InputError, find_class_ids

CAR = "Car 0.00 0 -1.50 580.00 160.00 660.00 230.00 1.50 1.60 3.90 0.00 1.65 12.00 -1.57"
SPELLINGS = {
    "car": "Car",
    "CAR": "Car",
    "dontcare": "DontCare",
    "Person sitting": "Person_sitting",
    "person_sitting": "Person_sitting",
    "PERSON (SITTING)": "Person_sitting",
    "Person": "Person_sitting",
    "tram": "Tram",
    "bus": "bus",
    "traffic cone": "traffic cone",
}


@pytest.mark.parametrize("text", SPELLINGS)
def test_class_names_are_recognised_in_any_spelling(text):
    name = SPELLINGS[text]
    assert parse_label(CAR.replace("Car", text))["class"] == name
    assert parse_label(CAR.replace("Car", text) + " 0.9")["score"] == 0.9
    if text != "Person":  # exists only in the tracking benchmark
        assert [CLASSES[i] for i in find_class_ids([text])] == [name if name in CLASSES else "Misc"]
    if name in CLASSES:
        assert parse_label(CAR.replace("Car", text), known_only=True)
    else:
        with pytest.raises(InputError, match=f"unknown class '{text}'"):
            parse_label(CAR.replace("Car", text), known_only=True)


def encode_for_windows(text):
    """Encode a text as Windows editors do, with trailing spaces."""
    return b"\xef\xbb\xbf" + text.replace("\n", " \t\r\n").encode() + b"\r\n\r\n"


@pytest.mark.parametrize("make", [write_object_folder, write_tracking_folder, write_raw_folder])
def test_files_of_windows_editors_are_read(tmp_path, make):
    expected = list(open_recording(make(tmp_path / "plain")))
    root = make(tmp_path / "windows")
    for path in (*root.rglob("*.txt"), *root.rglob("*.xml")):
        path.write_bytes(encode_for_windows(path.read_text()))
    for frame, original in zip(open_recording(root), expected, strict=True):
        assert (frame.name, frame.stamp_ns) == (original.name, original.stamp_ns)
        assert frame.calibration().equals(original.calibration())
        truth, other = frame.truth(), original.truth()
        assert truth is other is None or (
            truth.labels == other.labels and np.array_equal(truth.boxes, other.boxes) and truth.notes == other.notes
        )
    split = write_file(tmp_path / "split.txt", encode_for_windows(f"{expected[-1].name}\n"))
    assert [f.name for f in open_recording(root, split=split)] == [expected[-1].name]


def test_tracking_labels_without_scan_are_listed(tmp_path):
    root = write_tracking_folder(tmp_path)
    write_file(root / "training/label_02/0003.txt", "7 1 " + CAR + "\n7 2 " + CAR + "\n")
    (root / "training/velodyne/0000/000002.bin").unlink()
    recording = open_recording(root)
    assert [name for name, _ in recording.missing_scans] == ["0000/000002", "0003/000007"]
    assert all(
        "has no scan; download it again" in reason and str(root) in reason for _, reason in recording.missing_scans
    )
    assert open_recording(root, scans=False).missing_scans == ()


# raw drives

DAY, DRIVE = "2011_09_26", "2011_09_26/2011_09_26_drive_0001_sync"
STAMPS = [f"2011-09-26 13:04:32.{i}00000000" for i in range(9)]
START_NS = 1_317_042_272 * 10**9


def write_raw_scans(root, numbers, lines):
    write_raw_folder(root)
    for path in (root / DRIVE / "velodyne_points/data").iterdir():
        path.unlink()
    for number in numbers:
        write_file(root / DRIVE / f"velodyne_points/data/{number:010}.bin", make_scene(number).tobytes())
    write_file(root / DRIVE / "velodyne_points/timestamps.txt", "\n".join(lines) + "\n")
    return root


@pytest.mark.parametrize("missing", [(3, 4, 5, 6), (0,), (0, 1, 8), (2, 5)])
def test_blank_time_stamps_are_those_of_missing_scans(tmp_path, missing):
    numbers = [i for i in range(9) if i not in missing]
    blank = ["" if i in missing else line for i, line in enumerate(STAMPS)]
    for lines in (blank, STAMPS, [line for line in blank if line]):
        recording = open_recording(write_raw_scans(tmp_path, numbers, lines))
        assert [frame.index for frame in recording] == numbers
        assert [frame.stamp_ns for frame in recording] == [START_NS + i * 10**8 for i in numbers]


def test_scan_without_time_stamp_is_reported(tmp_path):
    for lines in (STAMPS[:4] + [""] + STAMPS[5:], STAMPS[:3]):
        with pytest.raises(InputError, match=r"timestamps.txt has no line for scan 4"):
            open_recording(write_raw_scans(tmp_path, (0, 1, 4, 5), lines))


def write_exported_drive(root, names=("0000000000", "0000000001", "0000000002"), frame_list=""):
    """Write a drive as CVAT and Datumaro export it: .pcd files and user-defined class names
    only."""
    for i, name in enumerate(names):
        cloud = make_scene(i)[:40]
        write_file(
            root / f"velodyne_points/data/{name}.pcd",
            b"FIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nPOINTS 40\nDATA binary\n" + cloud.tobytes(),
        )
    write_file(root / "tracklet_labels.xml", TRACKLETS.replace("Pedestrian", "pedestrian"))
    if frame_list:
        write_file(root / "frame_list.txt", frame_list)
    return root


@pytest.mark.parametrize(
    "names, frame_list, indices",
    [
        (("0000000000", "0000000001", "0000000002"), "", [0, 1, 2]),
        (("a", "b", "c"), "# made by a tool\n2 a\n1 sub/c\n\n0 b\n", [0, 1, 2]),
    ],
)
def test_drive_exported_with_pcd_scans_has_labels(tmp_path, names, frame_list, indices):
    recording = open_recording(write_exported_drive(tmp_path, names, frame_list))
    assert str(recording).endswith("KITTI raw drives, 3 frames, labelled boxes")
    assert not recording.has_times and [frame.index for frame in recording] == indices
    assert [len(frame.load()) for frame in recording] == [40] * 3
    assert [frame.truth().labels for frame in recording] == [[], ["Pedestrian"], ["Pedestrian", "Person_sitting"]]
    assert all(frame.calibration() is None for frame in recording)


def test_scan_missing_in_frame_list_is_reported(tmp_path):
    root = write_exported_drive(tmp_path, ("a", "b", "c"), "0 a\n1 b\n")
    with pytest.raises(InputError, match=r"frame_list.txt does not list c\.pcd"):
        open_recording(root)
    write_file(root / "frame_list.txt", "first a\n")
    with pytest.raises(InputError, match=r"frame_list.txt has a line that is not NUMBER NAME"):
        open_recording(root)


def format_tracklet(name, poses, size=(1.5, 1.6, 3.9), more=""):
    h, w, length = size
    return (
        f"<item><objectType>{name}</objectType><h>{h}</h><w>{w}</w><l>{length}</l>{more}<poses>"
        + "".join(f"<item><tx>{x}</tx><ty>0</ty><tz>-1.7</tz><rz>0.1</rz>{rest}</item>" for x, rest in poses)
        + "</poses><finished>1</finished></item>"
    )


def test_tracklets_of_other_tools_keep_their_class_names(tmp_path):
    path = write_file(
        tmp_path / "tracklet_labels.xml",
        "<boost_serialization><tracklets>"
        + "".join(
            (
                format_tracklet("CAR", [(12, "<state>2</state><occlusion/>"), (11, "")]),
                format_tracklet(" bus ", [(9, "<truncation>2</truncation>")], more="<first_frame>1</first_frame>"),
                format_tracklet(
                    "car",
                    [
                        (5, ""),
                        (
                            5,
                            "<occlusion>OcclusionStates.OCCLUSION_UNSET</occlusion>"
                            "<truncation>TruncationStates.OUT_IMAGE</truncation>",
                        ),
                    ],
                ),
                format_tracklet("Van", [(5, "")], size=(0, 1, 2)),
            )
        )
        + "</tracklets></boost_serialization>",
    )
    first, second = read_tracklets(path).values()
    assert first.labels == ["Car", "Car"] and [name for name, _ in first.notes] == ["Van"]
    assert second.labels == ["Car", "Misc"]  # the second car only fills a gap
    assert second.extras[1] == {"track_id": 1, "occluded": 0, "truncated": 2.0, "class_name": "bus"}
    assert second.boxes[:, 0].tolist() == [11, 9]


def test_unknown_object_class_keeps_its_name(tmp_path):
    root = write_object_folder(tmp_path, LABELS + CAR.replace("Car", "e-scooter") + "\n")
    truth = open_recording(root).frames[0].truth()
    assert truth.labels[-1] == "Misc" and truth.extras[-1]["class_name"] == "e-scooter"
