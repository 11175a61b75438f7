"""test and benchmark: what needs the repository and not only the installed package."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import click

from lidar_perception.types import InputError

ROOT = Path(__file__).resolve().parents[2]
MAX_WORKERS = 4  # each holds torch and compiles what it runs
WITH_PROCESSES = ("test/ros", "test/launch", "test/testing")
PASS_ON = dict(ignore_unknown_options=True, help_option_names=[])


@click.command(context_settings=PASS_ON)
@click.argument("arguments", nargs=-1, type=click.UNPROCESSED)
def test(arguments: tuple[str, ...]) -> None:
    """Run the tests of this checkout; ARGUMENTS go to pytest.

    Without ARGUMENTS all of them: first those of the core, on all cores, then those with processes
    that talk to each other, which would disturb each other, one by one.

    \b
    Examples:
      lidar test
      lidar test -k clustering -x
    """
    if arguments:
        sys.exit(_run("test", ["-m", "pytest", *arguments]))
    workers = min(os.cpu_count() or 1, MAX_WORKERS)
    core = _run("test", ["-m", "pytest", "-n", str(workers), "--dist", "loadfile",
                         *(f"--ignore={folder}" for folder in WITH_PROCESSES)])
    rest = _run("test", ["-m", "pytest", *WITH_PROCESSES])
    sys.exit(core or rest)


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
