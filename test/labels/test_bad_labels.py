"""Invalid labels are reported in one line with a remedy, and nothing is partly written."""

from __future__ import annotations

import json
import resource
from dataclasses import replace

import numpy as np
import pytest
from cli_samples import read_error_line, run_main
from format_samples import make_format_drive, make_labels
from samples import make_walker_truth, write_object_folder

from lidar_perception.cli import convert
from lidar_perception.data.to_bag import write_bag
from lidar_perception.labels.datasets import LAYOUTS, write_dataset
from lidar_perception.labels.drive_labels import DriveLabels, FrameLabels
from lidar_perception.labels.exchange import FORMATS, export_labels, import_labels, recognise_format
from lidar_perception.types import InputError

CLOUD = {
    "folder": "",
    "filename": "",
    "path": "",
    "objects": [
        {
            "name": "Car",
            "centroid": {"x": 1, "y": 2, "z": 3},
            "dimensions": {"length": 4, "width": 2, "height": 1},
            "rotations": {"x": 0, "y": 0, "z": 5},
        }
    ],
}
PSR = [
    {
        "psr": {part: {"x": 1, "y": 1, "z": 1} for part in ("position", "scale", "rotation")},
        "obj_type": "Car",
        "obj_id": "1",
    }
]
CUBOID = {
    "openlabel": {
        "frames": {
            "5": {"objects": {"1": {"object_data": {"cuboid": [{"name": "b", "val": [1, 2, 3, 0, 0, 0, 1, 4, 2, 1]}]}}}}
        },
        "objects": {"1": {"type": "Car"}},
    }
}
RESULT = {
    "results": {
        "0000/000005": [
            {
                "sample_token": "0000/000005",
                "translation": [1, 2, 3],
                "size": [1, 2, 1],
                "rotation": [1, 0, 0, 0],
                "velocity": [0, 0],
                "detection_name": "car",
                "detection_score": 1.0,
                "attribute_name": "",
            }
        ]
    }
}
VALID = {
    "labelcloud": ("000005.json", CLOUD),
    "sustech": ("000005.json", PSR),
    "openlabel": ("0000.json", CUBOID),
    "nuscenes-detection": ("r.json", RESULT),
    "kitti": ("000005.txt", "Car 0 0 0 0 0 9 9 1.5 1.6 3.9 0 1.7 15 0\n"),
    "kitti-tracking": ("0000.txt", "5 1 Car 0 0 0 0 0 9 9 1.5 1.6 3.9 0 1.7 15 0\n"),
}
INVALID = [  # format, text that is replaced, replacement, words of the error
    ("labelcloud", '"x": 1', '"x": NaN', "box 1 of 1: its numbers must be finite"),
    ("labelcloud", '"x": 1', '"x": 1e308', "within 100000 m"),
    ("labelcloud", '"name"', '"track_id": 10000000000000000000, "name"', "not an integer"),
    ("labelcloud", '"length": 4', '"length": 0', "and its sides positive"),
    ("labelcloud", '"centroid"', '"centre"', "has no 'centroid'"),
    ("labelcloud", '"name": "Car",', '"name": "Car"', ":1 is not valid JSON: Expecting ',' delimiter"),
    ("labelcloud", '"objects"', '"boxes"', "has no 'objects'"),
    ("sustech", '"x": 1', '"x": 1e999', "must be finite"),
    ("sustech", '"psr"', '"p"', "has no 'psr'"),
    ("sustech", "[", "{", ":1 is not valid JSON"),
    ("openlabel", "[1, 2", "[NaN, 2", "frame 5, box 1 of 1"),
    ("openlabel", "[1, 2, 3, 0, 0", "[1, 2, 3", "a cuboid has 8 numbers"),
    ("openlabel", '"5"', '"50"', "has labels of frame '50' (1 unknown frames), but the drive has frames 5 to 7"),
    ("openlabel", '"5": {', '"5": {"frame_properties": 7, ', "is malformed"),
    ("openlabel", '"openlabel"', '"vcd"', "has no 'openlabel'"),
    ("nuscenes-detection", "[1, 2, 3]", "[1, 2, NaN]", "sample 0000/000005, box 1 of 1"),
    ("nuscenes-detection", "[1, 0, 0, 0]", "[0, 0, 0, 0]", "is malformed"),
    ("nuscenes-detection", "0000/000005", "other", "has no samples of this drive"),
    ("kitti", "3.9", "nan", "000005.txt:1 is not a KITTI label"),
    ("kitti", "Car 0", "Car 1e308", "000005.txt:1 is not a KITTI label"),
    ("kitti-tracking", "5 1 Car", "51 1 Car", "0000.txt:1 is a label of frame 51, but the drive has frames 5"),
]


def format_labels(content):
    return content if isinstance(content, str) else json.dumps(content)


def write_labels(folder, format, old="", new=""):
    name, content = VALID[format]
    folder.mkdir(exist_ok=True)
    assert old in format_labels(content)
    (folder / name).write_text(format_labels(content).replace(old, new, 1))
    return folder / name if format == "nuscenes-detection" else folder


