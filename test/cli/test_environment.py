"""The script ./lidar and the environment that it creates."""

from __future__ import annotations

import fcntl
import os
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
from samples import write_file

from lidar_perception.nodes import NODES

ROOT = Path(__file__).resolve().parents[2]
BASE = "ros studio odometry"  # extras that every command needs
TEST = f"{BASE} test docs benchmark distributed onnx video"


def make_stamp(extras=TEST):
    """Return the text that marks an environment as up to date."""
    return (
        subprocess.run(
            ["cksum"],
            input=b"".join((ROOT / name).read_bytes() for name in ("constraints.txt", "setup.py", "setup.cfg")),
            capture_output=True,
            check=True,
        ).stdout.decode()
        + extras
        + "\n"
    )


PREFIX = Path(sys.prefix)
INSTALLED = PREFIX / "lib" / "lidar_perception"
needs_pip = pytest.mark.skipif(not INSTALLED.is_dir(), reason="needs the package installed by pip")


@needs_pip
def test_only_the_lidar_command_is_added_to_path():
    """Node executables are in lib/, where ros2 run and ros2 launch look, because names such as `tracker` are
    common."""
    assert {path.name for path in INSTALLED.iterdir()} == set(NODES)
    assert {path.name for path in (PREFIX / "bin").iterdir()}.isdisjoint(NODES)
    assert (PREFIX / "bin/lidar-perception").is_file()


