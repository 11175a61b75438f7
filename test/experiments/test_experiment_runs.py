"""Runs of experiments: records do not depend on processes or interruptions, bad frames are skipped, and every
report format has every number."""

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
from multiprocessing import forkserver
from pathlib import Path

import pytest
from experiment_samples import (
    COUNT,
    SMALL,
    count_points,
    make_sections,
    make_small_experiment,
    read_lines,
    read_untimed_records,
    run_reproduce,
)
from samples import wait_for_the_end, write_file, write_object_folder

from experiments.framework import report_files
from experiments.framework.experiment import Cell
from experiments.framework.report import format_cell, write_report
from experiments.framework.runner import run_experiment
from experiments.stm_cpa.experiment import STM_CPA
from lidar_perception.data.open import open_recording
from lidar_perception.runs import journal
from lidar_perception.scoring import run as scoring_run
from lidar_perception.types import InputError

pytestmark = pytest.mark.no_cover  # covered by other tests

ROOT = Path(__file__).resolve().parents[2]
TIMED = {"table_9", "table_9_median"}


def raise_bug(frames, number):
    if number == 2:
        raise ZeroDivisionError("a mistake")
    return {"frame": frames[number].name}


def measure_nan(frames, number):
    return {"frame": frames[number].name, "value": float("nan")}


def kill_process(frames, number):
    os.kill(os.getpid(), signal.SIGKILL)


def read_untimed_files(folder):
    """Return name -> content of the files without times."""
    return {
        path.name: path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.suffix in (".csv", ".png") and path.stem not in TIMED
    }


# Processes and interruptions


def test_dask_cluster_gives_the_same_records(crowd_recording, paper_run, tmp_path):
    distributed = pytest.importorskip("distributed", reason="needs the extra [distributed]")
    from dask import config

    forked = config.set({"distributed.worker.multiprocessing-method": "forkserver"})
    with (
        forked,
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster,
    ):
        address = cluster.scheduler_address
        run_experiment(STM_CPA, open_recording(crowd_recording), tmp_path / "out", dask=address)
        with pytest.raises(ZeroDivisionError):
            run_experiment(
                make_small_experiment(raise_bug), open_recording(crowd_recording), tmp_path / "broken", dask=address
            )
    assert read_untimed_records(tmp_path / "out") == read_untimed_records(paper_run)


def test_error_names_the_unreachable_scheduler(five_scans, tmp_path, monkeypatch):
    pytest.importorskip("distributed", reason="needs the extra [distributed]")
    monkeypatch.setattr(scoring_run, "CONNECT_TIMEOUT_S", 0.2)
    with pytest.raises(InputError, match="cannot reach a Dask scheduler"):
        run_experiment(SMALL, open_recording(five_scans), tmp_path / "out", dask="tcp://127.0.0.1:9")


def test_missing_distributed_names_the_extra(five_scans, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"lidar_perception\[distributed\]"):
        run_experiment(SMALL, open_recording(five_scans), tmp_path / "out", dask="tcp://127.0.0.1:9")


def test_killed_run_of_two_processes_resumes(crowd_recording, paper_run, tmp_path):
    out = tmp_path / "out"
    process = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "experiments",
            "reproduce",
            "--data",
            str(crowd_recording),
            "--out",
            str(out),
            "--jobs",
            "2",
        ],
        cwd=ROOT,
        start_new_session=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stderr=subprocess.PIPE,
    )
    while len(read_lines(out)) < 4:
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.005)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    wait_for_the_end(process.pid)  # its child processes end by themselves
    assert "Traceback" not in process.communicate()[1]
    saved_lines = read_lines(out)
    assert 4 <= len(saved_lines)  # on a busy machine, all frames may be measured before the signal arrives
    run_reproduce("--data", crowd_recording, "--out", out, "--jobs", 1)
    assert read_untimed_records(out) == read_untimed_records(paper_run)
    assert read_untimed_files(out) == read_untimed_files(paper_run)
    assert set(saved_lines[:4]) <= set(read_lines(out))  # equal durations: the frames were not measured again


@pytest.mark.parametrize("cut", [1, 2, 40])
def test_truncated_last_record_is_measured_again(five_scans, tmp_path, cut):
    expected = run_experiment(SMALL, open_recording(five_scans), tmp_path / "out")
    path = tmp_path / "out" / journal.JOURNAL_NAME
    bytes_before = path.read_bytes()
    path.write_bytes(bytes_before[:-cut])
    assert run_experiment(SMALL, open_recording(five_scans), tmp_path / "out") == expected
    assert path.read_bytes() == bytes_before


