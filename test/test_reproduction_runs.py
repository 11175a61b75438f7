"""Laws of a run: however it is spread or stopped, the records are the same, and bad input costs the
frames that it hits and no others."""

from __future__ import annotations

import csv
import html
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from samples import crowd_folder, object_folder, write

from lidar_perception.cli.main import cli
from lidar_perception.datasets.kitti import open_kitti
from lidar_perception.reproduction import journal, runner
from lidar_perception.reproduction.experiment import (
    Cell,
    Experiment,
    Figure,
    Line,
    Panel,
    Section,
    Table,
)
from lidar_perception.reproduction.figures import draw
from lidar_perception.reproduction.report import parts, skipped_groups, to_csv, write_report
from lidar_perception.reproduction.stm_cpa import STM_CPA
from lidar_perception.reproduction.studies import STUDIES
from lidar_perception.types import InputError

ROOT = Path(__file__).resolve().parents[1]
COUNT = 12
TIMED = {"table_9", "table_9_median"}


def count_points(frames, number):
    """The record of a small experiment, which also looks at the frame before."""
    if number == 3:
        raise InputError("three is not liked")
    before = len(frames[number - 1].cloud()) if number else 0
    return {"frame": frames[number].name, "points": len(frames[number].cloud()), "before": before}


def break_down(frames, number):
    if number == 2:
        raise ZeroDivisionError("a mistake")
    return {"frame": frames[number].name}


def not_json(frames, number):
    return {"frame": frames[number].name, "value": float("nan")}


def end_the_process(frames, number):
    os.kill(os.getpid(), signal.SIGKILL)


def points_table(records):
    rows = tuple((r["frame"], Cell(r["points"], paper=7, digits=0)) for r in records
                 if "skipped" not in r)
    curve = Line("points | all", range(len(rows)), [row[1].value for row in rows])
    return [Section("<Points>", "How many & where", (
        Table("points", "Points | of <all>", ("frame", "points"), rows, "a <note>"),),
        (Figure("curve", "A curve", (Panel("one", "x", "y", (curve,)),)),))]


def small(measure=count_points, **settings):
    return Experiment("small", "Small & <quick>", "How many?", measure, points_table, settings)


SMALL = small()


@pytest.fixture(scope="module")
def kitti(tmp_path_factory):
    return crowd_folder(tmp_path_factory.mktemp("kitti"), COUNT)


@pytest.fixture(scope="module")
def whole(kitti, tmp_path_factory):
    """The folder of a run of the paper's experiment that nothing has stopped; beside it, what the
    command said."""
    out = tmp_path_factory.mktemp("whole") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COLUMNS", "160")
        write(out.parent / "said", command("--kitti", kitti, "--out", out, "--jobs", 1))
    return out


@pytest.fixture
def few(tmp_path):
    """Five scans for the small experiment."""
    return object_folder(tmp_path / "few", count=5)


def command(*arguments):
    """Standard output of the command; its exceptions come out."""
    result = CliRunner().invoke(cli, ["reproduce", *map(str, arguments)], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.stdout


def untimed(folder):
    """Records of a folder without their times, in its order."""
    head, *lines = (folder / journal.NAME).read_text().splitlines()
    assert "plan" in json.loads(head)
    records = [json.loads(line) for line in lines]
    return [{k: v for k, v in record.items() if k != "ms"} for record in records]


def content(folder):
    """Name to content of the files that hold no times."""
    return {path.name: path.read_bytes() for path in sorted(folder.rglob("*"))
            if path.suffix in (".csv", ".png") and path.stem not in TIMED}


def lines_of(folder):
    path = folder / journal.NAME
    return path.read_text().splitlines() if path.exists() else []


# However it is spread and stopped


def test_two_processes_measure_what_one_does(kitti, whole, tmp_path):
    runner.run(STM_CPA, kitti, tmp_path / "out", jobs=2)
    assert untimed(tmp_path / "out") == untimed(whole)


def test_a_cluster_of_two_workers_measures_what_one_process_does(kitti, whole, tmp_path):
    distributed = pytest.importorskip("distributed", reason="needs the extra [distributed]")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True,
                                  dashboard_address=None) as cluster:
        address = cluster.scheduler_address
        runner.run(STM_CPA, kitti, tmp_path / "out", dask=address)
        with pytest.raises(ZeroDivisionError):
            runner.run(small(break_down), kitti, tmp_path / "broken", dask=address)
    assert untimed(tmp_path / "out") == untimed(whole)


