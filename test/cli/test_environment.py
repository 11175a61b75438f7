"""./lidar and the environment that it makes."""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys
from importlib.metadata import distribution
from pathlib import Path

import pytest
from samples import write

from lidar_perception.nodes import NODES

ROOT = Path(__file__).resolve().parents[2]


def wanted():
    """Return the checksum by which ./lidar knows that its environment is up to date."""
    return subprocess.run(["cksum"], input=b"".join(
        (ROOT / name).read_bytes() for name in ("constraints.txt", "setup.py", "setup.cfg")),
        capture_output=True, check=True).stdout.decode()


@pytest.mark.parametrize("name", NODES)
def test_each_executable_of_the_package_is_its_node(name, monkeypatch, capsys):
    """As ros2 run and ros2 launch start them."""
    executable, = (each for each in distribution("lidar_perception").entry_points
                   if each.name == name)
    monkeypatch.setattr(sys, "argv", [f"/opt/ws/lib/lidar_perception/{name}", "--help"])
    assert executable.load()() == 0
    assert capsys.readouterr().out.startswith(f"Usage: {name} --ros-args")


def test_a_reader_of_the_help_may_stop_reading():
    command = [sys.executable, "-m", "lidar_perception.nodes.main", "perception", "--help"]
    with subprocess.Popen(command, env={**os.environ, "PYTHONPATH": str(ROOT)}, text=True,
                          stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()
        assert process.stderr.read() == ""
    assert process.returncode == 0


@pytest.mark.skipif(not (ROOT / "lidar").exists(), reason="needs the checkout")
def test_of_two_first_calls_one_makes_the_environment_and_the_other_waits(tmp_path):
    venv = tmp_path / "venv"
    write(venv / "bin/lidar-perception", "#!/bin/sh\necho ran $1\n").chmod(0o755)
    with open(venv / "lidar-lock", "w") as lock:  # the one
        fcntl.flock(lock, fcntl.LOCK_EX)
        other = subprocess.Popen([ROOT / "lidar", "info"], text=True, stdout=subprocess.PIPE,
                                 stderr=subprocess.PIPE, env={
            **os.environ, "LIDAR_VENV": str(venv), "LIDAR_PYTHON": "/bin/false"})
        assert "another call is making" in other.stderr.readline()
        write(venv / "lidar-setup", wanted())
    assert other.communicate() == ("ran info\n", "") and other.returncode == 0


@pytest.mark.skipif(not (ROOT / "lidar").exists(), reason="needs the checkout")
def test_a_sourced_ros_is_not_seen_while_the_environment_is_made(tmp_path):
    """pip leaves out what it finds on PYTHONPATH."""
    seen = tmp_path / "seen"
    python = write(tmp_path / "python", f"#!/bin/sh\necho ${{PYTHONPATH-unset}} >>{seen}\n")
    python.chmod(0o755)
    done = subprocess.run([ROOT / "lidar", "info"], text=True, capture_output=True, env={
        **os.environ, "PYTHONPATH": "/opt/ros/jazzy/lib", "LIDAR_VENV": str(tmp_path / "venv"),
        "LIDAR_PYTHON": str(python)})
    assert done.returncode == 1 and "pip failed" in done.stderr  # this python makes none
    assert seen.read_text().split() == ["unset", "unset"]


@pytest.mark.skipif(not (ROOT / "lidar").exists(), reason="needs the checkout")
@pytest.mark.parametrize("words, ran", [
    ("test -k tracker -x", f"python {ROOT}/scripts/run_tests.py -k tracker -x\n"),
    ("benchmark --help", "python -m benchmark --help\n"),
    ("info drive.bag", "lidar-perception info drive.bag\n")])
def test_lidar_runs_tests_and_benchmark_from_the_checkout(words, ran, environment):
    assert environment(words) == ran


@pytest.mark.skipif(not (ROOT / "lidar").exists(), reason="needs the checkout")
def test_help_of_lidar_mentions_test_and_benchmark(environment):
    first, *_, last = environment("--help").splitlines()
    assert first == "lidar-perception --help" and "test" in last and "benchmark" in last


@pytest.fixture
def environment(tmp_path):
    """Return what ./lidar WORDS prints in an environment whose programs print their arguments."""
    for name in ("python", "lidar-perception"):
        write(tmp_path / "bin" / name, f"#!/bin/sh\necho {name} $*\n").chmod(0o755)
    write(tmp_path / "lidar-setup", wanted())
    return lambda words: subprocess.run(
        [ROOT / "lidar", *words.split()], text=True, capture_output=True, check=True,
        env={**os.environ, "LIDAR_VENV": str(tmp_path)}).stdout
