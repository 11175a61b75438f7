"""Persistence of labels: journals, imports and exports."""

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
from lidar_studio.label_conversion import join_extras, to_labels, to_tracks
from lidar_studio.session import AlreadyImportedError, open_session
from lidar_studio.state import State, track_to_json

COUNT = 6
BOX = [8.0, 3.0, -0.9, 0.8, 0.6, 1.7, 0.3]


def frames(x=5.0):
    cloud = np.tile(np.array([[x, 0, -1]], np.float32), (50, 1))
    return [
        replace(
            Frame.of(f"{i:06}", PointCloud(cloud + np.float32(i), cloud[:, 0] * 0, (i + 1) * 10**8, "velodyne")),
            index=i,
        )
        for i in range(COUNT)
    ]


def drive(name="monday", x=5.0):
    return Drive(name, Recording(Path(name), "made up", frames(x)))


def labelled(session, frame=0, **more):
    session.do({"do": "add", "frame": frame, "box": BOX, "class": "Pedestrian", **more})


def test_journal_is_identified_by_clouds_not_by_folder_name(tmp_path):
    with open_session(drive(), tmp_path) as session:
        labelled(session)
    with open_session(drive("renamed"), tmp_path) as session:
        assert len(session.state.tracks) == 1
    with pytest.raises(InputError, match="another drive"), open_session(drive(x=6.0), tmp_path):
        pass


def test_old_journal_is_identified_by_the_drive_name(tmp_path):
    old = make_journal_header("monday", [f.name for f in frames()], [f.stamp_ns for f in frames()], "")
    del old["clouds"]
    Journal(tmp_path, old).close()
    with open_session(drive(), tmp_path) as session:
        labelled(session)
    with pytest.raises(InputError, match="another drive"), open_session(drive("other"), tmp_path):
        pass


def test_journal_changed_by_another_process_is_not_overwritten(tmp_path, monkeypatch):
    def no_locks(*_):
        raise OSError(9, "Bad file descriptor")

    monkeypatch.setattr(fcntl, "flock", no_locks)
    with open_session(drive(), tmp_path) as one, open_session(drive(), tmp_path) as two:
        assert "cannot be locked" in one.journal.message
        labelled(one)
        content = one.journal.path.read_bytes()
        with pytest.raises(InputError, match="another process"):
            labelled(two)
        assert one.journal.path.read_bytes() == content and not two.state.tracks
        labelled(one)


def test_labels_are_imported_once_and_added_to_existing_ones(tmp_path):
    with open_session(drive(), tmp_path / "one") as session:
        labelled(session)
        session.export("openlabel", "labels.json")
        session.do({"do": "class", "track": 1, "class": "Cyclist"})
        session.export("openlabel", "others.json")
    with open_session(drive(), tmp_path / "two") as session:
        for name in ("labels", "others"):
            import_action = {"do": "import", "path": str(tmp_path / f"one/{name}.json")}
            session.do(import_action)
            with pytest.raises(AlreadyImportedError):
                session.do(import_action)
        session.do({"do": "undo"})
        session.do(import_action)  # an undone import can be repeated
        names = sorted(track.class_name for track in session.state.tracks.values())
        assert names == ["Cyclist", "Pedestrian"]
    with open_session(drive(), tmp_path / "two") as session, pytest.raises(AlreadyImportedError):
        session.do(import_action)


def test_extras_of_all_imports_are_kept():
    one = {"notes": {"0": [["DontCare", {"left": 10}]]}, "extra": {"openlabel": {"": {}}}}
    two = {"notes": {"0": [["DontCare", {"left": 20}]], "3": []}, "extra": {"kitti": {}}}
    both = join_extras(join_extras({}, one), two)
    assert both["notes"]["0"] == one["notes"]["0"] + two["notes"]["0"]
    assert both["extra"].keys() == {"openlabel", "kitti"} and join_extras(both, one) == both


