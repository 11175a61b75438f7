"""Tests of the persistence of labels: journals, imports and exports."""

from __future__ import annotations

import fcntl
import json
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from lidar_perception.cli.main import cli
from lidar_perception.data.frame import Frame, Recording
from lidar_perception.data.open import open_recording
from lidar_perception.data.to_bag import write_bag
from lidar_perception.labels.drive_labels import DriveLabels, FrameLabels
from lidar_perception.types import InputError, PointCloud
from lidar_studio.drive import Drive, select_drive
from lidar_studio.journal import Journal, make_journal_header
from lidar_studio.label_conversion import merge_preserved_fields, to_labels, to_tracks
from lidar_studio.session import AlreadyImportedError, open_session
from lidar_studio.state import State, track_to_json

COUNT = 6
BOX = [8.0, 3.0, -0.9, 0.8, 0.6, 1.7, 0.3]


def make_frames(x=5.0):
    cloud = np.tile(np.array([[x, 0, -1]], np.float32), (50, 1))
    return [
        replace(
            Frame.of(f"{i:06}", PointCloud(cloud + np.float32(i), cloud[:, 0] * 0, (i + 1) * 10**8, "velodyne")),
            index=i,
        )
        for i in range(COUNT)
    ]


def make_drive(name="monday", x=5.0):
    return Drive(name, Recording(Path(name), "made up", make_frames(x)))


def add_box(session, frame=0):
    session.execute({"do": "add", "frame": frame, "box": BOX, "class": "Pedestrian"})


def test_journal_is_identified_by_clouds_not_by_folder_name(tmp_path):
    with open_session(make_drive(), tmp_path) as session:
        add_box(session)
    with open_session(make_drive("renamed"), tmp_path) as session:
        assert len(session.state.tracks) == 1
    with pytest.raises(InputError, match="another drive"), open_session(make_drive(x=6.0), tmp_path):
        pass


def test_old_journal_is_identified_by_the_drive_name(tmp_path):
    old = make_journal_header("monday", [f.name for f in make_frames()], [f.stamp_ns for f in make_frames()], "")
    del old["clouds"]
    Journal(tmp_path, old).close()
    with open_session(make_drive(), tmp_path) as session:
        add_box(session)
    with pytest.raises(InputError, match="another drive"), open_session(make_drive("other"), tmp_path):
        pass


def test_journal_of_another_process_is_not_overwritten(tmp_path, monkeypatch):
    def raise_error(*_):
        raise OSError(9, "Bad file descriptor")

    monkeypatch.setattr(fcntl, "flock", raise_error)
    with open_session(make_drive(), tmp_path) as one, open_session(make_drive(), tmp_path) as two:
        assert "cannot be locked" in one.journal.message
        add_box(one)
        content = one.journal.path.read_bytes()
        with pytest.raises(InputError, match="another process"):
            add_box(two)
        assert one.journal.path.read_bytes() == content and not two.state.tracks
        add_box(one)


def test_labels_are_imported_once_and_added_to_existing_ones(tmp_path):
    with open_session(make_drive(), tmp_path / "one") as session:
        add_box(session)
        session.export("openlabel", "labels.json")
        session.execute({"do": "class", "track": 1, "class": "Cyclist"})
        session.export("openlabel", "others.json")
    with open_session(make_drive(), tmp_path / "two") as session:
        for name in ("labels", "others"):
            import_action = {"do": "import", "path": str(tmp_path / f"one/{name}.json")}
            session.execute(import_action)
            with pytest.raises(AlreadyImportedError):
                session.execute(import_action)
        session.execute({"do": "undo"})
        session.execute(import_action)  # an undone import can be repeated
        names = sorted(track.class_name for track in session.state.tracks.values())
        assert names == ["Cyclist", "Pedestrian"]
    with open_session(make_drive(), tmp_path / "two") as session, pytest.raises(AlreadyImportedError):
        session.execute(import_action)


def test_preserved_fields_of_all_imports_are_merged():
    one = {"notes": {"0": [["DontCare", {"left": 10}]]}, "extra": {"openlabel": {"": {}}}}
    two = {"notes": {"0": [["DontCare", {"left": 20}]], "3": []}, "extra": {"kitti": {}}}
    both = merge_preserved_fields(merge_preserved_fields({}, one), two)
    assert both["notes"]["0"] == one["notes"]["0"] + two["notes"]["0"]
    assert both["extra"].keys() == {"openlabel", "kitti"} and merge_preserved_fields(both, one) == both