def test_finished_frames_are_not_measured_again(five_scans, tmp_path, monkeypatch):
    expected = run_experiment(SMALL, open_recording(five_scans), tmp_path / "out", limit=2)
    assert [r["frame"] for r in expected] == ["000000", "000001"]
    requests = []

    def log_measure(frames, number):
        requests.append(number)
        return count_points(frames, number)

    recording, out = open_recording(five_scans), tmp_path / "out"
    assert run_experiment(make_small_experiment(log_measure), recording, out)[:2] == expected
    assert requests == [2, 3, 4]
    assert len(run_experiment(make_small_experiment(log_measure), recording, out, limit=1)) == 1
    assert requests == [2, 3, 4]
    assert len(read_lines(tmp_path / "out")) == 1 + 4  # the plan, and frames that were not skipped


def test_skipped_frame_is_tried_again(five_scans, tmp_path):
    scan = five_scans / "training/velodyne/000001.bin"
    whole = scan.read_bytes()
    scan.write_bytes(whole[:100])
    first = run_experiment(SMALL, open_recording(five_scans), tmp_path / "out")
    assert "000001.bin" in first[1]["skipped"] and "000001.bin" in first[2]["skipped"]
    scan.write_bytes(whole)
    resumed, fresh = (run_experiment(SMALL, open_recording(five_scans), tmp_path / name) for name in ("out", "again"))
    assert resumed == fresh


# Output folders with other content


def test_error_names_the_changed_settings(five_scans, tmp_path):
    out = tmp_path / "out"
    run_experiment(make_small_experiment(limits=(1, 2), deep={"a": 1, "b": 2}), open_recording(five_scans), out)
    before = (out / journal.JOURNAL_NAME).read_bytes()
    with pytest.raises(InputError, match=r"settings.deep.b 2, not 3\).*--force") as error:
        run_experiment(make_small_experiment(limits=(1, 2), deep={"a": 1, "b": 3}), open_recording(five_scans), out)
    assert "deep.a" not in str(error.value) and "limits" not in str(error.value)
    other = write_object_folder(tmp_path / "other", count=4)
    with pytest.raises(InputError, match=r"data '.*few', not '.*other'; frames 5, not 4"):
        run_experiment(make_small_experiment(limits=(1, 2), deep={"a": 1, "b": 2}), open_recording(other), out)
    assert (out / journal.JOURNAL_NAME).read_bytes() == before
    run_experiment(SMALL, open_recording(other), out, force=True)
    assert len(run_experiment(SMALL, open_recording(other), out)) == 4


def test_folder_with_other_files_is_not_changed(five_scans, tmp_path):
    out = tmp_path / "mine"
    write_file(out / "letter.txt", "dear")
    write_file(out / "figures/photo.png", "me")
    with pytest.raises(InputError, match=f"{out} already exists.*--force"):
        run_experiment(SMALL, open_recording(five_scans), out)
    assert sorted(p.name for p in out.rglob("*.*")) == ["letter.txt", "photo.png"]
    run_experiment(SMALL, open_recording(five_scans), out, force=True)
    assert (out / "letter.txt").read_text() == "dear" and (out / "figures/photo.png").exists()
    with pytest.raises(InputError, match="is a file"):
        run_experiment(SMALL, open_recording(five_scans), out / "letter.txt")
    with pytest.raises(InputError, match="cannot create the folder"):
        run_experiment(SMALL, open_recording(five_scans), out / "letter.txt/deeper")


def test_force_removes_files_of_the_old_run_only(paper_run, five_scans, tmp_path):
    out = shutil.copytree(paper_run, tmp_path / "out")
    theirs = {write_file(out / "tables/mine.csv", "me"), write_file(out / "figures/photo.png", "me")}
    records = run_experiment(SMALL, open_recording(five_scans), out, force=True)
    assert {*out.rglob("*.*")} == {out / journal.JOURNAL_NAME, *theirs}
    write_report(out, SMALL, records, make_sections(records), {})
    assert {p.stem for p in out.rglob("*.csv")} == {"points", "mine"}


