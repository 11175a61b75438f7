"""The scoring loop gives equal results in the same order in one process, in many, and on Dask."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field, replace
from functools import partial

import pytest
from cli_samples import read_error_line, run_main
from hypothesis import given
from hypothesis import strategies as st
from samples import make_walker_label, write_file, write_object_folder

from lidar_perception.data.open import open_recording
from lidar_perception.scoring.detections import measure_result_files
from lidar_perception.scoring.run import SkipReason, fill_report, measure_frames, sort_results
from lidar_perception.types import InputError, RunError

COUNT = 5


@dataclass
class Names:
    """Report that collects the names of its frames."""

    names: list = field(default_factory=list)
    skipped: list = field(default_factory=list)

    def update(self, result):
        self.names.append(result[0])

    def compute(self):
        return vars(self)


def start_counting(recording):
    """Return (name, number of points) of a frame; None for 000003, which has no labels."""
    return lambda frame: frame.truth() and (frame.name, len(frame.load()))


def start_ending(name, recording):
    def measure(frame):
        if frame.name == name:
            raise RunError(f"cannot go on after {frame.name}")
        return frame.name, 0

    return measure


@pytest.fixture
def root(tmp_path):
    """Five frames: the scan of 000001 is truncated, 000003 has no labels."""
    root = write_object_folder(tmp_path / "kitti", make_walker_label(), COUNT)
    write_file(root / "training/velodyne/000001.bin", b"123")
    (root / "training/label_2/000003.txt").unlink()
    return root


def test_results_do_not_depend_on_number_of_processes(root):
    recording = open_recording(root)
    one, two = ([*measure_frames(recording, start_counting, jobs=jobs)] for jobs in (1, 2))
    kinds = [type(result) for _, result in one]
    assert one == two and kinds == [type(result) for _, result in two]
    assert kinds == [tuple, SkipReason, tuple, type(None), tuple]
    assert [i for i, _ in one] == [*range(COUNT)]
    selection = [1, 2, 4]
    assert [*measure_frames(recording, start_counting, selection)] == [one[i] for i in selection]
    assert [*measure_frames(recording, start_counting, [], jobs=3)] == []


def test_processes_measure_the_frames_of_a_split(root, tmp_path):
    split = write_file(tmp_path / "split.txt", "000004 000000 000002")
    found = [[*measure_frames(open_recording(root, split=split), start_counting, jobs=jobs)] for jobs in (1, 2)]
    assert found[0] == found[1]
    assert [name for _, (name, _) in found[0]] == ["000004", "000000", "000002"]


@pytest.mark.parametrize("jobs", [1, 2])
def test_unreadable_frame_is_skipped_by_name(root, jobs):
    recording, report = open_recording(root), Names()
    fill_report(report, recording, start_counting, jobs=jobs)
    (line,) = report.skipped
    assert report.names == ["000000", "000002", "000004"]
    assert "000001.bin" in line and "\n" not in line


@pytest.mark.parametrize("jobs", [1, 2])
def test_fatal_error_keeps_earlier_results(root, jobs):
    report = Names()
    with pytest.raises(InputError, match=r"^cannot go on after 000002$"):
        fill_report(report, open_recording(root), functools.partial(start_ending, "000002"), jobs=jobs)
    assert report.skipped == [] and "000002" not in report.names
    assert report.names == ["000000", "000001"][: len(report.names)]


def test_failed_run_is_reported_in_one_line(root, tmp_path, monkeypatch, capsys):
    (tmp_path / "found").mkdir()
    for jobs in 1, 2:
        assert (
            run_main(
                monkeypatch, "evaluate", "detection", "--data", root, "--results", tmp_path / "found", "--jobs", jobs
            )
            == 2
        )
        assert "result file" in read_error_line(capsys)
    with pytest.raises(RunError):
        [*measure_frames(open_recording(root), partial(measure_result_files, tmp_path / "found"))]


def test_programming_error_is_raised_with_frame_name(root):
    def mistaken(recording):
        return lambda frame: 1 // (frame.name != "000002")

    with pytest.raises(ZeroDivisionError) as error:
        [*measure_frames(open_recording(root), mistaken)]
    assert error.value.__notes__ == ["while processing frame 000002"]


@pytest.mark.parametrize(
    "limit, expected",
    [
        (None, ["000000", "000002", "000004"]),
        (1, ["000000"]),
        (3, ["000000", "000002"]),
        (99, ["000000", "000002", "000004"]),
    ],
)
def test_limit_reads_no_other_frames(root, limit, expected):
    touched = []

    def noting(recording):
        measure = start_counting(recording)
        return lambda frame: touched.append(frame.name) or measure(frame)

    report = Names()
    fill_report(report, open_recording(root), noting, limit=limit)
    assert report.names == expected
    assert touched == [f"00000{i}" for i in range(min(limit or COUNT, COUNT))]


def test_setup_and_measurements_run_lazily_and_once(root):
    called = []

    def start(recording):
        called.append("start")
        return lambda frame: called.append(frame.name)

    found = measure_frames(open_recording(root), start)
    assert called == []
    next(found)
    assert called == ["start", "000000"]
    assert len([*found]) == COUNT - 1 and len(called) == 1 + COUNT


def test_recording_without_reopen_needs_one_process(root):
    recording = replace(open_recording(root), reopen=None)
    assert len([*measure_frames(recording, start_counting)]) == COUNT


@given(st.sets(st.integers(0, 20)), st.randoms(use_true_random=False))
def test_results_are_yielded_in_order_as_soon_as_possible(numbers, random):
    numbers = sorted(numbers)
    sent, taken = random.sample(numbers, len(numbers)), []

    def pairs():
        for number in sent:
            taken.append(number)
            yield number, -number

    for k, pair in enumerate(sort_results(pairs(), numbers)):
        assert pair == (numbers[k], -numbers[k])
        needed = 1 + max(sent.index(number) for number in numbers[: k + 1])
        assert taken == sent[:needed]  # no more than needed
    assert taken == sent
