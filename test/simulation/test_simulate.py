"""The command simulate: files do not depend on processes or interruptions; existing files are kept."""

import contextlib
import errno
import itertools
import json
import os
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from click.testing import CliRunner
from samples import wait_for_the_end
from simulate_samples import make_simulate_arguments, read_files, run_simulate

from lidar_perception.cli.simulate import simulate
from lidar_perception.data.open import open_recording
from lidar_perception.runs import resumable_folder
from lidar_perception.simulation import dataset
from lidar_perception.simulation.dataset import LAYOUTS
from lidar_perception.simulation.drive import simulate_scan
from lidar_perception.types import InputError

pytestmark = pytest.mark.usefixtures("streets", "tiny_sensor")
ROOT = Path(__file__).resolve().parents[2]
SCRIPT = """
from lidar_perception.simulation.sensor import SENSORS, make_generic_sensor
SENSORS["tiny"] = make_generic_sensor(16, -14.0, 3.0, 2.0, 10.0)
from lidar_perception.cli.main import main
main()
"""


def invoke(options):
    result = CliRunner().invoke(simulate, options, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result


def test_data_set_records_its_settings(simulated_data_sets):
    record = json.loads((simulated_data_sets / "semantickitti/dataset.json").read_text())
    assert (
        record.items() >= {"format": "semantickitti", "sensor": "tiny", "seed": 3, "frames": 5, "streets_of": 2}.items()
    )
    assert "simulate" in record["command"] and record["version"]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_failed_data_set_is_marked_and_resumed(simulated_data_sets, tmp_path, monkeypatch, layout):
    out, calls = tmp_path / "set", itertools.count()

    def fails(*args):
        if next(calls) == 3:
            raise ZeroDivisionError
        return simulate_scan(*args)

    with monkeypatch.context() as patch, pytest.raises(ZeroDivisionError):
        patch.setattr(dataset, "simulate_scan", fails)
        run_simulate(out, layout, 5, 1, "--streets-of", 2)
    assert json.loads((out / "INCOMPLETE").read_text())["frames"] == 5
    assert not (out / "dataset.json").exists()
    result = run_simulate(out, layout, 5, 1, "--streets-of", 2, "--resume")
    assert result.exit_code == 0 and "3 of them from the interrupted run" in result.output
    assert read_files(out) == read_files(simulated_data_sets / layout)
    resumed_run = run_simulate(out, layout, 5, 1, "--streets-of", 2, "--resume")
    assert resumed_run.exit_code == 0 and "is already complete" in resumed_run.output
    assert read_files(out) == read_files(simulated_data_sets / layout)


@pytest.fixture
def start():
    """Return a function (out, frames, ...) that starts the command and waits for the first frames.

    All processes are killed at the end of the test.
    """
    groups = []

    def begin(out, frames, *more):
        process = subprocess.Popen(
            [
                sys.executable,
                "-c",
                SCRIPT,
                "simulate",
                *make_simulate_arguments(out, "kitti-tracking", frames, 2, *more),
            ],
            cwd=ROOT,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            start_new_session=True,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            # Background processes of a shell ignore SIGINT.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )
        groups.append(process.pid)
        while len(list(out.glob(".parts/*.json"))) < 3:
            assert process.poll() is None, process.stderr.read()
            time.sleep(0.01)
        return process

    yield begin
    for group in groups:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(group, signal.SIGKILL)


def test_killed_command_leaves_no_process_and_resumes(start, tmp_path):
    out, frames = tmp_path / "set", 40
    process = start(out, frames, "--streets-of", 30)  # two processes; the resumed run has one
    os.kill(process.pid, signal.SIGKILL)  # its children end without a signal
    process.wait()
    wait_for_the_end(process.pid)
    assert "Traceback" not in process.communicate()[1]
    assert (out / "INCOMPLETE").exists()
    (out / "training/velodyne/0000/.000299.bin.1-0.tmp").write_bytes(b"half")  # as after a kill
    assert 3 <= len(list(out.glob(".parts/*.json"))) < frames
    resumed_run = run_simulate(out, "kitti-tracking", frames, 1, "--streets-of", 30, "--resume")
    assert resumed_run.exit_code == 0
    assert run_simulate(tmp_path / "whole", "kitti-tracking", frames, 1, "--streets-of", 30).exit_code == 0
    assert read_files(out) == read_files(tmp_path / "whole")
    assert len(open_recording(out)) == frames
    assert len(list(out.glob("training/label_02/*.txt"))) == 2


def test_data_set_is_locked_until_ctrl_c_ends_all_processes(start, tmp_path):
    process = start(tmp_path / "set", 100_000)
    for more in (["--resume"], ["--force"], []):
        with pytest.raises(InputError, match="another process"):
            run_simulate(tmp_path / "set", "kitti-tracking", 100_000, 2, *more)
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    wait_for_the_end(process.pid)
    assert process.returncode not in (0, None) and "Traceback" not in errors
    assert (tmp_path / "set/INCOMPLETE").exists()
    assert not list((tmp_path / "set").rglob("dataset.json"))


@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_full_disk_is_reported_in_one_line(simulated_data_sets, tmp_path, monkeypatch, call):
    out, calls, real = tmp_path / "set", itertools.count(), getattr(os, call)

    def full(*args, **others):
        if next(calls) >= 6:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return real(*args, **others)

    with monkeypatch.context() as patch:
        patch.setattr(os, call, full)
        with pytest.raises(InputError, match=r"No space left on device.*--resume$") as error:
            run_simulate(out, "kitti", 5, 1, "--streets-of", 2)
    assert "\n" not in str(error.value)
    assert (out / "INCOMPLETE").exists() and not list(out.rglob(".*.tmp"))
    assert run_simulate(out, "kitti", 5, 1, "--streets-of", 2, "--resume").exit_code == 0
    assert read_files(out) == read_files(simulated_data_sets / "kitti")


def test_unwritable_file_ends_the_run(tmp_path):
    blocked = tmp_path / "set/training/velodyne/000003.bin"
    run_simulate(tmp_path / "set", "kitti", 5, 1, "--streets-of", 5)
    (tmp_path / "set/dataset.json").rename(tmp_path / "set/INCOMPLETE")  # .parts was already deleted
    blocked.unlink()
    blocked.mkdir()
    with pytest.raises(InputError, match=r"cannot write .*000003\.bin"):
        run_simulate(tmp_path / "set", "kitti", 5, 1, "--streets-of", 5, "--resume")
    assert (tmp_path / "set/INCOMPLETE").exists()


def test_existing_files_are_kept_without_force(simulated_data_sets, tmp_path):
    out = tmp_path / "set"
    assert run_simulate(out, "kitti", 2).exit_code == 0
    before = read_files(out)
    with pytest.raises(InputError, match="already exists"):
        run_simulate(out, "kitti", 3)
    with pytest.raises(InputError, match="other settings \\(frames 2, not 3"):
        run_simulate(out, "kitti", 3, 1, "--resume")
    assert read_files(out) == before
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/letter.txt").write_text("dear")
    for flag in ("--resume", "--force"):
        with pytest.raises(InputError, match="not a simulated data set"):
            run_simulate(tmp_path / "mine", "kitti", 2, 1, flag)
    assert read_files(tmp_path / "mine") == {"letter.txt": b"dear"}
    with pytest.raises(InputError, match="is a file"):
        run_simulate(tmp_path / "mine/letter.txt", "kitti", 2, 1, "--force")
    notes = out / "notes.txt"
    notes.write_text("dear")
    with pytest.raises(InputError, match=r"such as notes\.txt"):
        run_simulate(out, "kitti", 2, 1, "--force")
    assert read_files(out) == before | {"notes.txt": b"dear"}
    notes.unlink()
    (out / resumable_folder.RECORD_NAME).unlink()  # as after an interrupted --force
    (out / resumable_folder.INCOMPLETE_NAME).write_text("{}")
    with pytest.raises(InputError, match="start again with --force"):
        run_simulate(out, "kitti", 2, 1, "--resume")
    assert run_simulate(out, "semantickitti", 5, 1, "--streets-of", 2, "--force").exit_code == 0
    assert read_files(out) == read_files(simulated_data_sets / "semantickitti")


def test_recorded_command_reproduces_data_set(tmp_path):
    sensor = tmp_path / "my sensor.yaml"
    sensor.write_text("elevations: [2, -8]\nazimuth_step: 5\nrate: 10\nheight: 12.3456789\n")
    first, second = tmp_path / "made", tmp_path / "again"
    invoke(
        [
            "--out",
            str(first),
            "--format",
            "kitti",
            "--sensor",
            str(sensor),
            "--frames",
            "1",
            "--jobs",
            "1",
            "--people",
            "1.23456789",
        ]
    )
    command = json.loads((first / "dataset.json").read_text())["command"]
    program, name, *options = shlex.split(command)
    assert (program, name) == ("lidar-perception", "simulate")
    invoke([*options, "--out", str(second), "--jobs", "1"])
    assert read_files(second) == read_files(first)


def test_run_with_changed_sensor_file_is_not_resumed(tmp_path):
    sensor, out = tmp_path / "mine.yaml", tmp_path / "set"
    sensor.write_text("elevations: [2, -8]\nazimuth_step: 5\nrate: 10\n")
    options = ["--out", str(out), "--format", "kitti", "--sensor", str(sensor), "--frames", "1", "--jobs", "1"]
    invoke(options)
    assert "is already complete" in invoke([*options, "--resume"]).output
    sensor.write_text("elevations: [2, -9]\nazimuth_step: 5\nrate: 10\n")
    with pytest.raises(InputError, match="other settings \\(sensor_digest"):
        invoke([*options, "--resume"])


def test_error_of_resume_names_every_difference(tmp_path, monkeypatch):
    out = tmp_path / "set"
    with monkeypatch.context() as patch, pytest.raises(ZeroDivisionError):
        patch.setattr(dataset, "simulate_scan", lambda *_: 1 / 0)
        run_simulate(out)
    with pytest.raises(InputError, match=r"format 'kitti', not 'semantickitti'; streets_of 1") as e:
        run_simulate(out, "semantickitti", 5, 1, "--resume")
    assert "\n" not in str(e.value)
    (out / "INCOMPLETE").write_text("{")
    with pytest.raises(InputError, match="cannot read"):
        run_simulate(out, "kitti", 5, 1, "--resume")
    assert run_simulate(out, "kitti", 2, 1, "--force").exit_code == 0


@pytest.mark.parametrize(
    "options, message",
    [
        (["--sensor", "hdl65"], "unknown sensor 'hdl65': must be one of hdl-32e"),
        (["--format", "pcap"], "pcap"),
        (["--frames", "0"], "0 is not in the range"),
        (["--seed", "-1"], "-1 is not in the range"),
        (["--people", "nan"], "people = nan"),
        (["--people", "101"], "101.0 is not in the range"),
        (["--streets-of", "201"], "1 .. 200"),
        (["--resume", "--force"], "cannot be combined"),
        (["--format", "mcap", "--resume"], "with 'convert'"),
    ],
)
def test_error_names_bad_arguments(tmp_path, options, message):
    arguments = ["--out", str(tmp_path / "set"), "--format", "kitti", *options]
    result = CliRunner().invoke(simulate, arguments)
    text = result.output + str(result.exception)
    assert result.exit_code != 0 and message in text
    assert isinstance(result.exception, SystemExit | InputError)
    assert not (tmp_path / "set").exists()
