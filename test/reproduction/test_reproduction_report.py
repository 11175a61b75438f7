"""Laws of the parts of a report, and of the command."""

from __future__ import annotations

import csv
import html

import numpy as np
import pytest
from click.testing import CliRunner
from reproduction_samples import SMALL, command, points_table

from lidar_perception.cli.main import cli
from lidar_perception.data.open import open_recording
from lidar_perception.reproduction import runner
from lidar_perception.reproduction.experiment import Cell, Experiment, Figure, Line, Panel, Table
from lidar_perception.reproduction.figures import draw
from lidar_perception.reproduction.report import parts, skipped_groups, to_csv, write_report
from lidar_perception.reproduction.studies import STUDIES

pytestmark = pytest.mark.no_cover  # others run these lines

# The report


def test_skipped_frames_are_counted_by_reason():
    records = [{"frame": str(i), "skipped": f"/a/{i}.bin was cut"} for i in range(20)]
    records += [{"frame": "x", "skipped": "no labels"}, {"frame": "y"}]
    first, second = skipped_groups(records)
    assert (first["count"], first["reason"], len(first["names"])) == (20, "/a/0.bin was cut", 10)
    assert (second["count"], second["names"]) == (1, ["x"])


def test_text_is_escaped(few, tmp_path):
    records = runner.run(SMALL, open_recording(few), tmp_path / "out")
    page = write_report(tmp_path / "out", SMALL, records, points_table(records),
                        {"folder": "<b>"}).read_text()
    for text in ("Small & <quick>", "<Points>", "Points | of <all>", "a <note>", "<b>"):
        assert html.escape(text) in page and text not in page
    markdown = (tmp_path / "out/report.md").read_text()
    assert "| frame | points |" in markdown


def test_cells_of_tables_are_shown_with_their_decimals():
    assert parts(Cell(1.25, 1.0, 2.0, 3.0, 2)) == ("1.25", "[1.00, 2.00]", "3.00")
    assert parts(Cell(None)) == ("–", "", "") and parts(Cell(0.0, digits=0)) == ("0", "", "")
    table = Table("t", "T", ("a", "b"), (("x", Cell(1.0, 0.5, None, 2.0)), ("y", "-")))
    assert to_csv(table) == "a,b,b low,b high,b paper\nx,1.0,0.5,,2.0\ny,-,,,\n"


@pytest.mark.parametrize("kind", ["svg", "png"])
def test_figures_are_drawn_the_same_again_also_without_points(kind):
    panels = tuple(Panel(str(k), "x", "recall [%]", (
        Line("a", [0, 1], [None, 50.0], [None, 40.0], [None, 60.0]), Line("empty", [], []),
        Line("a, paper", [0.5, 0.5], [0, 100], dashed=True))) for k in range(4))
    figure = Figure("f", "F", panels)
    assert draw(figure, kind) == draw(figure, kind) != draw(figure, kind, dark=True)


# The command


def test_a_study_runs_by_its_name(few, tmp_path, monkeypatch):
    monkeypatch.setitem(STUDIES, "points", "reproduction_samples:SMALL")
    out = tmp_path / "out"
    text = command("stm-cpa", "--study", "points", "--data", few, "--out", out, "--jobs", 1)
    assert "skipped 1: three is not liked" in text
    expected = [len(frame.load()) for frame in open_recording(few)]
    rows = list(csv.DictReader((out / "tables/points.csv").open()))
    assert [float(r["points"]) for r in rows] == np.delete(expected, 3).tolist()


@pytest.mark.parametrize("arguments, words", [
    (["--study", "luck"], "'luck' is unknown"), (["other"], "'other'"), (["--jobs", "0"], "0 is"),
    (["--limit", "0"], "0 is"), (["--jobs", "2", "--dask", "a:1"], "give one of them")])
def test_what_cannot_be_asked_for_is_named(tmp_path, arguments, words):
    result = CliRunner().invoke(cli, ["reproduce", "--data", str(tmp_path), "--out",
                                      str(tmp_path / "out"), *arguments])
    assert result.exit_code == 2 and words in result.output
    assert not (tmp_path / "out").exists()


def test_every_study_can_be_had_by_its_name_and_is_in_the_help():
    from lidar_perception.cli.reproduce import EXPERIMENTS, _load
    text = " ".join(CliRunner().invoke(cli, ["reproduce", "--help"]).output.split())
    for name, place in {**STUDIES, **EXPERIMENTS}.items():
        assert isinstance(_load(place), Experiment)
        assert name in text
