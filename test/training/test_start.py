"""Start of a training: invalid input, the plan, preparation, and resuming after a kill."""

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
from samples import make_scene, make_walker_label, write_file, write_object_folder

from lidar_perception.cli.main import cli
from lidar_perception.detectors.checkpoint import read_header, save_header
from lidar_perception.detectors.pointnet.params import PointNetParams
from lidar_perception.detectors.weights_file import find_pointnet_weights
from lidar_perception.runs import terminal
from lidar_perception.runs.resuming import lock_folder
from lidar_perception.training import planning, start
from lidar_perception.training.run_directory import RUN, STATE, RunDirectory
from lidar_perception.types import SENSOR_HEIGHT, InputError

pytestmark = pytest.mark.usefixtures("streets")
SENSOR = "generic:16,-20,5,2,10"


def small_training(out: Path, *more: str) -> list[str]:
    """Return the arguments of a very small training."""
    return [
        "train",
        "pointpillars",
        "--version",
        "v0",
        "--ahead",
        "10",
        "--aside",
        "10",
        "--data",
        "sim",
        "--data-people",
        "3",
        "--sensor",
        SENSOR,
        "--data-scans",
        "6",
        "--data-val-scans",
        "1",
        "--steps",
        "4",
        "--validate-steps",
        "4",
        "--save-steps",
        "1",
        "--batch",
        "1",
        "--jobs",
        "0",
        "--out",
        str(out),
        *more,
    ]


def kill_when(condition, *arguments: str) -> None:
    """Start a training run in a fork of this process, which has imported torch; kill it once condition() is true."""
    process = multiprocessing.get_context("fork").Process(target=cli.main, args=(arguments,))
    process.start()
    end = time.monotonic() + 240
    while not condition():
        assert process.is_alive(), f"the training ended with code {process.exitcode}"
        assert time.monotonic() < end
        time.sleep(0.002)
    process.kill()
    process.join()


def read_tensors(out: Path) -> bytes:
    """Return the tensors without the header, which contains durations."""
    content = (out / "last.safetensors").read_bytes()
    return content[8 + int.from_bytes(content[:8], "little") :]


def test_run_killed_twice_equals_uninterrupted_run(tmp_path, one_thread):
    complete_run, killed_run = tmp_path / "whole", tmp_path / "broken"
    unbroken = CliRunner().invoke(cli, small_training(complete_run, "--jobs", "2"))
    assert unbroken.exit_code == 0, unbroken.exception
    lines = unbroken.stderr.splitlines()
    assert "6 street scans of generic" in lines[1] and "4 steps of 1 scenes" in lines[1]
    assert "simulating" in lines[2] and "validation" in lines[2]

    scans = killed_run / "scans"
    kill_when(lambda: len(list(scans.glob("*.npz"))) >= 2, *small_training(killed_run))
    assert not (killed_run / STATE).exists()
    before = {path: path.stat().st_mtime_ns for path in scans.rglob("*.npz")}
    rejected_run = CliRunner().invoke(cli, small_training(killed_run))
    assert isinstance(rejected_run.exception, InputError) and "--resume" in str(rejected_run.exception)
    kill_when((killed_run / STATE).exists, *small_training(killed_run, "--resume"))
    assert {path: path.stat().st_mtime_ns for path in before} == before  # not rewritten
    assert CliRunner().invoke(cli, small_training(killed_run, "--resume")).exit_code == 0
    assert read_tensors(killed_run) == read_tensors(complete_run)
    cached = {path.relative_to(killed_run): path.read_bytes() for path in killed_run.rglob("*.npz")}
    assert cached == {path.relative_to(complete_run): path.read_bytes() for path in complete_run.rglob("*.npz")}


def refuse(tmp_path: Path, *more: str) -> str:
    """Return the one-line error for invalid input; nothing may be written."""
    result = CliRunner().invoke(cli, ["train", "pointnet", "--data", "sim", "--out", str(tmp_path / "run"), *more])
    assert result.exception is not None and not isinstance(result.exception, SystemExit)
    assert not list(tmp_path.glob("run/scans/*")) and not (tmp_path / "run" / RUN).exists()
    line = str(result.exception)
    assert "\n" not in line
    return line


