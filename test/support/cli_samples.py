"""Calls of the command line, for tests."""

from __future__ import annotations

import json
import re
import sys

from click.testing import CliRunner

from lidar_perception.cli.main import cli, main


def run_main(monkeypatch, *arguments, run=main) -> int:
    """Return the exit code of `lidar-perception ARGUMENTS`, run in this process."""
    monkeypatch.setattr(sys, "argv", ["lidar-perception", *map(str, arguments)])
    try:
        run()
    except SystemExit as stop:
        return stop.code or 0
    return 0


def run_command(*arguments) -> str:
    """Return the standard output of a command that succeeds."""
    result = CliRunner().invoke(cli, [str(a) for a in arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.stdout


def evaluate(tmp_path, *arguments) -> dict:
    """Return the JSON file of `evaluate candidates`."""
    path = tmp_path / "made/by/evaluate/scores.json"
    run_command("evaluate", "candidates", "--json", path, *arguments)
    return json.loads(path.read_text())


def make_set_options(*assignments) -> list[str]:
    return [word for each in assignments for word in ("--set", each)]


def drop_times(content: dict) -> dict:
    """Return the scores without the run time."""
    return {k: v for k, v in content.items() if k != "ms"}


def evaluate_detection(tmp_path, *arguments):
    """Return the JSON file and the output of `evaluate detection`."""
    path = tmp_path / "made/scores.json"
    result = CliRunner().invoke(
        cli, ["evaluate", "detection", "--json", str(path), *map(str, arguments)], catch_exceptions=False
    )
    assert result.exit_code == 0, result.output
    return json.loads(path.read_text()), result.stdout


def read_error_line(capsys) -> str:
    """Return the error line on stderr.

    Lines about the opened recording and compilation, and empty lines may come before it.
    """
    *before, line = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("Error: ")
    assert all(re.search(r": .*, \d+ frames?\b|^compiling ", each) for each in before if each), before
    return line
