"""A small experiment, and runs of it and of the STM-CPA experiment by the verb reproduce."""

from __future__ import annotations

import json

from click.testing import CliRunner

from experiments.__main__ import cli
from experiments.framework.experiment import Cell, Experiment, Figure, Line, Panel, Section, Table
from lidar_perception.runs import journal
from lidar_perception.types import InputError

COUNT = 12


def count_points(frames, number):
    """Measure a frame in a small experiment, which also reads the frame before."""
    if number == 3:
        raise InputError("three is not liked")
    before = len(frames[number - 1].load()) if number else 0
    return {"frame": frames[number].name, "points": len(frames[number].load()), "before": before}


def make_sections(records):
    rows = tuple((r["frame"], Cell(r["points"], paper=7, digits=0)) for r in records if "skipped" not in r)
    curve = Line("points | all", range(len(rows)), [row[1].value for row in rows])
    return [
        Section(
            "<Points>",
            "How many & where",
            (Table("points", "Points | of <all>", ("frame", "points"), rows, "a <note>"),),
            (Figure("curve", "A curve", (Panel("one", "x", "y", (curve,)),)),),
        )
    ]


def make_small_experiment(measure=count_points, **settings):
    return Experiment("small", "Small & <quick>", "How many?", measure, make_sections, settings)


SMALL = make_small_experiment()


def run_reproduce(*arguments):
    """Run `reproduce` and return its standard output; exceptions are raised."""
    result = CliRunner().invoke(cli, ["reproduce", *map(str, arguments)], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.stdout


def read_untimed_records(folder):
    """Return the records in a folder without their times, in order."""
    head, *lines = (folder / journal.JOURNAL_NAME).read_text().splitlines()
    assert "plan" in json.loads(head)
    records = [json.loads(line) for line in lines]
    return [{k: v for k, v in record.items() if k != "ms"} for record in records]


def read_lines(folder):
    path = folder / journal.JOURNAL_NAME
    return path.read_text().splitlines() if path.exists() else []