@pytest.mark.parametrize("first", ["", "{", "[]", '{"frame": "000000"}'])
def test_journal_without_plan_is_not_resumed(five_scans, tmp_path, first):
    write_file(tmp_path / "out" / journal.JOURNAL_NAME, first + "\n")
    with pytest.raises(InputError, match=r"cannot read .*--force"):
        run_experiment(SMALL, open_recording(five_scans), tmp_path / "out")
    assert len(run_experiment(SMALL, open_recording(five_scans), tmp_path / "out", force=True)) == 5


def test_folder_is_locked_by_a_run(five_scans, tmp_path):
    with journal.open_journal(tmp_path / "out", {}) as _, pytest.raises(InputError, match="another process"):
        run_experiment(SMALL, open_recording(five_scans), tmp_path / "out", force=True)


def test_full_disk_is_reported_in_one_line_and_run_resumes(five_scans, tmp_path, monkeypatch):
    def raise_disk_full(self):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(journal, "SYNC_S", -1.0)
        patch.setattr(journal.Journal, "sync", raise_disk_full)
        with pytest.raises(InputError, match=r"No space left.*the same command resumes"):
            run_experiment(SMALL, open_recording(five_scans), tmp_path / "out")
    assert len(run_experiment(SMALL, open_recording(five_scans), tmp_path / "out")) == 5


@pytest.mark.parametrize("jobs", [1, 2])
def test_exception_in_an_experiment_ends_the_run(five_scans, tmp_path, jobs, capfd):
    if jobs > 1:
        forkserver._forkserver._stop()  # the server's processes still print to its original stderr
    with pytest.raises((ZeroDivisionError, InputError)) as error:
        run_experiment(make_small_experiment(raise_bug), open_recording(five_scans), tmp_path / "out", jobs=jobs)
    message = capfd.readouterr().err + "".join(getattr(error.value, "__notes__", []))
    assert "while processing frame 000002" in message
    assert '"000002"' not in "".join(read_lines(tmp_path / "out"))


def test_record_that_is_not_json_is_rejected(five_scans, tmp_path):
    with pytest.raises(ValueError, match="JSON"):
        run_experiment(make_small_experiment(measure_nan), open_recording(five_scans), tmp_path / "out")


def test_run_ends_with_reason_if_worker_is_killed(five_scans, tmp_path):
    with pytest.raises(InputError, match=r"measured frames.*out of memory: try fewer --jobs"):
        run_experiment(make_small_experiment(kill_process), open_recording(five_scans), tmp_path / "out", jobs=2)


# Broken frames


BROKEN = {
    "velodyne/000000.bin": lambda b: b[:1003],  # cut
    "velodyne/000001.bin": lambda b: b"",  # empty
    "label_2/000002.txt": lambda b: b[:-30],  # truncated within a line
    "label_2/000003.txt": lambda b: b.replace(b"1.", b"nan ", 1),
    "label_2/000004.txt": None,  # missing
    "calib/000005.txt": None,
    "calib/000006.txt": lambda b: b[:200],
    "calib/000007.txt": lambda b: re.sub(rb"(Tr_velo_to_cam:).*", rb"\1" + b" 0" * 12, b),
    "velodyne/000008.bin": None,
    "calib/000009.txt": lambda b: re.sub(rb"(R0_rect:) \S+", rb"\1 -1", b),  # mirrored
}


def test_broken_frame_is_skipped_without_changing_others(crowd_recording, paper_run, tmp_path):
    root = tmp_path / "kitti"
    shutil.copytree(crowd_recording, root)
    for name, change in BROKEN.items():
        path = root / "training" / name
        if change is None:
            path.unlink()
        else:
            path.write_bytes(change(path.read_bytes()))
    found = run_experiment(STM_CPA, open_recording(root), tmp_path / "out")
    records = {record["frame"]: record for record in found}
    assert len(records) == COUNT
    for name in BROKEN:
        frame = Path(name).stem
        reason = records[frame]["skipped"]
        assert frame in reason and len(reason.splitlines()) == 1, reason
        named = "velodyne/000004.bin" if name == "label_2/000004.txt" else name
        assert (named if named != "velodyne/000008.bin" else "label_2/000008.txt") in reason
    expected = {r["frame"]: r for r in read_untimed_records(paper_run)}
    for name, record in records.items():
        if "skipped" not in record:
            assert {k: v for k, v in record.items() if k != "ms"} == expected[name]
    assert sum("skipped" not in r for r in records.values()) == COUNT - len(BROKEN) - 1


