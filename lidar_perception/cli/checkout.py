"""test and benchmark: what needs the repository and not only the installed package."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import click

from lidar_perception.types import InputError

ROOT = Path(__file__).resolve().parents[2]
PASS_ON = dict(ignore_unknown_options=True, help_option_names=[])


@click.command(context_settings=PASS_ON)
@click.argument("arguments", nargs=-1, type=click.UNPROCESSED)
def test(arguments: tuple[str, ...]) -> None:
    """Run the tests of this checkout; ARGUMENTS go to pytest.

    \b
    Examples:
      lidar test
      lidar test -k clustering -x
    """
    _run("test", ["-m", "pytest", *arguments])


@click.command(context_settings=PASS_ON)
@click.argument("arguments", nargs=-1, type=click.UNPROCESSED)
def benchmark(arguments: tuple[str, ...]) -> None:
    """Time the algorithms beside their peers; see `benchmark --help`."""
    _run("benchmark", ["-m", "benchmark", *arguments])


def _run(folder: str, command: list[str]) -> None:
    if not (ROOT / folder).is_dir():
        raise InputError(f"'{folder}' needs a checkout of the repository, and {ROOT} has no "
                         f"folder {folder}/")
    sys.exit(subprocess.run([sys.executable, *command], cwd=ROOT).returncode)