@pytest.mark.parametrize("format", VALID)
def test_unchanged_examples_are_valid(format, tmp_path):
    path = write_labels(tmp_path / "in", format)
    assert recognise_format(path) == format
    assert import_labels(path, format, make_format_drive("one")).box_count == 1


def test_kitti_folder_is_recognised_by_its_folders(tmp_path):
    """The first text file is a calibration."""
    write_dataset("kitti-tracking", make_format_drive("one"), tmp_path / "set")
    for path in tmp_path / "set", tmp_path / "set/training":
        assert recognise_format(path) == "kitti-tracking"
    with pytest.raises(InputError, match="cannot recognise the label format"):
        recognise_format(tmp_path / "set/training/calib")


@pytest.mark.parametrize(
    "content",
    [
        5,
        None,
        [],
        [5],
        {"objs": 5},
        {"objs": {}},
        {"objects": 5},
        {"objects": [5]},
        {"results": 5},
        {"results": {"a": 5}},
        {"results": {"a": [5]}},
    ],
)
def test_other_json_files_are_not_recognised(content, tmp_path):
    (tmp_path / "0.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match="cannot recognise the label format"):
        recognise_format(tmp_path)


@pytest.mark.parametrize(("format", "old", "new", "words"), INVALID)
def test_invalid_labels_are_reported_with_their_file(format, old, new, words, tmp_path):
    path = write_labels(tmp_path / "in", format, old, new)
    with pytest.raises(InputError) as error:
        import_labels(path, format, make_format_drive("one"))
    assert words in str(error.value) and str(tmp_path / "in") in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("format", ["labelcloud", "sustech", "kitti", "kitti-tracking", "openlabel"])
def test_unknown_or_missing_label_files_are_reported(format, tmp_path):
    path = write_labels(tmp_path / "in", format)
    suffix = VALID[format][0][-5:].lstrip("0123456789")
    stranger = path / f"000099{suffix}"
    stranger.write_text(format_labels(VALID[format][1]))
    with pytest.raises(InputError, match="does not belong to a frame of the drive"):
        import_labels(path, format, make_format_drive("one"))
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="has no label files"):
        import_labels(tmp_path / "empty", format, make_format_drive("one"))
    with pytest.raises(InputError, match=r"does not exist|cannot read"):
        import_labels(tmp_path / "none", format, make_format_drive("one"))


def test_convert_offers_all_formats_and_layouts():
    assert (convert.LABELS, convert.DATASETS) == (tuple(FORMATS), tuple(LAYOUTS))


def test_invalid_numbers_are_rejected():
    for box in ([np.nan, *[1] * 6], [*[1] * 6, np.inf], [1, 1, 1, 1, 1, -1, 0], [1e6, *[1] * 6]):
        with pytest.raises(InputError, match="frame 7, box 1 of 1"):
            FrameLabels.of("7", 0, [box], ["Car"])
    with pytest.raises(InputError, match="seven numbers"):
        FrameLabels.of("7", 0, [[1, 2]], ["Car"])
    for track in 2.5, np.nan, 2**63, 10**30:
        with pytest.raises(InputError, match="an integer track id"):
            FrameLabels.of("7", 0, [[1] * 7], ["Car"], [track])
    with pytest.raises(InputError, match="each box needs one of each"):
        FrameLabels.of("7", 0, [[1] * 7], [])


@pytest.mark.parametrize("format", FORMATS)
@pytest.mark.parametrize("key", ["rotation", "tracking_id", "uid", "truncated", "openlabel_cuboid"])
def test_fields_of_other_tools_are_kept_or_rejected(key, format, tmp_path):
    frames = make_format_drive("one")
    for value in None, "x", {}, [0] * 4, [10**400] * 4, [1, 0, 0, 0]:
        labels = DriveLabels(
            [
                FrameLabels.of(
                    frame.name, frame.stamp_ns, [[5, 1, 0, 4, 2, 1, 0.1]], ["Car"], [3], [0.5], [{key: value}]
                )
                for frame in frames
            ]
        )
        try:
            export_labels(labels, format, tmp_path / "out", frames, force=True)
            assert import_labels(tmp_path / "out", format, frames).box_count == len(frames)
        except InputError as error:
            assert "\n" not in str(error) and key not in ("rotation", "tracking_id", "uid")


def test_huge_integers_survive_every_format(tmp_path):
    """The integers are in extra fields, which are copied unchanged."""
    frames = make_format_drive("one")
    path = write_labels(tmp_path / "in", "labelcloud", '"name"', f'"n": {10**400}, "name"')
    labels = import_labels(path, "labelcloud", frames)
    for format in set(FORMATS) - {"kitti", "kitti-tracking"}:  # they have no extra fields
        export_labels(labels, format, tmp_path / format, frames)
        (back,) = import_labels(tmp_path / format, format, frames).frames[0].extra
        assert back["n"] == 10**400


