"""Laws of how a training starts: what is refused, planned, kept, and resumed after a kill."""

from __future__ import annotations

import json
import multiprocessing
import shutil
import signal
import time
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner
from samples import object_folder, scene, walker_label, write

from lidar_perception.cli.main import cli
from lidar_perception.detectors.checkpoint import read_header, save_header
from lidar_perception.detectors.pointnet.params import PointNetParams
from lidar_perception.detectors.pointnet.weights_file import weights_file
from lidar_perception.runs import terminal
from lidar_perception.runs.resuming import locked
from lidar_perception.training import start as start_module
from lidar_perception.training.out import RUN, STATE, alone
from lidar_perception.types import SENSOR_HEIGHT, InputError

pytestmark = pytest.mark.usefixtures("streets")
SENSOR = "generic:16,-20,5,2,10"


def words(out: Path, *more: str) -> list[str]:
    """A training that is small in every way."""
    return ["train", "pointpillars", "--version", "v0", "--ahead", "10", "--aside", "10", "--data",
            "sim", "--data-people", "3", "--sensor", SENSOR, "--data-scans", "6",
            "--data-val-scans", "1", "--steps", "4", "--validate-steps", "4", "--save-steps", "1",
            "--batch", "1", "--jobs", "0", "--out", str(out), *more]


def killed_when(condition, *arguments: str) -> None:
    """Begin a training in a copy of this process, which has torch already, and kill it when
    condition() holds."""
    process = multiprocessing.get_context("fork").Process(target=cli.main, args=(arguments,))
    process.start()
    end = time.monotonic() + 240
    while not condition():
        assert process.is_alive(), f"the training ended with code {process.exitcode}"
        assert time.monotonic() < end
        time.sleep(0.002)
    process.kill()
    process.join()


def tensors(out: Path) -> bytes:
    """All but the header, which says how long it took."""
    content = (out / "last.safetensors").read_bytes()
    return content[8 + int.from_bytes(content[:8], "little"):]


def test_killed_in_the_preparation_and_in_the_steps_it_ends_as_if_it_had_not_been(
        tmp_path, one_thread):
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    unbroken = CliRunner().invoke(cli, words(whole, "--jobs", "2"))
    assert unbroken.exit_code == 0, unbroken.exception
    lines = unbroken.stderr.splitlines()
    assert "6 street scans of generic" in lines[1] and "4 steps of 1 scenes" in lines[1]
    assert "simulating" in lines[2] and "validation" in lines[2]

    scans = broken / "scans"
    killed_when(lambda: len(list(scans.glob("*.npz"))) >= 2, *words(broken))
    assert not (broken / STATE).exists()
    before = {path: path.stat().st_mtime_ns for path in scans.rglob("*.npz")}
    refused = CliRunner().invoke(cli, words(broken))
    assert isinstance(refused.exception, InputError) and "--resume" in str(refused.exception)
    killed_when((broken / STATE).exists, *words(broken, "--resume"))
    assert {path: path.stat().st_mtime_ns for path in before} == before  # not made again
    assert CliRunner().invoke(cli, words(broken, "--resume")).exit_code == 0
    assert tensors(broken) == tensors(whole)
    kept = {path.relative_to(broken): path.read_bytes() for path in broken.rglob("*.npz")}
    assert kept == {path.relative_to(whole): path.read_bytes() for path in whole.rglob("*.npz")}


def refuse(tmp_path: Path, *more: str) -> str:
    """What the command says in one line of input that it refuses; nothing is made."""
    result = CliRunner().invoke(cli, ["train", "pointnet", "--data", "sim", "--out",
                                      str(tmp_path / "run"), *more])
    assert result.exception is not None and not isinstance(result.exception, SystemExit)
    assert not list(tmp_path.glob("run/scans/*")) and not (tmp_path / "run" / RUN).exists()
    line = str(result.exception)
    assert "\n" not in line
    return line


