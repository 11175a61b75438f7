"""Laws of simulated data sets: what is written is read back, and a stop changes no byte."""

import errno
import itertools
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import CliRunner

from lidar_perception.cli.simulate import simulate
from lidar_perception.datasets import write_kitti
from lidar_perception.datasets.kitti import open_kitti
from lidar_perception.datasets.kitti_labels import read_object_labels, read_tracking_labels
from lidar_perception.datasets.recording import open_recording
from lidar_perception.datasets.semantickitti import MOVING, THINGS, open_semantic_kitti
from lidar_perception.geometry import box_corners, points_in_box, wrap_angle
from lidar_perception.simulation import dataset
from lidar_perception.simulation.batch import training_scans
from lidar_perception.simulation.camera import FORWARD_CAMERA, kitti_labels
from lidar_perception.simulation.dataset import LAYOUTS
from lidar_perception.simulation.drive import drive, scan_at, scans
from lidar_perception.simulation.scene import CROWDED
from lidar_perception.simulation.sensor import SENSORS, generic
from lidar_perception.types import InputError

TINY = generic(16, -14.0, 3.0, 2.0, 10.0)
ROOT = Path(__file__).resolve().parents[1]
SCRIPT = """
from lidar_perception.simulation.scene import CROWDED
from lidar_perception.simulation.sensor import SENSORS, generic
SENSORS["tiny"] = generic(16, -14.0, 3.0, 2.0, 10.0)
from lidar_perception.cli.main import main
main()
"""


@pytest.fixture(autouse=True)
def tiny(monkeypatch):
    monkeypatch.setitem(SENSORS, "tiny", TINY)


def arguments(out, layout="kitti", frames=5, jobs=1, *more):
    return ["--out", str(out), "--format", layout, "--sensor", "tiny", "--frames", str(frames),
            "--seed", "3", "--jobs", str(jobs), *map(str, more)]