def test_split_selects_frames(five_scans, tmp_path):
    (five_scans / "training/velodyne/000004.bin").unlink()
    split = write_file(tmp_path / "split.txt", "000002\n000000\n")
    whole = open_recording(five_scans)
    assert [name for name, _ in whole.missing_scans] == ["000004"]
    records = run_experiment(SMALL, open_recording(five_scans, split=split), tmp_path / "out")
    assert [(r["frame"], "skipped" in r) for r in records] == [("000002", False), ("000000", False)]
    assert [r["frame"] for r in run_experiment(SMALL, whole, tmp_path / "all")][-1] == "000004"


def test_folder_without_scans_or_pedestrians_is_rejected(tmp_path):
    for argument, words in (
        (tmp_path / "none", "does not exist"),
        (tmp_path, "is not a recording in a supported format"),
    ):
        with pytest.raises(InputError, match=words):
            run_reproduce("--data", argument, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()
    nobody = write_object_folder(tmp_path / "nobody", "")
    with pytest.raises(InputError, match=r"no frame could be measured.*no Pedestrian"):
        run_reproduce("--data", nobody, "--out", tmp_path / "out", "--jobs", 1)
    assert json.loads((tmp_path / "out/report.json").read_text())["skipped"] == 2


# The report and the summary


def test_every_format_has_every_table_and_figure(paper_run):
    report = json.loads((paper_run / "report.json").read_text())
    page = html.unescape((paper_run / "report.html").read_text())
    markdown = (paper_run / "report.md").read_text()
    tables = [t for section in report["sections"] for t in section["tables"]]
    assert {t["name"] for t in tables} >= {
        "table_1",
        "table_3_6",
        "table_4",
        "table_5",
        "table_8",
        "table_9",
        "search",
        "search_best",
        "figure_8",
    }
    assert {p.stem for p in (paper_run / "tables").iterdir()} == {t["name"] for t in tables}
    for table in tables:
        assert table["title"] in page and f"**{table['title']}**" in markdown
        rows = [[Cell(**c) if isinstance(c, dict) else c for c in row] for row in table["rows"]]
        read = list(csv.DictReader((paper_run / f"tables/{table['name']}.csv").open()))
        assert len(read) == len(rows)
        for row, there in zip(rows, read):
            for name, cell in zip(table["header"], row):
                if isinstance(cell, str):
                    assert there[name] == cell
                    continue
                for key, value in (
                    (name, cell.value),
                    (f"{name} low", cell.low),
                    (f"{name} high", cell.high),
                    (f"{name} paper", cell.paper),
                ):
                    assert there[key] == ("" if value is None else str(value))
                value, interval, published = format_cell(cell)
                assert value in page and interval in page and interval in markdown
                assert not published or (f"paper {published}" in page and f"(paper {published})" in markdown)
    for figure in (f for section in report["sections"] for f in section["figures"]):
        picture = paper_run / f"figures/{figure['name']}.png"
        assert picture.read_bytes().startswith(b"\x89PNG")
        assert figure["title"] in page and f"(figures/{figure['name']}.png)" in markdown
    assert {p for p in paper_run.rglob("*") if p.is_file()} == {
        paper_run / journal.JOURNAL_NAME,
        *report_files.list_report_files(paper_run),
    }


def test_page_is_self_contained_and_describes_the_run(paper_run, crowd_recording):
    page = (paper_run / "report.html").read_text()
    assert not re.findall(r'(?:src|href|srcset)="(?!data:|#)', page) and "<script" not in page
    assert str(crowd_recording) in page and "11 measured, 1 skipped" in page and "lidar_perception" in page
    assert "no Pedestrian label" in page
    report = json.loads((paper_run / "report.json").read_text())
    assert (report["measured"], report["skipped"]) == (11, 1)
    assert [r["frame"] for r in report["skipped_frames"]] == ["000011"]


def test_summary_shows_scores_next_to_those_of_the_paper(paper_run):
    text = (paper_run.parent / "said").read_text()
    report = json.loads((paper_run / "report.json").read_text())
    row = next(t for s in report["sections"] for t in s["tables"] if t["name"] == "table_3_6")["rows"][2]
    assert f"{row[1]['value']:.1f} (46.7)" in text and f"{row[3]['value']:.1f} (52.1)" in text
    assert f"report: {paper_run}/report.html" in text.replace("\n", "")
    assert "skipped 1: no Pedestrian" in text