def test_a_cluster_that_is_not_there_is_named(few, tmp_path, monkeypatch):
    pytest.importorskip("distributed", reason="needs the extra [distributed]")
    monkeypatch.setattr(runner, "CONNECT_S", 0.2)
    with pytest.raises(InputError, match="cannot reach a Dask scheduler"):
        runner.run(SMALL, few, tmp_path / "out", dask="tcp://127.0.0.1:9")


def test_without_distributed_the_extra_is_named(few, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"lidar_perception\[distributed\]"):
        runner.run(SMALL, few, tmp_path / "out", dask="tcp://127.0.0.1:9")


def test_a_killed_run_leaves_no_process_and_goes_on_where_it_was(kitti, whole, tmp_path):
    out = tmp_path / "out"
    process = subprocess.Popen(
        [sys.executable, "-m", "lidar_perception.cli.main", "reproduce", "--kitti", str(kitti),
         "--out", str(out), "--jobs", "2"], cwd=ROOT, start_new_session=True, text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)}, stderr=subprocess.PIPE)
    while len(lines_of(out)) < 4:
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.005)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:  # its children end by themselves
        try:
            os.killpg(process.pid, 0)
        except ProcessLookupError:
            break
        time.sleep(0.02)
    else:
        pytest.fail("a process is still there")
    assert "Traceback" not in process.communicate()[1]
    kept = lines_of(out)
    assert 4 <= len(kept) < COUNT and not (out / "report.html").exists()
    command("--kitti", kitti, "--out", out, "--jobs", 1)
    assert untimed(out) == untimed(whole)
    assert content(out) == content(whole)
    assert set(kept[:4]) <= set(lines_of(out))  # with their times: they were not measured again


@pytest.mark.parametrize("cut", [1, 2, 40])
def test_a_cut_last_line_is_dropped_and_its_frame_measured_again(few, tmp_path, cut):
    expected = runner.run(SMALL, few, tmp_path / "out")
    path = tmp_path / "out" / journal.NAME
    bytes_before = path.read_bytes()
    path.write_bytes(bytes_before[:-cut])
    assert runner.run(SMALL, few, tmp_path / "out") == expected
    assert path.read_bytes() == bytes_before


def test_what_is_there_is_not_measured_again(few, tmp_path, monkeypatch):
    expected = runner.run(SMALL, few, tmp_path / "out", limit=2)
    assert [r["frame"] for r in expected] == ["000000", "000001"]
    asked = []

    def noted(frames, number):
        asked.append(number)
        return count_points(frames, number)

    assert runner.run(small(noted), few, tmp_path / "out")[:2] == expected
    assert asked == [2, 3, 4]
    assert len(runner.run(small(noted), few, tmp_path / "out", limit=1)) == 1
    assert asked == [2, 3, 4]
    assert len(lines_of(tmp_path / "out")) == 1 + 4  # the plan, and what was not skipped


def test_a_frame_that_was_skipped_is_tried_again(few, tmp_path):
    scan = few / "training/velodyne/000001.bin"
    whole = scan.read_bytes()
    scan.write_bytes(whole[:100])
    first = runner.run(SMALL, few, tmp_path / "out")
    assert "000001.bin" in first[1]["skipped"] and "000001.bin" in first[2]["skipped"]
    scan.write_bytes(whole)
    assert runner.run(SMALL, few, tmp_path / "out") == runner.run(SMALL, few, tmp_path / "again")


# What is in the way


