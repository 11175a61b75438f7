"""test and benchmark: what needs the repository and not only the installed package."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import click

from lidar_perception.runs.terminal import errors
from lidar_perception.types import InputError

ROOT = Path(__file__).resolve().parents[2]
MAX_WORKERS = 4  # each holds torch and compiles what it runs
WITH_PROCESSES = ("test/ros", "test/launch", "test/testing")
PASS_ON = dict(ignore_unknown_options=True, help_option_names=[])


@click.command(context_settings=PASS_ON)
@click.argument("arguments", nargs=-1, type=click.UNPROCESSED)
def test(arguments: tuple[str, ...]) -> None:
    """Run the tests of this checkout; ARGUMENTS go to pytest.

    Without ARGUMENTS ruff, mypy, and all tests: those of the core on all cores, and beside them,
    one by one, those with processes that talk to each other. The lines that they run are measured,
    in all processes, and at least as many as setup.cfg says must be.

    \b
    Examples:
      lidar test
      lidar test -k clustering -x
    """
    if arguments:
        sys.exit(_run("test", ["-m", "pytest", *arguments]))
    failed = [name for name in ("ruff check", "mypy")
              if _run("test", ["-m", *name.split()])]
    with tempfile.TemporaryDirectory() as folder:
        failed += _tests(Path(folder))
    if failed:
        errors.print(f"[red]failed:[/] {', '.join(failed)}")
    sys.exit(bool(failed))


def _tests(folder: Path) -> list[str]:
    """Run all tests, those of nodes beside the others, since they mostly wait. What failed; the
    measured coverage lies in folder for a while."""
    environment = {**os.environ, "COVERAGE_FILE": str(folder / "coverage")}
    if sys.version_info >= (3, 12):
        environment["COVERAGE_CORE"] = "sysmon"  # lines are noticed once, and then cost nothing
    pytest = [sys.executable, "-m", "pytest", "--cov", "--cov-report=", "--cov-fail-under=0"]
    nodes = [name for name in WITH_PROCESSES if (ROOT / name).is_dir()]
    workers = min(os.cpu_count() or 1, MAX_WORKERS)
    with (folder / "said").open("w+") as said:
        beside = subprocess.Popen([*pytest, *nodes], cwd=ROOT, stdout=said,
                                  stderr=subprocess.STDOUT,
                                  env={**environment, "COVERAGE_FILE": str(folder / "nodes")})
        core = subprocess.run([*pytest, "-n", str(workers), "--dist", "loadfile",
                               *(f"--ignore={name}" for name in nodes)], cwd=ROOT, env=environment)
        beside.wait()
        said.seek(0)
        print(said.read())
    coverage = [sys.executable, "-m", "coverage"]
    subprocess.run([*coverage, "combine", "--quiet", "--keep", str(folder / "coverage"),
                    str(folder / "nodes")], cwd=ROOT, env={**environment, "COVERAGE_FILE":
                                                           str(folder / "all")})
    covered = subprocess.run([*coverage, "report"], cwd=ROOT, env={
        **environment, "COVERAGE_FILE": str(folder / "all")})
    return [name for name, done in (("tests", core), ("tests of nodes", beside),
                                    ("coverage", covered)) if done.returncode]


@click.command(context_settings=PASS_ON)
@click.argument("arguments", nargs=-1, type=click.UNPROCESSED)
def benchmark(arguments: tuple[str, ...]) -> None:
    """Time the algorithms beside their peers; see `benchmark --help`."""
    sys.exit(_run("benchmark", ["-m", "benchmark", *arguments]))


def _run(folder: str, command: list[str]) -> int:
    """The exit code."""
    if not (ROOT / folder).is_dir():
        raise InputError(f"'{folder}' needs a checkout of the repository, and {ROOT} has no "
                         f"folder {folder}/")
    return subprocess.run([sys.executable, *command], cwd=ROOT).returncode