def test_a_run_is_written_by_one_process_at_a_time(tmp_path):
    with locked(tmp_path / "run"):
        assert "another process" in refuse(tmp_path, "--resume", "--sensor", SENSOR)


@pytest.mark.parametrize("more", [[], ["--resume"]])
def test_weights_of_no_run_in_out_are_not_replaced(tmp_path, more):
    weights = tmp_path / "run/best.safetensors"
    weights.parent.mkdir()
    shutil.copy(weights_file(PointNetParams()), weights)
    assert "would be replaced" in refuse(tmp_path, "--init", str(weights), *more)


def test_only_what_a_killed_run_was_writing_is_removed(tmp_path):
    ours = [".last.pt.7-1.tmp", "scans/.ab.npz.7-1.tmp", "scans/clusters/.ab.npz.7-2.tmp"]
    theirs = ["notes/.draft.tmp", ".draft.tmp", ".draft.7-1.tmp", "notes/.last.pt.7-1.tmp"]
    for name in (*ours, *theirs):
        write(tmp_path / name, "half")
    with alone(tmp_path):
        assert {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.tmp")} == {*theirs}


@pytest.mark.parametrize("hours", ["0", "-1", "nan", "inf"])
def test_a_budget_that_is_none_is_refused(hours, tmp_path):
    assert "--budget" in refuse(tmp_path, "--budget", hours)


@pytest.mark.parametrize("content, reason", [
    ("elevations: [3, 2, 400]\nazimuth_step: 0.2\nrate: 10\n", "elevations"),
    ("elevations: [3]\nazimuth_step: 0\nrate: 10\n", "azimuth_step"),
    ("beams: 4\n", "beams"),
])
def test_a_sensor_that_cannot_be_is_refused(content, reason, tmp_path):
    path = write(tmp_path / "robot.yaml", content)
    assert reason in refuse(tmp_path, "--sensor", str(path))


def test_a_mount_that_cannot_be_is_refused(tmp_path):
    assert "mount_height" in refuse(tmp_path, "--mount-height", "-1")


def test_a_disk_without_room_is_refused_before_anything_is_simulated(tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(start_module.shutil, "disk_usage",
                        lambda _: usage._replace(free=5 * 10**8))
    line = refuse(tmp_path, "--sensor", SENSOR, "--data-scans", "1000", "--steps", "1")
    assert "GB are free" in line and "--data-scans" in line


def test_the_plan_is_kept_and_other_settings_are_no_resumed_run(tmp_path, one_thread):
    out = tmp_path / "run"
    sensor = write(tmp_path / "robot.yaml",
                   "elevations: [2, -3, -8, -13, -18]\nazimuth_step: 1.5\nrate: 10\nheight: 0.9\n")
    asked = ["train", "pointnet", "--data", "sim", "--sensor", str(sensor), "--data-scans", "2",
             "--data-val-scans", "1", "--steps", "2", "--batch", "1", "--jobs", "0", "--init",
             "package", "--out", str(out)]
    assert CliRunner().invoke(cli, [*asked, "--mount-height", "0.6"]).exit_code == 0
    said = read_header(out / "last.safetensors").training
    assert said["sensor"] == {"name": str(sensor), "height": 0.6, "beams": 5}
    header = read_header(out / "last.safetensors")
    assert header.unlike(0.7) is None and "at 0.6 m, and used with one at 1.73 m" in header.unlike(
        1.73)
    plan = json.loads((out / RUN).read_text())["plan"]
    assert (plan["scans"], plan["steps"]) == (2, 2)
    other = CliRunner().invoke(cli, [*asked, "--resume"])
    assert "0.9" in str(other.exception) and "0.6" in str(other.exception)
    again = [*asked, "--mount-height", "0.6", "--resume", "--budget", "7"]
    assert CliRunner().invoke(cli, again).exit_code == 0


def small_run(kind: str, out: Path, root: Path, *more: str):
    """A step on a folder of KITTI, validated."""
    return CliRunner().invoke(cli, ["train", kind, *(("--version", "v0", "--ahead", "10", "--aside",
                                    "10") if kind == "pointpillars" else ()), "--data", str(root),
                                    "--steps", "1", "--batch", "1", "--jobs", "0", "--out",
                                    str(out), *more])


@pytest.mark.parametrize("kind", ["pointpillars", "pointnet"])
def test_what_cannot_be_used_is_passed_over_wherever_it_lies(kind, tmp_path, one_thread):
    """The first scene to train on, and the first frames to validate on: cut, without a label, with
    nothing in it."""
    root = object_folder(tmp_path / "kitti", walker_label() + "\n", 6) / "training"
    for number in (0, 2):
        write(root / f"velodyne/{number:06}.bin", b"cut")
    (root / "label_2/000003.txt").unlink()
    for number in (1, 4):
        write(root / f"velodyne/{number:06}.bin", scene()[:1000])  # the ground alone
        write(root / f"label_2/{number:06}.txt", "")
    held = write(tmp_path / "val.txt", "000002\n000003\n000004\n")
    done = small_run(kind, tmp_path / "run", root, "--val-split", str(held))
    assert done.exit_code == 0, done.exception
    assert done.stderr.count("validation: ") == 2
    header = read_header(tmp_path / "run/last.safetensors")
    assert header.training["sensor"] == {"height": SENSOR_HEIGHT}  # no sensor was simulated
    assert header.unlike(SENSOR_HEIGHT) is None and "for a sensor at 1.73" in header.unlike(0.6)
    write(held, "000002\n000003\n")
    refused = small_run(kind, tmp_path / "other", root, "--val-split", str(held)).exception
    assert isinstance(refused, InputError) and "\n" not in str(refused)
    assert "no frame to validate on can be used" in str(refused) and "000002.bin" in str(refused)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("part", ["_settle", "_prepare"])
def test_a_preparation_that_is_stopped_says_how_it_goes_on(tmp_path, monkeypatch, part, number):
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # as in test_training.py
    monkeypatch.setattr(start_module, part, lambda *_: signal.raise_signal(number))
    try:
        result = CliRunner().invoke(cli, words(tmp_path / "run"))
    finally:
        signal.signal(signal.SIGINT, before)
    assert result.exit_code == 130 and "--resume goes on" in result.stderr
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_a_run_is_not_resumed_with_other_frames_or_weights_under_the_same_names(tmp_path,
                                                                                monkeypatch):
    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(start_module, "_prepare", stop)
    split = write(tmp_path / "split.txt", "000000\n000001\n000002\n")
    init = Path(shutil.copy(weights_file(PointNetParams()), tmp_path / "init.safetensors"))
    asked = ["train", "pointnet", "--data", str(object_folder(tmp_path / "kitti", count=5)),
             "--split", str(split), "--init", str(init), "--steps", "2", "--jobs", "0",
             "--out", str(tmp_path / "run"), "--resume"]

    def said() -> str:
        return str(CliRunner().invoke(cli, asked).exception)

    assert "holds a run" not in said() + said()
    write(split, "000000\n000001\n000003\n")
    assert "frame_names" in said() and "init" not in said()
    write(split, "000000\n000001\n000002\n")
    save_header(init, replace(read_header(init), commit="another"))
    assert "init_weights" in said() and "frame" not in said()


def test_where_there_is_no_terminal_progress_comes_line_by_line(monkeypatch, capsys):
    monkeypatch.setattr(terminal, "EVERY", 0.0)
    assert list(terminal.track(iter("abc"), "cutting", 3)) == ["a", "b", "c"]
    lines = capsys.readouterr().err.splitlines()
    assert [line.partition(",")[0] for line in lines] == [
        f"cutting: {i} of 3" for i in (1, 2, 3)]
    assert "left" in lines[-1]