@needs_pip
@pytest.mark.parametrize("name", ["tracker", "bag_recorder"])
def test_executable_starts_the_node_of_its_name(name, tmp_path):
    """The current folder contains modules with the names of the package's modules."""
    for module in "numpy", "signal", "lidar_perception":
        write_file(tmp_path / f"{module}.py", "raise SystemExit(3)")
    done = subprocess.run([INSTALLED / name, "--help"], cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith(f"Usage: {name} --ros-args")


def test_help_into_a_closed_pipe_ends_without_error():
    command = [sys.executable, "-m", "lidar_perception.nodes.main", "perception", "--help"]
    with subprocess.Popen(
        command, env={**os.environ, "PYTHONPATH": str(ROOT)}, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        process.stdout.close()
        assert process.stderr.read() == ""
    assert process.returncode == 0


@pytest.mark.skipif(not (ROOT / "lidar").exists(), reason="needs the checkout")
def test_concurrent_first_calls_create_one_environment(tmp_path):
    venv = tmp_path / "venv"
    write_file(venv / "bin/lidar-perception", "#!/bin/sh\necho ran $1\n").chmod(0o755)
    with open(venv / "lidar-lock", "w") as lock:  # lock file of ./lidar
        fcntl.flock(lock, fcntl.LOCK_EX)
        other = subprocess.Popen(
            [ROOT / "lidar", "info"],
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env={**os.environ, "LIDAR_VENV": str(venv), "LIDAR_PYTHON": "/bin/false"},
        )
        assert "waiting for another process" in other.stderr.readline()
        write_file(venv / "lidar-setup", make_stamp())
    assert other.communicate() == ("ran info\n", "") and other.returncode == 0


@pytest.mark.skipif(not (ROOT / "lidar").exists(), reason="needs the checkout")
def test_sourced_ros_does_not_affect_the_new_environment(tmp_path):
    """pip does not install packages that it finds on PYTHONPATH."""
    log_file = tmp_path / "seen"
    python = write_file(tmp_path / "python", f"#!/bin/sh\necho ${{PYTHONPATH-unset}} >>{log_file}\n")
    python.chmod(0o755)
    done = subprocess.run(
        [ROOT / "lidar", "info"],
        text=True,
        capture_output=True,
        env={
            **os.environ,
            "PYTHONPATH": "/opt/ros/jazzy/lib",
            "LIDAR_VENV": str(tmp_path / "venv"),
            "LIDAR_PYTHON": str(python),
        },
    )
    assert done.returncode == 1 and "installation failed" in done.stderr  # this Python cannot create environments
    assert log_file.read_text().split() == ["unset", "unset"]


@pytest.mark.skipif(not (ROOT / "lidar").exists(), reason="needs the checkout")
@pytest.mark.parametrize(
    "words, ran",
    [
        ("test -k tracker -x", f"python {ROOT}/scripts/run_tests.py -k tracker -x\n"),
        ("benchmark --help", "python -m benchmark --help\n"),
        ("info drive.bag", "lidar-perception info drive.bag\n"),
    ],
)
def test_lidar_runs_tests_and_benchmark_from_the_checkout(words, ran, run_lidar):
    assert run_lidar(words) == ran


@pytest.mark.skipif(not (ROOT / "lidar").exists(), reason="needs the checkout")
def test_help_of_lidar_mentions_test_and_benchmark(run_lidar):
    first, *more = run_lidar("--help").splitlines()
    assert first == "lidar-perception --help" and {"test", "benchmark"} <= {*" ".join(more).split()}


@pytest.fixture
def run_lidar(tmp_path):
    """Return the output of ./lidar WORDS in an environment whose programs print their arguments."""
    for name in ("python", "lidar-perception"):
        write_file(tmp_path / "bin" / name, f"#!/bin/sh\necho {name} $*\n").chmod(0o755)
    write_file(tmp_path / "lidar-setup", make_stamp())
    return lambda words: (
        subprocess.run(
            [ROOT / "lidar", *words.split()],
            text=True,
            capture_output=True,
            check=True,
            env={**os.environ, "LIDAR_VENV": str(tmp_path)},
        ).stdout
    )


@pytest.mark.skipif(not (ROOT / "lidar").exists(), reason="needs the checkout")
@pytest.mark.parametrize(
    "words, before, after",
    [
        ("info a.bag", BASE, BASE),
        ("test -x", BASE, TEST),
        ("benchmark", f"{BASE} video", f"{BASE} benchmark video"),
        ("export onnx w.safetensors", BASE, f"{BASE} onnx"),
        ("detect a.bag --video a.mp4 --dask tcp://a", TEST, TEST),
    ],
)
def test_lidar_installs_what_a_command_needs(words, before, after, run_lidar, tmp_path):
    write_file(tmp_path / "lidar-setup", make_stamp(before))
    run_lidar(words)
    assert (tmp_path / "lidar-setup").read_text() == make_stamp(after)
    log = tmp_path / "setup.log"
    assert not log.exists() if after == before else log.read_text() == (f"python {ROOT}/scripts/set_up.py {after}\n")


def test_pip_configuration_is_passed_to_uv(tmp_path, monkeypatch):
    set_up = runpy.run_path(str(ROOT / "scripts/set_up.py"))
    write_file(
        tmp_path / "pip.conf",
        "[global]\nindex-url = https://a/simple\nretries = 3\n"
        "find-links = /never\nextra-index-url =\n  https://b/simple\n  https://c/simple\n"
        "[install]\nconstraint = /d.txt\ntimeout = 9\n[freeze]\ntimeout = 10\n",
    )
    for name in [name for name in os.environ if name.startswith("PIP_")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("PIP_CONFIG_FILE", str(tmp_path / "pip.conf"))
    monkeypatch.setenv("PIP_FIND_LINKS", "/wheels")  # takes precedence
    monkeypatch.setenv("PIP_CERT", "/ca.crt")
    settings = set_up["read_pip_settings"]()
    options, variables = set_up["find_uv_options"](settings)
    pairs = [*zip(options[::2], options[1::2])]
    assert {*pairs} >= {
        ("--default-index", "https://a/simple"),
        ("--find-links", "/wheels"),
        ("--index", "https://b/simple"),
        ("--index", "https://c/simple"),
        ("--constraint", "/d.txt"),
    }
    assert ("--find-links", "/never") not in pairs
    assert variables == {"SSL_CERT_FILE": "/ca.crt", "UV_HTTP_TIMEOUT": "9"}
    assert set_up["find_uv_options"]({"no-index": "true"})[0][2:] == ["--no-index"]
    assert set_up["find_uv_options"]({**settings, "target": "/x"}) is None  # uv has no such option