def test_merged_boxes_without_ids_get_one(tmp_path):
    with open_session(drive(), tmp_path / "one") as session:
        for frame in range(COUNT):
            labelled(session, frame)
        session.export("sustech", "boxes")
        for file in (tmp_path / "one/boxes").rglob("*.json"):
            file.write_text(file.read_text().replace("obj_id", "nobody"))
    with open_session(drive(), tmp_path / "two") as session:
        session.do({"do": "import", "path": str(tmp_path / "one/boxes")})
        first, *others = sorted(session.state.tracks)
        for other in others:
            session.do({"do": "merge", "tracks": [first, other]})
        labels = to_labels(session.state, session.drive.frames)
        ids = {int(i) for frame in labels.frames for i in frame.track_ids}
        assert len(ids) == 1 and min(ids) >= 0


def test_concurrent_exports_are_complete(tmp_path):
    with open_session(drive(), tmp_path) as session:
        for frame in range(COUNT):
            labelled(session, frame)

        def export(_):
            return session.export("labelcloud", "labels", force=True)["boxes"]

        with ThreadPoolExecutor(4) as pool:
            assert list(pool.map(export, range(12))) == [COUNT] * 12
        names = sorted(path.name for path in (tmp_path / "labels").iterdir())
        assert [n for n in names if n[:6].isdigit()] == [f"{f.name}.json" for f in frames()]
        assert not [n for n in os.listdir(tmp_path) if n.endswith(".tmp")]


def test_journal_is_rejected_if_poses_appear_or_disappear(tmp_path):
    bare, posed = (
        drive(),
        Drive(
            "monday",
            Recording(Path("monday"), "made up", [replace(frame, pose=lambda: np.eye(4)) for frame in frames()]),
        ),
    )
    for k, (now, then) in enumerate(((bare, posed), (posed, bare))):
        with open_session(now, tmp_path / str(k)) as session:
            labelled(session)
        with pytest.raises(InputError, match="poses"), open_session(then, tmp_path / str(k)):
            pass
        with open_session(now, tmp_path / str(k)) as session:
            assert len(session.state.tracks) == 1


@pytest.mark.parametrize("name", ["journal.jsonl", "./other/journal.jsonl"])
def test_export_does_not_overwrite_the_journal(tmp_path, name):
    with open_session(drive(), tmp_path) as session:
        labelled(session)
        (tmp_path / "other").symlink_to(tmp_path)
        with pytest.raises(InputError, match="is the journal"):
            session.export("nuscenes-detection", name, force=True)


def test_nan_is_written_as_null_in_the_journal():
    none, box = float("nan"), np.array([BOX])
    labels = DriveLabels(
        [
            FrameLabels.of(
                "000000", 10**8, box, ["Car"], [1], [0.5], [{"velocity": [none, 1.0]}], [("area", {"x": none})]
            )
        ]
    )
    tracks, preserved = to_tracks(labels, 1)
    json.dumps([track_to_json(tracks[0]), preserved], allow_nan=False)
    back = to_labels(replace(State(), tracks={1: tracks[0]}, preserved=preserved), frames()[:1])
    assert back.frames[0].extra[0] == {"velocity": [None, 1.0]}
    assert back.frames[0].notes == [("area", {"x": None})]


def test_command_imports_once_and_needs_a_journal_to_export(tmp_path):
    write_bag(tmp_path / "bag", frames())

    def run(*words):
        return CliRunner().invoke(cli, ["label", "--data", str(tmp_path / "bag"), *map(str, words)])

    to = ("--export", f"OpenLabel:{tmp_path}/made/../labels.json")
    nowhere = run("--out", tmp_path / "empty", *to)
    assert isinstance(nowhere.exception, InputError) and "no journal" in str(nowhere.exception)
    assert not (tmp_path / "empty").exists()
    with open_session(select_drive(open_recording(tmp_path / "bag")), tmp_path / "made") as session:
        labelled(session)
    assert run("--out", tmp_path / "made", *to).exit_code == 0
    for _ in range(2):
        again = run("--out", tmp_path / "two", "--import", f"openlabel:{tmp_path / 'labels.json'}", *to, "--force")
        assert again.exit_code == 0 and ": 1 boxes" in again.output.replace("\n", "")
    assert "already" in again.output.replace("\n", " ")