def run(out, layout="kitti", frames=5, jobs=1, *more):
    result = CliRunner().invoke(simulate, arguments(out, layout, frames, jobs, *more))
    if result.exception and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def content(folder):
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*"))
            if p.is_file()}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Layout -> the content of a data set of five frames that was made in one go."""
    root = tmp_path_factory.mktemp("made")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(SENSORS, "tiny", TINY)
        for layout in LAYOUTS:
            assert run(root / layout, layout, 5, 1, "--streets-of", 2).exit_code == 0
    return root


def test_scans_and_drive_are_the_same_and_any_scan_can_be_had_alone():
    several = list(scans(2, 3, TINY))
    for i, (scan, (frame, truth)) in enumerate(zip(several, drive(2, 3, TINY))):
        alone = scan_at(2, i, TINY)
        assert scan.frame.xyz.tobytes() == frame.xyz.tobytes() == alone.frame.xyz.tobytes()
        assert np.array_equal(scan.semantic, alone.semantic)
        assert truth.extras == scan.truth.extras == alone.truth.extras
    assert np.array_equal(several[0].pose, np.eye(4)) and several[2].pose[0, 3] > 0


def test_columns_of_a_scan_fit_its_points():
    scan = scan_at(5, 7, TINY)
    xyz, n = scan.frame.xyz.astype(float), len(scan.frame)
    assert {scan.semantic.dtype, scan.instance.dtype, scan.ring.dtype} == {np.dtype(np.uint16)}
    assert all(len(c) == n for c in (scan.semantic, scan.instance, scan.ring, scan.time))
    elevation = np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1]))
    off = np.abs(elevation - np.array(TINY.elevations)[scan.ring])
    assert np.median(off) < 0.01  # beams start a little above each other, and the sensor moves
    assert scan.time.dtype == np.float32 and np.ptp(scan.time) < 1 / TINY.rate
    ahead = (np.abs(xyz[:, 1]) < 0.1) & (xyz[:, 0] > 0)
    assert np.abs(scan.time[ahead]).max() < 0.01  # the stamp is when the sensor looks ahead
    assert scan.instance[np.isin(scan.semantic, (40, 48, 50, 70, 72, 80))].max() == 0
    things = scan.instance > 0
    assert np.isin(scan.semantic[things], [*THINGS, *MOVING, 99]).all()  # 99: what one carries
    assert np.isin(scan.semantic, list(MOVING)).any() and (scan.semantic == 10).any()
    for box, extra in zip(scan.truth.boxes, scan.truth.extras):
        own = scan.instance == extra["track_id"]
        assert own.sum() == extra["num_points"]
        assert points_in_box(xyz[own], box, margin=1.0).all()  # what moves, mirrors, umbrellas


def test_object_layout_reads_back(made):
    recording = open_recording(kitti=made / "kitti")
    assert recording.count == 5
    for number, recorded in enumerate(recording):
        scan = scan_at(3 + number // 2, number % 2, TINY)
        order = np.argsort(scan.ring, kind="stable")
        assert recorded.name == f"{number:06}"
        assert np.array_equal(recorded.frame.xyz, scan.frame.xyz[order])
        assert np.array_equal(recorded.frame.intensity, scan.frame.intensity[order])
        assert np.allclose(recorded.camera.projection, FORWARD_CAMERA.camera().projection)
        assert (recorded.camera.width, recorded.camera.height) == (1242, 375)
        same_objects(recorded.truth, kitti_labels(scan.truth), 0.0051)


def test_what_is_hidden_or_nearly_so_is_not_labelled_but_marked():
    scan = scan_at(33, 0, SENSORS["hdl64e"], CROWDED)
    seen, labels = write_kitti.seen_by_camera(scan.truth, FORWARD_CAMERA), kitti_labels(scan.truth)
    assert 0 < len(labels) < len(seen) == len(labels) + len(labels.notes)
    assert all(e["num_points"] >= 5 and e["visible"] >= 0.15 for e in labels.extras)
    kept = {e["track_id"] for e in labels.extras}
    left_out = [e for e in seen.extras if e["track_id"] not in kept]
    assert all(e["num_points"] < 5 or e["visible"] < 0.15 for e in left_out)
    assert [e["bbox"] for e in left_out] == [note["bbox"] for _, note in labels.notes]


def test_tracking_layout_reads_back(made):
    frames = open_kitti(made / "kitti-tracking")
    assert [f.name for f in frames] == ["0000/000000", "0000/000001", "0001/000000", "0001/000001",
                                        "0002/000000"]
    for number, recorded in enumerate(open_recording(kitti=made / "kitti-tracking")):
        scan = scan_at(3 + number // 2, number % 2, TINY)
        expected = kitti_labels(scan.truth)
        same_objects(recorded.truth, expected, 6e-7, truncation=0.26)
        assert ([e["track_id"] for e in recorded.truth.extras]
                == [e["track_id"] for e in expected.extras])


def same_objects(found, expected, accuracy, truncation=None):
    """Equal up to the digits of the text."""
    assert found.labels == expected.labels
    assert [name for name, _ in found.notes] == [name for name, _ in expected.notes]
    for (_, a), (_, b) in zip(found.notes, expected.notes):
        assert a["bbox"] == pytest.approx(b["bbox"], abs=accuracy)
    assert np.abs(found.boxes - expected.boxes)[:, :6].max(initial=0) <= 1.6 * accuracy
    turned = wrap_angle(found.boxes[:, 6] - expected.boxes[:, 6])
    assert np.abs(turned).max(initial=0) <= accuracy
    for a, b in zip(found.extras, expected.extras):
        scale = 2 if truncation else 1  # a level in the tracking layout
        assert abs(a["truncated"] / scale - b["truncated"]) <= (truncation or accuracy)
        assert a["occluded"] == b["occluded"]
        assert np.allclose(a["bbox"], b["bbox"], atol=accuracy)


def test_semantickitti_layout_reads_back(made):
    root = made / "semantickitti"
    frames = open_semantic_kitti(root)
    assert [f.name for f in frames] == ["00/000000", "00/000001", "01/000000", "01/000001",
                                        "02/000000"]
    for number, frame in enumerate(frames):
        scan = scan_at(3 + number // 2, number % 2, TINY)
        order = np.argsort(scan.ring, kind="stable")
        read, semantic, instance = frame.load()
        assert np.array_equal(read.xyz, scan.frame.xyz[order])
        assert np.array_equal(semantic, scan.semantic[order])
        assert np.array_equal(instance, scan.instance[order])
    for sequence in range(2):
        folder = root / f"sequences/{sequence:02}"
        calibration = dict(line.split(": ") for line in
                           (folder / "calib.txt").read_text().splitlines())
        to_camera = np.vstack([np.fromstring(calibration["Tr"], sep=" ").reshape(3, 4),
                               [0, 0, 0, 1]])
        poses = np.loadtxt(folder / "poses.txt").reshape(-1, 3, 4)
        assert np.loadtxt(folder / "times.txt").tolist() == [0.0, 0.1]
        for moment, pose in enumerate(poses):  # as SemanticKITTI's own tools do
            pose = np.linalg.inv(to_camera) @ np.vstack([pose, [0, 0, 0, 1]]) @ to_camera
            assert np.allclose(pose, scan_at(3 + sequence, moment, TINY).pose, atol=1e-9)


def test_a_bag_goes_on_with_the_next_street(tmp_path):
    result = run(tmp_path / "bag", "mcap", 4, 1, "--streets-of", 2)
    assert result.exit_code == 0, result.output
    recording = list(open_recording(bag=tmp_path / "bag"))
    for number, recorded in enumerate(recording):
        scan = scan_at(3 + number // 2, number % 2, TINY)
        assert np.array_equal(recorded.frame.xyz, scan.frame.xyz)
    stamps = [r.frame.stamp_ns for r in recording]
    assert np.diff(stamps).tolist() == [10**8, 101 * 10**8, 10**8]


def test_2d_boxes_are_those_of_the_corners_in_the_image():
    rng = np.random.default_rng(0)
    boxes = np.column_stack([rng.uniform(-10, 60, 300), rng.uniform(-20, 20, 300),
                             rng.uniform(-2, 1, 300), rng.uniform(0.3, 6, (300, 3)),
                             rng.uniform(-4, 4, 300)])
    found, outside = write_kitti.image_boxes(boxes, FORWARD_CAMERA)
    seen = np.isfinite(found[:, 0])
    assert 30 < seen.sum() < 250 and ((outside >= 0) & (outside <= 1)).all()
    assert (found[seen] >= 0).all() and (found[seen] <= [1241, 374, 1241, 374]).all()
    projection = FORWARD_CAMERA.camera().projection
    corners = box_corners(boxes) @ projection[:, :3].T + projection[:, 3]
    whole = (corners[..., 2] > write_kitti.NEAR).all(axis=1)
    pixels = corners[..., :2] / corners[..., 2:]
    inside = whole & ((pixels >= 0) & (pixels <= [1241, 374])).all(axis=(1, 2)) & seen
    assert inside.sum() > 10 and np.abs(outside[inside]).max() < 1e-9
    assert np.allclose(found[inside], np.concatenate([pixels[inside].min(axis=1),
                                                      pixels[inside].max(axis=1)], axis=1))
    # Many points of a box that reaches behind the camera: none in the image is outside its 2D box.
    for box, limits in zip(boxes[~whole & seen], found[~whole & seen]):
        inner = (rng.uniform(-0.5, 0.5, (4000, 3)) * box[3:6])
        cos, sin = np.cos(box[6]), np.sin(box[6])
        points = inner @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]]) + box[:3]
        p = points @ projection[:, :3].T + projection[:, 3]
        p = p[p[:, 2] > write_kitti.NEAR]
        uv = np.clip(p[:, :2] / p[:, 2:], 0, [1241, 374])
        assert (uv >= limits[:2] - 1e-6).all() and (uv <= limits[2:] + 1e-6).all()


def test_2d_boxes_are_those_of_real_labels(data):
    worst, shares = [], []
    for frame in open_kitti(data / "kitti_object"):
        truth = frame.truth()
        boxes, outside = write_kitti.image_boxes(truth.boxes, frame.calibration())
        for box, share, extra in zip(boxes, outside, truth.extras):
            worst.append(np.abs(box - extra["bbox"]).max())
            shares.append(abs(share - extra["truncated"]))
    assert np.median(worst) < 0.5 and np.max(shares) < 0.07


def test_labels_without_objects_read_back(tmp_path):
    nothing = scan_at(3, 0, TINY).truth
    nothing = type(nothing).of([], [])
    write_kitti.write_object(tmp_path, 0, np.zeros((0, 4)), nothing, FORWARD_CAMERA)
    assert len(read_object_labels(tmp_path / "training/label_2/000000.txt", np.eye(4))) == 0
    text = write_kitti.tracking_label_text(0, nothing, FORWARD_CAMERA)
    (tmp_path / "0000.txt").write_text(text)
    assert read_tracking_labels(tmp_path / "0000.txt", np.eye(4)) == {}


@pytest.mark.parametrize("layout", ["kitti", "semantickitti"])
def test_the_number_of_processes_changes_no_byte(made, tmp_path, layout):
    result = run(tmp_path / "two", layout, 5, 2, "--streets-of", 2)
    assert result.exit_code == 0, result.output
    expected = content(made / layout)
    assert content(tmp_path / "two") == expected
    record = json.loads(expected["dataset.json"])
    assert record.items() >= {"format": layout, "sensor": "tiny", "seed": 3, "frames": 5,
                              "streets_of": 2}.items()
    assert "simulate" in record["command"] and record["version"]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_data_set_that_failed_in_the_middle_is_marked_and_resumed(made, tmp_path, monkeypatch,
                                                                     layout):
    out, calls = tmp_path / "set", itertools.count()

    def fails(*args):
        if next(calls) == 3:
            raise ZeroDivisionError
        return scan_at(*args)

    with monkeypatch.context() as patch, pytest.raises(ZeroDivisionError):
        patch.setattr(dataset, "scan_at", fails)
        run(out, layout, 5, 1, "--streets-of", 2)
    assert json.loads((out / "INCOMPLETE").read_text())["frames"] == 5
    assert not (out / "dataset.json").exists()
    result = run(out, layout, 5, 1, "--streets-of", 2, "--resume")
    assert result.exit_code == 0 and "3 of them from before" in result.output
    assert content(out) == content(made / layout)
    again = run(out, layout, 5, 1, "--streets-of", 2, "--resume")
    assert again.exit_code == 0 and "nothing to do" in again.output
    assert content(out) == content(made / layout)


def start(out, frames, *more):
    """The command in a process group of its own, once it has finished a few frames."""
    process = subprocess.Popen(
        [sys.executable, "-c", SCRIPT, "simulate",
         *arguments(out, "kitti-tracking", frames, 2, *more)],
        cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, start_new_session=True, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    while len(list(out.glob(".parts/*.json"))) < 3:
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.01)
    return process


def wait_for_the_end(group):
    """Until no process of the group is left."""
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return
        time.sleep(0.02)
    pytest.fail("a process is still there")


def test_after_a_kill_nothing_runs_on_and_it_goes_on_where_it_was(tmp_path):
    out, frames = tmp_path / "set", 80
    process = start(out, frames, "--streets-of", 50)
    os.kill(process.pid, signal.SIGKILL)  # its children end by themselves
    process.wait()
    wait_for_the_end(process.pid)
    assert "Traceback" not in process.communicate()[1]
    assert (out / "INCOMPLETE").exists()
    (out / "training/velodyne/0000/.000299.bin.1.tmp").write_bytes(b"half")  # as a kill leaves it
    assert 3 <= len(list(out.glob(".parts/*.json"))) < frames
    again = run(out, "kitti-tracking", frames, 2, "--streets-of", 50, "--resume")
    assert again.exit_code == 0
    assert run(tmp_path / "whole", "kitti-tracking", frames, 1, "--streets-of", 50).exit_code == 0
    assert content(out) == content(tmp_path / "whole")
    assert len(open_kitti(out)) == frames
    assert len(list(out.glob("training/label_02/*.txt"))) == 2


def test_two_writers_do_not_meet_and_ctrl_c_ends_all_processes(tmp_path):
    process = start(tmp_path / "set", 100_000)
    for more in (["--resume"], ["--force"], []):
        with pytest.raises(InputError, match="another process"):
            run(tmp_path / "set", "kitti-tracking", 100_000, 2, *more)
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    wait_for_the_end(process.pid)
    assert process.returncode not in (0, None) and "Traceback" not in errors
    assert (tmp_path / "set/INCOMPLETE").exists()
    assert not list((tmp_path / "set").rglob("dataset.json"))


@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_a_full_disk_is_one_line_and_exit_code_1(made, tmp_path, monkeypatch, call):
    out, calls, real = tmp_path / "set", itertools.count(), getattr(os, call)

    def full(*args, **others):
        if next(calls) >= 6:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return real(*args, **others)

    with monkeypatch.context() as patch:
        patch.setattr(os, call, full)
        result = run(out, "kitti", 5, 1, "--streets-of", 2)
    assert result.exit_code == 1
    assert "No space left on device" in result.output and "--resume" in result.output
    assert len(result.output.strip().splitlines()) == 1
    assert (out / "INCOMPLETE").exists() and not list(out.rglob(".*.tmp"))
    assert run(out, "kitti", 5, 1, "--streets-of", 2, "--resume").exit_code == 0
    assert content(out) == content(made / "kitti")


def test_a_process_that_cannot_write_ends_the_others_too(tmp_path):
    blocked = tmp_path / "set/training/velodyne/000003.bin"
    run(tmp_path / "set", "kitti", 5)
    (tmp_path / "set/dataset.json").rename(tmp_path / "set/INCOMPLETE")  # .parts is gone already
    blocked.unlink()
    blocked.mkdir()
    result = run(tmp_path / "set", "kitti", 5, 2, "--resume")
    assert result.exit_code == 1 and "cannot write" in result.output
    assert "000003.bin" in result.output and (tmp_path / "set/INCOMPLETE").exists()


def test_what_is_there_is_not_touched_without_a_word(made, tmp_path):
    out = tmp_path / "set"
    assert run(out, "kitti", 2).exit_code == 0
    before = content(out)
    with pytest.raises(InputError, match="exists already"):
        run(out, "kitti", 3)
    with pytest.raises(InputError, match="was begun with frames 2, not 3"):
        run(out, "kitti", 3, 1, "--resume")
    assert content(out) == before
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/letter.txt").write_text("dear")
    for flag in ("--resume", "--force"):
        with pytest.raises(InputError, match="no simulated data set"):
            run(tmp_path / "mine", "kitti", 2, 1, flag)
    assert content(tmp_path / "mine") == {"letter.txt": b"dear"}
    with pytest.raises(InputError, match="is a file"):
        run(tmp_path / "mine/letter.txt", "kitti", 2, 1, "--force")
    assert run(out, "semantickitti", 5, 1, "--streets-of", 2, "--force").exit_code == 0
    assert content(out) == content(made / "semantickitti")


def test_resume_names_every_difference(tmp_path, monkeypatch):
    out = tmp_path / "set"
    with monkeypatch.context() as patch, pytest.raises(ZeroDivisionError):
        patch.setattr(dataset, "scan_at", lambda *_: 1 / 0)
        run(out)
    with pytest.raises(InputError, match=r"format 'kitti', not 'semantickitti'; streets_of 1") as e:
        run(out, "semantickitti", 5, 1, "--resume")
    assert "\n" not in str(e.value)
    (out / "INCOMPLETE").write_text("{")
    with pytest.raises(InputError, match="cannot read"):
        run(out, "kitti", 5, 1, "--resume")
    assert run(out, "kitti", 5, 1, "--force").exit_code == 0


@pytest.mark.parametrize("options, said", [
    (["--sensor", "hdl65"], "unknown sensor 'hdl65': must be one of hdl64e"),
    (["--format", "pcap"], "pcap"), (["--frames", "0"], "0 is not in the range"),
    (["--seed", "-1"], "-1 is not in the range"), (["--streets-of", "201"], "1 .. 200"),
    (["--resume", "--force"], "one of them"), (["--format", "mcap", "--resume"], "convert kitti")])
def test_bad_arguments_are_named(tmp_path, options, said):
    arguments = ["--out", str(tmp_path / "set"), "--format", "kitti", *options]
    result = CliRunner().invoke(simulate, arguments)
    text = result.output + str(result.exception)
    assert result.exit_code != 0 and said in text
    assert isinstance(result.exception, SystemExit | InputError)
    assert not (tmp_path / "set").exists()


def test_training_scans_are_the_streets_in_order():
    for street, batch in zip((4, 5, 6), training_scans(4, TINY)):
        scan = scan_at(street, 0, TINY)
        assert batch["points"].dtype == batch["boxes"].dtype == torch.float32
        assert np.array_equal(batch["points"][:, :3], scan.frame.xyz)
        assert np.array_equal(batch["points"][:, 3], scan.frame.intensity)
        assert np.allclose(batch["boxes"], scan.truth.boxes)
        assert batch["class_ids"].tolist() == scan.truth.class_ids.tolist()
        assert batch["num_points"].tolist() == [e["num_points"] for e in scan.truth.extras]


class Streets(torch.utils.data.IterableDataset):
    """What a user writes for a DataLoader."""

    def __iter__(self):
        return itertools.islice(training_scans(4, TINY), 2)


def test_workers_of_a_loader_share_the_streets():
    loader = torch.utils.data.DataLoader(Streets(), batch_size=None, num_workers=2)
    found = sorted(batch["points"].numpy().tobytes() for batch in loader)
    alone = itertools.islice(training_scans(4, TINY), 4)
    assert found == sorted(batch["points"].numpy().tobytes() for batch in alone)
