"""test and benchmark: what needs the repository and not only the installed package."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import click
from rich.text import Text

from lidar_perception.runs.terminal import errors
from lidar_perception.runs.threads import one_thread_each
from lidar_perception.types import InputError

ROOT = Path(__file__).resolve().parents[2]
MAX_WORKERS = 4  # each holds torch and compiles what it runs
NODE_WORKERS = 2  # of tests that mostly wait
# Folders and files of them; those with the longest tests come first.
WITH_PROCESSES = ("test/testing", "test/campaign",
                  "test/labeling/test_label_server.py", "test/labeling/test_page.py",
                  "test/labeling/test_page_saves.py", "test/launch", "test/ros")
# What Numba compiles for all of this is cached beside the source, for each process after this one.
COMPILE = ("""
from lidar_perception.candidates.warm_up import warm_up
warm_up()
""", """
from lidar_perception.simulation.to_bag import simulated_scans
next(iter(simulated_scans(1, 1))).load()
""", """
from lidar_perception.detectors.open import LOAD, open_detector
from lidar_perception.simulation.to_bag import simulated_scans
for frame in simulated_scans(1, 1):
    for name in LOAD:
        open_detector(name)(frame.load())
""")
PASS_ON = dict(ignore_unknown_options=True, help_option_names=[])


@click.command(context_settings=PASS_ON)
@click.argument("arguments", nargs=-1, type=click.UNPROCESSED)
def test(arguments: tuple[str, ...]) -> None:
    """Run the tests of this checkout; ARGUMENTS go to pytest.

    Without ARGUMENTS ruff, mypy, and all tests: those of the core on all cores, and beside them
    those with processes that talk to each other, two at a time. What Numba compiles is compiled
    before them, once, while ruff and mypy run. The lines that the tests run are measured, but not
    those of nodes in processes of their own, nor of long tests that run the lines of others, such
    as those of Hypothesis, as they would take twice as long; at least as many as setup.cfg says
    must be.

    \b
    Examples:
      lidar test
      lidar test -k clustering -x
    """
    if arguments:
        sys.exit(_run("test", ["-m", "pytest", *arguments]))
    _needed("test")
    with tempfile.TemporaryDirectory() as folder:
        failed = _everything(Path(folder))
    if failed:
        errors.print(Text("failed:", "red") + f" {', '.join(failed)}")
    sys.exit(bool(failed))


class Beside:
    """A Python command that runs beside others; what it says is shown when it has ended."""

    def __init__(self, *words: str, environment: dict[str, str] | None = None):
        self.said = tempfile.TemporaryFile("w+")
        self.process = subprocess.Popen([sys.executable, *words], cwd=ROOT, env=environment,
                                        stdout=self.said, stderr=subprocess.STDOUT)

    def failed(self) -> bool:
        """Wait for its end."""
        code = self.process.wait()
        self.said.seek(0)
        print(self.said.read(), end="", flush=True)
        return bool(code)


def _everything(folder: Path) -> list[str]:
    """Run all that is tested. What failed; the measured coverage lies in folder for a while."""
    one_thread_each()  # as many processes as cores
    environment = {**os.environ, "COVERAGE_FILE": str(folder / "coverage")}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)  # compiled once, not in each process
    if sys.version_info >= (3, 12):
        environment["COVERAGE_CORE"] = "sysmon"  # lines are noticed once, and then cost nothing
    pytest = ("-m", "pytest", "--cov", "--cov-report=", "--cov-fail-under=0")
    nodes = [name for name in WITH_PROCESSES if (ROOT / name).exists()]
    workers = min(os.cpu_count() or 1, MAX_WORKERS)
    running = {"ruff": Beside("-m", "ruff", "check"), "mypy": Beside("-m", "mypy")}
    *parts, last = COMPILE  # tests say what is wrong, if something is
    for compiling in [Beside("-c", part) for part in parts]:
        compiling.failed()
    Beside("-c", last).failed()
    # Nodes mostly wait, so their tests run beside the others.
    running["tests of nodes"] = Beside(*pytest, *_dealt(NODE_WORKERS), *nodes, environment={
        **environment, "COVERAGE_FILE": str(folder / "nodes")})
    core = subprocess.run([sys.executable, *pytest, *_dealt(workers),
                           *(f"--ignore={name}" for name in nodes)], cwd=ROOT, env=environment)
    failed = ["tests"] * bool(core.returncode)
    failed += [name for name, command in running.items() if command.failed()]
    coverage, environment["COVERAGE_FILE"] = [sys.executable, "-m", "coverage"], str(folder / "all")
    subprocess.run([*coverage, "combine", "--quiet", "--keep", str(folder / "coverage"),
                    str(folder / "nodes")], cwd=ROOT, env=environment)
    covered = subprocess.run([*coverage, "report"], cwd=ROOT, env=environment)
    return [*failed, *["coverage"] * bool(covered.returncode)]


def _dealt(workers: int) -> tuple[str, ...]:
    """Options of pytest, for so many processes: whole files, in their order, as by their number of
    tests those that take longest would come last."""
    return "-n", str(workers), "--dist", "loadfile", "--no-loadscope-reorder"


@click.command(context_settings=PASS_ON)
@click.argument("arguments", nargs=-1, type=click.UNPROCESSED)
def benchmark(arguments: tuple[str, ...]) -> None:
    """Time the algorithms beside their peers; see `benchmark --help`."""
    sys.exit(_run("benchmark", ["-m", "benchmark", *arguments]))


def _run(folder: str, command: list[str]) -> int:
    """The exit code."""
    _needed(folder)
    return subprocess.run([sys.executable, *command], cwd=ROOT).returncode


def _needed(folder: str) -> None:
    if not (ROOT / folder).is_dir():
        raise InputError(f"'{folder}' needs a checkout of the repository, and {ROOT} has no "
                         f"folder {folder}/")