@pytest.mark.parametrize("format", FORMATS)
def test_existing_labels_are_replaced_only_with_force(format, tmp_path):
    frames = make_format_drive("one")
    labels, other = (make_labels(frames, format, seed) for seed in (0, 1))
    export_labels(labels, format, tmp_path / "out", frames)
    with pytest.raises(InputError, match="already exists"):
        export_labels(other, format, tmp_path / "out", frames)
    export_labels(other, format, tmp_path / "out", frames, force=True)
    found = import_labels(tmp_path / "out", format, frames)
    np.testing.assert_allclose(found.frames[0].boxes.sum(), other.frames[0].boxes.sum(), atol=1e-4)


def test_force_keeps_other_files(tmp_path):
    frames = make_format_drive("one")
    export_labels(make_labels(frames, "sustech"), "sustech", tmp_path / "out", frames)
    (tmp_path / "out/notes.txt").write_text("mine")
    with pytest.raises(InputError, match=r"1 files that would not be replaced, such as notes.txt"):
        export_labels(make_labels(frames, "sustech", 1), "sustech", tmp_path / "out", frames, True)
    assert (tmp_path / "out/notes.txt").read_text() == "mine"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out"]


@pytest.fixture
def limit_file_size():
    """Return a function that limits the size of files, to imitate a full disk."""
    _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, hard))


@pytest.mark.parametrize("format", sorted(FORMATS.keys() - {"mcap", "mcap-labels"}))
def test_full_disk_leaves_no_partial_labels(format, tmp_path, limit_file_size):
    frames = make_format_drive("one")
    export_labels(make_labels(frames, format), format, tmp_path / "old", frames)
    before = {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}
    for out, force in (("old", True), ("new", False)):
        limit_file_size(100)
        with pytest.raises(InputError, match=f"cannot write .*{out}"):
            export_labels(make_labels(frames, format, 1), format, tmp_path / out, frames, force)
        limit_file_size(resource.RLIM_INFINITY)
        assert before == {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}


def test_data_set_is_written_completely_or_not_at_all(tmp_path, limit_file_size):
    frames = make_format_drive("one")
    broken_frame = replace(frames[2], load=lambda: (_ for _ in ()).throw(InputError("scan 2 is cut")))
    with pytest.raises(InputError, match="scan 2 is cut"):
        write_dataset("kitti", [*frames[:2], broken_frame], tmp_path / "out")
    assert list(tmp_path.iterdir()) == []
    limit_file_size(600)
    with pytest.raises(InputError, match=r"cannot write .*out/training/velodyne/000000\.bin"):
        write_dataset("kitti", frames, tmp_path / "out")
    limit_file_size(resource.RLIM_INFINITY)
    assert list(tmp_path.iterdir()) == []


def test_missing_calibration_or_pose_is_reported(tmp_path):
    bare = [replace(f, pose=lambda: None) for f in make_format_drive("one", camera=False)]
    with pytest.raises(InputError, match="no camera calibration"):
        export_labels(make_labels(bare, "kitti"), "kitti", tmp_path / "k", bare)
    with pytest.raises(InputError, match="has no pose"):
        export_labels(make_labels(bare, "openlabel"), "nuscenes-tracking", tmp_path / "n", bare)
    for format in ("openlabel", "sustech", "labelcloud", "mcap"):
        export_labels(make_labels(bare, format), format, tmp_path / format, bare)
    assert not (tmp_path / "k").exists() and not (tmp_path / "n").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["{bag}", "--to", "kitti", "--out", "{bag}"], "already exists"),
        (["{bag}", "--to", "nuscenes-tracking", "--out", "{out}"], "has no pose"),
        (
            ["{bag}", "--to", "kitti", "--detections", "/none", "--out", "{out}"],
            "has no topic /none; it has /camera/camera_info",
        ),
        (
            ["{bag}", "--to", "openlabel", "--detections", "/points", "--out", "{out}"],
            "/points has the type sensor_msgs/msg/PointCloud2, but labels need",
        ),
        (["{bag}", "--points", "/lidar", "--to", "nuscenes", "--out", "{out}"], "has no topic /lidar"),
        (
            ["{bag}", "--data", "{kitti}", "--to", "openlabel", "--out", "{out}"],
            "/ground_truth/detections has labels at",
        ),
        (
            ["{bag}", "--data", "{kitti}", "--detections", "/none", "--to", "openlabel", "--out", "{out}"],
            "has no topic /none",
        ),
        (
            ["{empty}", "--data", "{kitti}", "--to", "openlabel", "--out", "{out}"],
            "cannot recognise the label format of",
        ),
        (["{kitti}/none", "--data", "{kitti}", "--to", "openlabel", "--out", "{out}"], "does not exist"),
    ],
)
def test_convert_reports_errors_in_one_line(arguments, words, tmp_path, monkeypatch, capsys):
    root = write_object_folder(tmp_path / "kitti")
    write_bag(
        tmp_path / "bag",
        [replace(frame, pose=lambda: None, truth=make_walker_truth) for frame in make_format_drive("one")],
    )
    (tmp_path / "empty").mkdir()
    places = {"bag": tmp_path / "bag", "out": tmp_path / "out", "kitti": root, "empty": tmp_path / "empty"}
    assert run_main(monkeypatch, "convert", *(a.format(**places) for a in arguments)) == 2
    assert words in read_error_line(capsys)
    assert not (tmp_path / "out").exists()