def test_another_plan_is_an_error_that_names_what_differs(few, tmp_path):
    out = tmp_path / "out"
    runner.run(small(limits=(1, 2), deep={"a": 1, "b": 2}), few, out)
    before = (out / journal.NAME).read_bytes()
    with pytest.raises(InputError, match=r"settings.deep.b 2, not 3; .*--force") as error:
        runner.run(small(limits=(1, 2), deep={"a": 1, "b": 3}), few, out)
    assert "deep.a" not in str(error.value) and "limits" not in str(error.value)
    other = object_folder(tmp_path / "other", count=4)
    with pytest.raises(InputError, match=r"kitti '.*few', not '.*other'; frames 5, not 4"):
        runner.run(small(limits=(1, 2), deep={"a": 1, "b": 2}), other, out)
    assert (out / journal.NAME).read_bytes() == before
    runner.run(SMALL, other, out, force=True)
    assert len(runner.run(SMALL, other, out)) == 4


def test_a_folder_of_something_else_is_left_alone(few, tmp_path):
    out = tmp_path / "mine"
    write(out / "letter.txt", "dear")
    write(out / "figures/photo.png", "me")
    with pytest.raises(InputError, match=f"{out} exists already.*--force"):
        runner.run(SMALL, few, out)
    assert sorted(p.name for p in out.rglob("*.*")) == ["letter.txt", "photo.png"]
    runner.run(SMALL, few, out, force=True)
    assert (out / "letter.txt").read_text() == "dear" and (out / "figures/photo.png").exists()
    with pytest.raises(InputError, match="is a file"):
        runner.run(SMALL, few, out / "letter.txt")
    with pytest.raises(InputError, match="cannot make the folder"):
        runner.run(SMALL, few, out / "letter.txt/deeper")


def test_force_begins_anew_and_leaves_no_old_table(kitti, whole, few, tmp_path):
    shutil.copytree(whole, tmp_path / "out")
    records = runner.run(SMALL, few, tmp_path / "out", force=True)
    assert [p.name for p in (tmp_path / "out").rglob("*.*")] == [journal.NAME]
    write_report(tmp_path / "out", SMALL, records, points_table(records), {})
    assert [p.stem for p in (tmp_path / "out").rglob("*.csv")] == ["points"]


@pytest.mark.parametrize("first", ["", "{", "[]", '{"frame": "000000"}'])
def test_a_journal_without_a_plan_is_not_gone_on_with(few, tmp_path, first):
    write(tmp_path / "out" / journal.NAME, first + "\n")
    with pytest.raises(InputError, match=r"cannot read .*--force"):
        runner.run(SMALL, few, tmp_path / "out")
    assert len(runner.run(SMALL, few, tmp_path / "out", force=True)) == 5


def test_two_runs_do_not_write_one_folder(few, tmp_path):
    with (journal.journal(tmp_path / "out", {}) as _,
          pytest.raises(InputError, match="another process")):
        runner.run(SMALL, few, tmp_path / "out", force=True)


def test_a_full_disk_is_one_line_and_the_rest_goes_on_later(few, tmp_path, monkeypatch):
    def full(self):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(journal, "SYNC_S", -1.0)
        patch.setattr(journal.Journal, "sync", full)
        with pytest.raises(InputError, match=r"No space left.*the same command goes on"):
            runner.run(SMALL, few, tmp_path / "out")
    assert len(runner.run(SMALL, few, tmp_path / "out")) == 5


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_mistake_in_an_experiment_is_not_a_skipped_frame(few, tmp_path, jobs, capfd):
    with pytest.raises((ZeroDivisionError, InputError)) as error:
        runner.run(small(break_down), few, tmp_path / "out", jobs=jobs)
    said = capfd.readouterr().err + "".join(getattr(error.value, "__notes__", []))
    assert "while frame 000002 was measured" in said
    assert '"000002"' not in "".join(lines_of(tmp_path / "out"))


def test_a_record_that_is_no_json_is_a_mistake(few, tmp_path):
    with pytest.raises(ValueError, match="JSON"):
        runner.run(small(not_json), few, tmp_path / "out")