def test_run_directory_is_locked(tmp_path):
    with lock_folder(tmp_path / "run"):
        assert "another process" in refuse(tmp_path, "--resume", "--sensor", SENSOR)


@pytest.mark.parametrize("more", [[], ["--resume"]])
def test_run_that_would_replace_other_weights_is_rejected(tmp_path, more):
    weights = tmp_path / "run/best.safetensors"
    weights.parent.mkdir()
    shutil.copy(find_pointnet_weights(PointNetParams()), weights)
    assert "would be replaced" in refuse(tmp_path, "--init", str(weights), *more)


def test_only_temporary_files_of_killed_run_are_removed(tmp_path):
    own_files = [".last.pt.7-1.tmp", "scans/.ab.npz.7-1.tmp", "scans/clusters/.ab.npz.7-2.tmp"]
    other_files = ["notes/.draft.tmp", ".draft.tmp", ".draft.7-1.tmp", "notes/.last.pt.7-1.tmp"]
    for name in (*own_files, *other_files):
        write_file(tmp_path / name, "half")
    with RunDirectory(tmp_path).lock():
        assert {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.tmp")} == {*other_files}


@pytest.mark.parametrize("hours", ["0", "-1", "nan", "inf"])
def test_bad_budget_is_rejected(hours, tmp_path):
    assert "--budget" in refuse(tmp_path, "--budget", hours)


@pytest.mark.parametrize(
    "content, reason",
    [
        ("elevations: [3, 2, 400]\nazimuth_step: 0.2\nrate: 10\n", "elevations"),
        ("elevations: [3]\nazimuth_step: 0\nrate: 10\n", "azimuth_step"),
        ("beams: 4\n", "beams"),
    ],
)
def test_bad_sensor_file_is_rejected(content, reason, tmp_path):
    path = write_file(tmp_path / "robot.yaml", content)
    assert reason in refuse(tmp_path, "--sensor", str(path))


def test_bad_mount_height_is_rejected(tmp_path):
    assert "mount_height" in refuse(tmp_path, "--mount-height", "-1")


def test_full_disk_is_reported_before_simulation(tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(planning.shutil, "disk_usage", lambda _: usage._replace(free=5 * 10**8))
    line = refuse(tmp_path, "--sensor", SENSOR, "--data-scans", "1000", "--steps", "1")
    assert "GB are free" in line and "--data-scans" in line


def test_resumed_run_keeps_plan_and_rejects_other_settings(tmp_path, one_thread):
    out = tmp_path / "run"
    sensor = write_file(
        tmp_path / "robot.yaml", "elevations: [2, -3, -8, -13, -18]\nazimuth_step: 1.5\nrate: 10\nheight: 0.9\n"
    )
    arguments = [
        "train",
        "pointnet",
        "--data",
        "sim",
        "--sensor",
        str(sensor),
        "--data-scans",
        "2",
        "--data-val-scans",
        "1",
        "--steps",
        "2",
        "--batch",
        "1",
        "--jobs",
        "0",
        "--init",
        "package",
        "--out",
        str(out),
    ]
    assert CliRunner().invoke(cli, [*arguments, "--mount-height", "0.6"]).exit_code == 0
    record = read_header(out / "last.safetensors").training
    assert record["sensor"] == {"name": str(sensor), "height": 0.6, "beams": 5}
    header = read_header(out / "last.safetensors")
    assert header.find_height_mismatch(0.7) is None
    assert "at 0.6 m, but used with a sensor at 1.73 m" in header.find_height_mismatch(1.73)
    plan = json.loads((out / RUN).read_text())["plan"]
    assert (plan["scans"], plan["steps"]) == (2, 2)
    other = CliRunner().invoke(cli, [*arguments, "--resume"])
    assert "0.9" in str(other.exception) and "0.6" in str(other.exception)
    resume_arguments = [*arguments, "--mount-height", "0.6", "--resume", "--budget", "7"]
    assert CliRunner().invoke(cli, resume_arguments).exit_code == 0


def small_run(kind: str, out: Path, root: Path, *more: str):
    """Train one step on a KITTI folder and validate."""
    return CliRunner().invoke(
        cli,
        [
            "train",
            kind,
            *(("--version", "v0", "--ahead", "10", "--aside", "10") if kind == "pointpillars" else ()),
            "--data",
            str(root),
            "--steps",
            "1",
            "--batch",
            "1",
            "--jobs",
            "0",
            "--out",
            str(out),
            *more,
        ],
    )


@pytest.mark.parametrize("kind", ["pointpillars", "pointnet"])
def test_unusable_first_scenes_are_skipped(kind, tmp_path, one_thread):
    """The first scenes are truncated, empty, or lack a label file."""
    root = write_object_folder(tmp_path / "kitti", make_walker_label() + "\n", 6) / "training"
    for number in (0, 2):
        write_file(root / f"velodyne/{number:06}.bin", b"cut")
    (root / "label_2/000003.txt").unlink()
    for number in (1, 4):
        write_file(root / f"velodyne/{number:06}.bin", make_scene()[:1000])  # only ground
        write_file(root / f"label_2/{number:06}.txt", "")
    held = write_file(tmp_path / "val.txt", "000002\n000003\n000004\n")
    done = small_run(kind, tmp_path / "run", root, "--val-split", str(held))
    assert done.exit_code == 0, done.exception
    assert done.stderr.count("validation: ") == 2
    header = read_header(tmp_path / "run/last.safetensors")
    assert header.training["sensor"] == {"height": SENSOR_HEIGHT}  # no sensor was simulated
    assert header.find_height_mismatch(SENSOR_HEIGHT) is None
    assert "for a sensor at 1.73" in header.find_height_mismatch(0.6)
    write_file(held, "000002\n000003\n")
    error = small_run(kind, tmp_path / "other", root, "--val-split", str(held)).exception
    assert isinstance(error, InputError) and "\n" not in str(error)
    assert "no usable validation frame" in str(error) and "000002.bin" in str(error)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("part", ["Planner.make_plan", "fill_cache"])
def test_stopped_preparation_explains_resume(tmp_path, monkeypatch, part, number):
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # as in test_training.py
    monkeypatch.setattr(f"{start.__name__}.{part}", lambda *_: signal.raise_signal(number))
    try:
        result = CliRunner().invoke(cli, small_training(tmp_path / "run"))
    finally:
        signal.signal(signal.SIGINT, before)
    assert result.exit_code == 130 and "continue with --resume" in result.stderr
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_run_is_not_resumed_with_changed_split_or_weights(tmp_path, monkeypatch):
    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(start, "fill_cache", stop)
    split = write_file(tmp_path / "split.txt", "000000\n000001\n000002\n")
    init = Path(shutil.copy(find_pointnet_weights(PointNetParams()), tmp_path / "init.safetensors"))
    arguments = [
        "train",
        "pointnet",
        "--data",
        str(write_object_folder(tmp_path / "kitti", count=5)),
        "--split",
        str(split),
        "--init",
        str(init),
        "--steps",
        "2",
        "--jobs",
        "0",
        "--out",
        str(tmp_path / "run"),
        "--resume",
    ]

    def resume() -> str:
        return str(CliRunner().invoke(cli, arguments).exception)

    assert "contains a run" not in resume() + resume()
    write_file(split, "000000\n000001\n000003\n")
    assert "frame_names" in resume() and "init" not in resume()
    write_file(split, "000000\n000001\n000002\n")
    save_header(init, replace(read_header(init), commit="another"))
    assert "init_weights" in resume() and "frame" not in resume()


def test_progress_is_printed_in_lines_without_a_terminal(monkeypatch, capsys):
    monkeypatch.setattr(terminal, "LOG_INTERVAL_S", 0.0)
    assert list(terminal.show_progress(iter("abc"), "cutting", 3)) == ["a", "b", "c"]
    lines = capsys.readouterr().err.splitlines()
    assert [line.partition(",")[0] for line in lines] == [f"cutting: {i} of 3" for i in (1, 2, 3)]
    assert "left" in lines[-1]
