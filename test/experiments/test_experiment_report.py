"""Parts of a report, and the command reproduce."""

from __future__ import annotations

import csv
import html
from pathlib import Path

import numpy as np
import pytest
from cli_samples import run_main
from click.testing import CliRunner
from experiment_samples import SMALL, make_sections, run_reproduce

from experiments.__main__ import COMMANDS, cli, main
from experiments.framework.command import EXPERIMENTS, load_experiment
from experiments.framework.experiment import Cell, Figure, Line, Panel, Table
from experiments.framework.figures import draw_figure
from experiments.framework.report import format_cell, group_skipped_frames, to_csv, write_report
from experiments.framework.runner import run_experiment
from lidar_perception.data.open import open_recording

ROOT = Path(__file__).resolve().parents[2]
pytestmark = pytest.mark.no_cover  # covered by other tests

# The report


def test_skipped_frames_are_grouped_by_reason():
    records = [{"frame": str(i), "skipped": f"/a/{i}.bin was cut"} for i in range(20)]
    records += [{"frame": "x", "skipped": "no labels"}, {"frame": "y"}]
    first, second = group_skipped_frames(records)
    assert (first["count"], first["reason"], len(first["names"])) == (20, "/a/0.bin was cut", 10)
    assert (second["count"], second["names"]) == (1, ["x"])


def test_report_escapes_text(five_scans, tmp_path):
    records = run_experiment(SMALL, open_recording(five_scans), tmp_path / "out")
    page = write_report(tmp_path / "out", SMALL, records, make_sections(records), {"folder": "<b>"}).read_text()
    for text in ("Small & <quick>", "<Points>", "Points | of <all>", "a <note>", "<b>"):
        assert html.escape(text) in page and text not in page
    markdown = (tmp_path / "out/report.md").read_text()
    assert "| frame | points |" in markdown


def test_table_cells_have_the_given_number_of_decimals():
    assert format_cell(Cell(1.25, 1.0, 2.0, 3.0, 2)) == ("1.25", "[1.00, 2.00]", "3.00")
    assert format_cell(Cell(None)) == ("–", "", "")
    assert format_cell(Cell(0.0, digits=0)) == ("0", "", "")
    table = Table("t", "T", ("a", "b"), (("x", Cell(1.0, 0.5, None, 2.0)), ("y", "-")))
    assert to_csv(table) == "a,b,b low,b high,b paper\nx,1.0,0.5,,2.0\ny,-,,,\n"


@pytest.mark.parametrize("kind", ["svg", "png"])
def test_figures_are_reproducible_with_and_without_points(kind):
    panels = tuple(
        Panel(
            str(k),
            "x",
            "recall [%]",
            (
                Line("a", [0, 1], [None, 50.0], [None, 40.0], [None, 60.0]),
                Line("empty", [], []),
                Line("a, paper", [0.5, 0.5], [0, 100], dashed=True),
            ),
        )
        for k in range(4)
    )
    figure = Figure("f", "F", panels)
    assert draw_figure(figure, kind) == draw_figure(figure, kind)


# The command


def test_experiment_runs_by_its_name(five_scans, tmp_path, monkeypatch):
    monkeypatch.setitem(EXPERIMENTS, "points", "experiment_samples:SMALL")
    out = tmp_path / "out"
    text = run_reproduce("points", "--data", five_scans, "--out", out, "--jobs", 1)
    assert "skipped 1: three is not liked" in text
    expected = [len(frame.load()) for frame in open_recording(five_scans)]
    rows = list(csv.DictReader((out / "tables/points.csv").open()))
    assert [float(r["points"]) for r in rows] == np.delete(expected, 3).tolist()


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["other"], "'other'"),
        (["stm-cpa-configuration"], "did you mean 'stm-cpa-configurations'"),
        (["--jobs", "0"], "0 is"),
        (["--limit", "0"], "0 is"),
        (["--jobs", "2", "--dask", "a:1"], "cannot be combined"),
        (["none"], "'none'"),
    ],
)
def test_invalid_arguments_are_reported_before_writing(tmp_path, arguments, words):
    result = CliRunner().invoke(cli, ["reproduce", "--data", str(tmp_path), "--out", str(tmp_path / "out"), *arguments])
    assert result.exit_code == 2 and words in result.output
    assert not (tmp_path / "out").exists()


def test_data_is_argument_or_option_but_not_both(tmp_path, monkeypatch, capsys):
    errors = []
    for words in (["none"], ["--data", "none"], ["none", "--data", "none"], []):
        assert run_main(monkeypatch, "reproduce", "stm-cpa", *words, "--out", tmp_path / "out", run=main) == 2
        errors.append(capsys.readouterr().err.splitlines()[-1])
    assert errors[0] == errors[1] and "none does not exist" in errors[0]
    assert "expected one DATA" in errors[2] and "DATA is missing" in errors[3]
    assert not (tmp_path / "out").exists()


def test_every_experiment_loads_and_is_listed_in_the_help():
    text = " ".join(CliRunner().invoke(cli, ["reproduce", "--help"]).output.split())
    for name in EXPERIMENTS:
        assert load_experiment(name).name == name
        assert name in text


@pytest.mark.parametrize("name", COMMANDS)
def test_every_verb_has_help_with_an_example(name):
    text = CliRunner().invoke(cli, [name, "--help"]).output
    assert "Example" in text and f"./lidar {name}" in text
    assert name in CliRunner().invoke(cli, ["--help"]).output


def test_installed_command_line_lacks_experiments():
    from lidar_perception.cli.main import COMMANDS as INSTALLED
    from lidar_perception.cli.main import cli as installed

    assert not {*COMMANDS} & {*INSTALLED}
    assert CliRunner().invoke(installed, ["reproduce"]).exit_code == 2


def test_lidar_script_dispatches_every_verb():
    assert f"\n{' | '.join(COMMANDS)})\n" in (ROOT / "lidar").read_text()