def test_a_process_that_is_killed_ends_the_run_with_a_reason(few, tmp_path):
    with pytest.raises(InputError, match=r"measured frames.*want of memory: try fewer --jobs"):
        runner.run(small(end_the_process), few, tmp_path / "out", jobs=2)


# Broken frames


BROKEN = {
    "velodyne/000000.bin": lambda b: b[:1003],        # cut
    "velodyne/000001.bin": lambda b: b"",             # empty
    "label_2/000002.txt": lambda b: b[:-30],          # cut in a line
    "label_2/000003.txt": lambda b: b.replace(b"1.", b"nan ", 1),
    "label_2/000004.txt": None,                       # not there
    "calib/000005.txt": None,
    "calib/000006.txt": lambda b: b[:200],
    "calib/000007.txt": lambda b: re.sub(rb"(Tr_velo_to_cam:).*", rb"\1" + b" 0" * 12, b),
    "velodyne/000008.bin": None,
    "calib/000009.txt": lambda b: re.sub(rb"(R0_rect:) \S+", rb"\1 -1", b),  # mirrored
}


def test_broken_frames_are_skipped_by_name_and_the_others_are_as_before(kitti, whole, tmp_path):
    root = tmp_path / "kitti"
    shutil.copytree(kitti, root)
    for name, change in BROKEN.items():
        path = root / "training" / name
        if change is None:
            path.unlink()
        else:
            path.write_bytes(change(path.read_bytes()))
    records = {r["frame"]: r for r in runner.run(STM_CPA, root, tmp_path / "out")}
    assert len(records) == COUNT
    for name in BROKEN:
        frame = Path(name).stem
        reason = records[frame]["skipped"]
        assert frame in reason and len(reason.splitlines()) == 1, reason
        named = "velodyne/000004.bin" if name == "label_2/000004.txt" else name
        assert (named if named != "velodyne/000008.bin" else "label_2/000008.txt") in reason
    expected = {r["frame"]: r for r in untimed(whole)}
    for name, record in records.items():
        if "skipped" not in record:
            assert {k: v for k, v in record.items() if k != "ms"} == expected[name]
    assert sum("skipped" not in r for r in records.values()) == COUNT - len(BROKEN) - 1