def test_merged_boxes_without_ids_get_one(tmp_path):
    with open_session(make_drive(), tmp_path / "one") as session:
        for frame in range(COUNT):
            add_box(session, frame)
        session.export("sustech", "boxes")
        for file in (tmp_path / "one/boxes").rglob("*.json"):
            file.write_text(file.read_text().replace("obj_id", "nobody"))
    with open_session(make_drive(), tmp_path / "two") as session:
        session.execute({"do": "import", "path": str(tmp_path / "one/boxes")})
        first, *others = sorted(session.state.tracks)
        for other in others:
            session.execute({"do": "merge", "tracks": [first, other]})
        labels = to_labels(session.state, session.drive.frames)
        ids = {int(i) for frame in labels.frames for i in frame.track_ids}
        assert len(ids) == 1 and min(ids) >= 0


def test_concurrent_exports_are_complete(tmp_path):
    with open_session(make_drive(), tmp_path) as session:
        for frame in range(COUNT):
            add_box(session, frame)

        def export(_):
            return session.export("labelcloud", "labels", force=True)["boxes"]

        with ThreadPoolExecutor(4) as pool:
            assert list(pool.map(export, range(12))) == [COUNT] * 12
        names = sorted(path.name for path in (tmp_path / "labels").iterdir())
        assert [n for n in names if n[:6].isdigit()] == [f"{f.name}.json" for f in make_frames()]
        assert not [n for n in os.listdir(tmp_path) if n.endswith(".tmp")]


def test_journal_is_rejected_if_poses_were_added_or_removed(tmp_path):
    drive_without_poses, drive_with_poses = (
        make_drive(),
        Drive(
            "monday",
            Recording(Path("monday"), "made up", [replace(frame, pose=lambda: np.eye(4)) for frame in make_frames()]),
        ),
    )
    for k, (drive, changed_drive) in enumerate(
        ((drive_without_poses, drive_with_poses), (drive_with_poses, drive_without_poses))
    ):
        with open_session(drive, tmp_path / str(k)) as session:
            add_box(session)
        with pytest.raises(InputError, match="poses"), open_session(changed_drive, tmp_path / str(k)):
            pass
        with open_session(drive, tmp_path / str(k)) as session:
            assert len(session.state.tracks) == 1


@pytest.mark.parametrize("name", ["journal.jsonl", "./other/journal.jsonl"])
def test_export_does_not_overwrite_the_journal(tmp_path, name):
    with open_session(make_drive(), tmp_path) as session:
        add_box(session)
        (tmp_path / "other").symlink_to(tmp_path)
        with pytest.raises(InputError, match="is the journal"):
            session.export("nuscenes-detection", name, force=True)


def test_nan_is_written_as_null():
    nan, box = float("nan"), np.array([BOX])
    labels = DriveLabels(
        [FrameLabels.of("000000", 10**8, box, ["Car"], [1], [0.5], [{"velocity": [nan, 1.0]}], [("area", {"x": nan})])]
    )
    tracks, preserved = to_tracks(labels, 1)
    json.dumps([track_to_json(tracks[0]), preserved], allow_nan=False)
    exported_labels = to_labels(replace(State(), tracks={1: tracks[0]}, preserved_fields=preserved), make_frames()[:1])
    assert exported_labels.frames[0].extra[0] == {"velocity": [None, 1.0]}
    assert exported_labels.frames[0].notes == [("area", {"x": None})]


def test_command_imports_once_and_requires_a_journal_to_export(tmp_path):
    write_bag(tmp_path / "bag", make_frames())

    def run(*arguments):
        return CliRunner().invoke(cli, ["label", "--data", str(tmp_path / "bag"), *map(str, arguments)])

    export_options = ("--export", f"OpenLabel:{tmp_path}/made/../labels.json")
    result = run("--out", tmp_path / "empty", *export_options)
    assert isinstance(result.exception, InputError) and "no journal" in str(result.exception)
    assert not (tmp_path / "empty").exists()
    with open_session(select_drive(open_recording(tmp_path / "bag")), tmp_path / "made") as session:
        add_box(session)
    assert run("--out", tmp_path / "made", *export_options).exit_code == 0
    for _ in range(2):
        import_options = ("--import", f"openlabel:{tmp_path / 'labels.json'}")
        result = run("--out", tmp_path / "two", *import_options, *export_options, "--force")
        assert result.exit_code == 0 and ": 1 boxes" in result.output.replace("\n", "")
    assert "already" in result.output.replace("\n", " ")
