"""The command line as a test calls it."""

from __future__ import annotations

import json
import re
import sys

from click.testing import CliRunner

from lidar_perception.cli.main import cli, main


def exit_of(monkeypatch, *arguments, run=main) -> int:
    """The exit code of `lidar-perception ARGUMENTS`, or of another command line, in this process.
    """
    monkeypatch.setattr(sys, "argv", ["lidar-perception", *map(str, arguments)])
    try:
        run()
    except SystemExit as stop:
        return stop.code or 0
    return 0


def evaluate_detection(tmp_path, *arguments):
    """The JSON file and the output of `evaluate detection`, which must succeed."""
    path = tmp_path / "made/scores.json"
    result = CliRunner().invoke(cli, ["evaluate", "detection", "--json", str(path),
                                      *map(str, arguments)], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return json.loads(path.read_text()), result.stdout


def error_line(capsys) -> str:
    """The one line on stderr that says what is wrong. Before it there may be what was opened, that
    code is compiled, and the empty line of a progress bar that ended."""
    *before, line = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("Error: ")
    assert all(re.search(r": .*, \d+ frames?\b|^compiling ", each)
               for each in before if each), before
    return line