def test_a_folder_without_scans_or_pedestrians_is_an_error(tmp_path, kitti):
    for argument, words in ((tmp_path / "none", "is not a folder"), (tmp_path, "no KITTI scans")):
        with pytest.raises(InputError, match=words):
            command("--kitti", argument, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()
    nobody = object_folder(tmp_path / "nobody", "")
    with pytest.raises(InputError, match=r"no frame could be measured.*no Pedestrian"):
        command("--kitti", nobody, "--out", tmp_path / "out", "--jobs", 1)
    assert json.loads((tmp_path / "out/report.json").read_text())["skipped"] == 2


def test_skipped_frames_are_counted_by_reason():
    records = [{"frame": str(i), "skipped": f"/a/{i}.bin was cut"} for i in range(20)]
    records += [{"frame": "x", "skipped": "no labels"}, {"frame": "y"}]
    first, second = skipped_groups(records)
    assert (first["count"], first["reason"], len(first["names"])) == (20, "/a/0.bin was cut", 10)
    assert (second["count"], second["names"]) == (1, ["x"])


# The report


def test_every_table_and_figure_is_in_every_format(whole):
    report = json.loads((whole / "report.json").read_text())
    page = html.unescape((whole / "report.html").read_text())
    markdown = (whole / "report.md").read_text()
    tables = [t for section in report["sections"] for t in section["tables"]]
    assert {t["name"] for t in tables} >= {"table_1", "table_3_6", "table_4", "table_5", "table_8",
                                           "table_9", "search", "search_best", "figure_8"}
    assert {p.stem for p in (whole / "tables").iterdir()} == {t["name"] for t in tables}
    for table in tables:
        assert table["title"] in page and f"**{table['title']}**" in markdown
        rows = [[Cell(**c) if isinstance(c, dict) else c for c in row] for row in table["rows"]]
        read = list(csv.DictReader((whole / f"tables/{table['name']}.csv").open()))
        assert len(read) == len(rows)
        for row, there in zip(rows, read):
            for name, cell in zip(table["header"], row):
                if isinstance(cell, str):
                    assert there[name] == cell
                    continue
                for key, value in ((name, cell.value), (f"{name} low", cell.low),
                                   (f"{name} high", cell.high), (f"{name} paper", cell.paper)):
                    assert there[key] == ("" if value is None else str(value))
                value, interval, published = parts(cell)
                assert value in page and interval in page and interval in markdown
                assert not published or (f"paper {published}" in page
                                         and f"(paper {published})" in markdown)
    for figure in (f for section in report["sections"] for f in section["figures"]):
        picture = whole / f"figures/{figure['name']}.png"
        assert picture.read_bytes().startswith(b"\x89PNG")
        assert figure["title"] in page and f"(figures/{figure['name']}.png)" in markdown
    assert {p.relative_to(whole).as_posix() for p in whole.rglob("*") if p.is_file()} == {
        p.relative_to(whole).as_posix() for pattern in journal.OURS for p in whole.glob(pattern)}


def test_the_page_needs_no_other_file_and_says_what_was_run(whole, kitti):
    page = (whole / "report.html").read_text()
    assert not re.findall(r'(?:src|href|srcset)="(?!data:|#)', page) and "<script" not in page
    assert str(kitti) in page and "11 measured, 1 skipped" in page and "lidar_perception" in page
    assert "no Pedestrian is labelled" in page
    report = json.loads((whole / "report.json").read_text())
    assert (report["measured"], report["skipped"]) == (11, 1)
    assert [r["frame"] for r in report["skipped_frames"]] == ["000011"]


def test_text_is_escaped(few, tmp_path):
    records = runner.run(SMALL, few, tmp_path / "out")
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


def test_the_summary_shows_the_scores_beside_the_papers(whole):
    text = (whole.parent / "said").read_text()
    report = json.loads((whole / "report.json").read_text())
    row = next(t for s in report["sections"] for t in s["tables"]
               if t["name"] == "table_3_6")["rows"][2]
    assert f"{row[1]['value']:.1f} (46.7)" in text and f"{row[3]['value']:.1f} (52.1)" in text
    assert f"report: {whole}/report.html" in text.replace("\n", "")
    assert "skipped 1: no Pedestrian" in text


def test_a_study_runs_by_its_name(few, tmp_path, monkeypatch):
    monkeypatch.setitem(STUDIES, "points", f"{__name__}:SMALL")
    out = tmp_path / "out"
    text = command("stm-cpa", "--study", "points", "--kitti", few, "--out", out, "--jobs", 1)
    assert "skipped 1: three is not liked" in text
    expected = [len(frame.cloud()) for frame in open_kitti(few)]
    rows = list(csv.DictReader((out / "tables/points.csv").open()))
    assert [float(r["points"]) for r in rows] == np.delete(expected, 3).tolist()


@pytest.mark.parametrize("arguments, words", [
    (["--study", "luck"], "'luck' is no study"), (["other"], "'other'"), (["--jobs", "0"], "0 is"),
    (["--limit", "0"], "0 is"), (["--jobs", "2", "--dask", "a:1"], "give one of them")])
def test_what_cannot_be_asked_for_is_named(tmp_path, arguments, words):
    result = CliRunner().invoke(cli, ["reproduce", "--kitti", str(tmp_path), "--out",
                                      str(tmp_path / "out"), *arguments])
    assert result.exit_code == 2 and words in result.output
    assert not (tmp_path / "out").exists()


def test_every_study_can_be_had_by_its_name_and_is_in_the_help():
    from lidar_perception.cli.reproduce import EXPERIMENTS, _load
    text = " ".join(CliRunner().invoke(cli, ["reproduce", "--help"]).output.split())
    for name, place in {**STUDIES, **EXPERIMENTS}.items():
        assert isinstance(_load(place), Experiment)
        assert name in text
