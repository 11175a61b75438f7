"""Tests of the journal file: killed processes, full disks, other drives."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys

import pytest

from lidar_perception.types import InputError
from lidar_studio.journal import JOURNAL_NAME, Journal, make_journal_header, open_journal

HEADER = make_journal_header("drive", ["a", "b c"], [1, 2])


def make_lines(count):
    return [{"seq": i, "do": "check", "frame": i, "checked": True} for i in range(1, count + 1)]


def write_journal(folder, count):
    """Write a journal with `count` actions and return its bytes."""
    with open_journal(folder, HEADER) as journal:
        for line in make_lines(count):
            journal.append(line)
    return (folder / JOURNAL_NAME).read_bytes()


def test_appended_lines_are_read_back(tmp_path):
    content = write_journal(tmp_path, 3)
    with open_journal(tmp_path, HEADER) as journal:
        assert journal.lines == make_lines(3) and journal.message is None
    assert (tmp_path / JOURNAL_NAME).read_bytes() == content


def test_incomplete_last_line_is_removed(tmp_path):
    content = write_journal(tmp_path, 2)
    first = content.index(b"\n") + 1
    for size in range(len(content)):
        (tmp_path / JOURNAL_NAME).write_bytes(content[:size])
        with open_journal(tmp_path, HEADER) as journal:
            complete_lines = content[:size].count(b"\n")
            assert journal.lines == make_lines(2)[: max(complete_lines - 1, 0)]
            is_incomplete = size not in (0, first) and content[size - 1 : size] != b"\n"
            assert (journal.message is not None) == is_incomplete
            journal.append({"seq": len(journal.lines) + 1, "do": "undo"})
        with open_journal(tmp_path, HEADER) as journal:
            assert journal.lines[-1]["do"] == "undo" and journal.message is None


WRITER = """
import sys
from pathlib import Path
from lidar_studio.journal import make_journal_header, open_journal
with open_journal(Path(sys.argv[1]), make_journal_header("drive", ["a", "b c"], [1, 2])) as journal:
    for i in range(1, 10**9):
        journal.append({"seq": i, "do": "check", "frame": i, "checked": True, "pad": "x" * 5000})
        print(i, flush=True)
"""


def test_kill_while_writing_loses_no_confirmed_action(tmp_path):
    for stop in (1, 20, 37):
        folder = tmp_path / str(stop)
        with subprocess.Popen(
            [sys.executable, "-c", WRITER, str(folder)], text=True, stdout=subprocess.PIPE
        ) as process:
            last = 0
            for text in process.stdout:
                last = int(text)
                if last == stop:
                    process.send_signal(signal.SIGKILL)
        with open_journal(folder, HEADER) as journal:
            assert len(journal.lines) >= last >= stop
            assert [line["seq"] for line in journal.lines] == list(range(1, len(journal.lines) + 1))


def test_journal_is_locked_until_its_process_is_killed(tmp_path):
    with subprocess.Popen([sys.executable, "-c", WRITER, str(tmp_path)], text=True, stdout=subprocess.PIPE) as process:
        process.stdout.readline()
        with pytest.raises(InputError, match="another process"), open_journal(tmp_path, HEADER):
            pass
        process.kill()
        process.stdout.read()
    with open_journal(tmp_path, HEADER) as journal:
        assert journal.lines


@pytest.mark.parametrize(
    "header",
    [
        make_journal_header("other", ["a", "b c"], [1, 2]),
        make_journal_header("drive", ["a"], [1]),
        make_journal_header("drive", ["a", "b"], [1, 2]),
        make_journal_header("drive", ["a", "b c"], [1, 3]),
    ],
)
def test_journal_of_another_drive_is_rejected_unchanged(tmp_path, header):
    content = write_journal(tmp_path, 2)
    with pytest.raises(InputError, match="another drive"), open_journal(tmp_path, header):
        pass
    assert (tmp_path / JOURNAL_NAME).read_bytes() == content


@pytest.mark.parametrize("content", [b"\x00\x01", b"[1]\n", b"{}\n", b"no journal"])
def test_invalid_journal_is_rejected_unchanged(tmp_path, content):
    (tmp_path / JOURNAL_NAME).write_bytes(content)
    with pytest.raises(InputError), open_journal(tmp_path, HEADER):
        pass
    assert (tmp_path / JOURNAL_NAME).read_bytes() == content


def test_missing_or_invalid_line_is_rejected(tmp_path):
    lines = write_journal(tmp_path, 3).splitlines(keepends=True)
    for damaged_lines in (lines[:2] + lines[3:], [*lines[:2], b"{\n", *lines[3:]]):
        (tmp_path / JOURNAL_NAME).write_bytes(b"".join(damaged_lines))
        with pytest.raises(InputError), open_journal(tmp_path, HEADER):
            pass


FULL = """
import json, resource, sys
from pathlib import Path
from lidar_studio.journal import make_journal_header, open_journal
from lidar_perception.types import InputError
with open_journal(Path(sys.argv[1]), make_journal_header("drive", ["a", "b c"], [1, 2])) as journal:
    resource.setrlimit(resource.RLIMIT_FSIZE, (3000, resource.RLIM_INFINITY))
    done = 0
    try:
        while True:
            journal.append({"seq": done + 1, "do": "undo", "pad": "x" * 300})
            done += 1
    except InputError as error:
        print(done, error)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10**6, resource.RLIM_INFINITY))
    journal.append({"seq": done + 1, "do": "redo"})
"""


def test_full_disk_is_reported_and_writing_continues_later(tmp_path):
    result = subprocess.run([sys.executable, "-c", FULL, str(tmp_path)], text=True, check=True, capture_output=True)
    done, _, message_text = result.stdout.partition(" ")
    assert "cannot write" in message_text and int(done) > 3
    with open_journal(tmp_path, HEADER) as journal:
        assert len(journal.lines) == int(done) + 1 and journal.message is None
        assert journal.lines[-1]["do"] == "redo"


@pytest.mark.parametrize("is_replaced", [False, True])
def test_removed_journal_accepts_no_more_lines(tmp_path, is_replaced):
    with open_journal(tmp_path, HEADER) as journal:
        journal.append(make_lines(1)[0])
        (tmp_path / JOURNAL_NAME).unlink()
        if is_replaced:
            (tmp_path / JOURNAL_NAME).write_text("other")
        with pytest.raises(InputError, match="removed or replaced"):
            journal.append(make_lines(2)[1])
    assert not is_replaced or (tmp_path / JOURNAL_NAME).read_text() == "other"


def test_unwritable_folder_is_reported(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="is a file"), open_journal(tmp_path / "file", HEADER):
        pass
    (tmp_path / JOURNAL_NAME).mkdir()
    with pytest.raises(InputError, match="cannot open"):
        Journal(tmp_path, HEADER)


def test_non_finite_numbers_are_not_written(tmp_path):
    with open_journal(tmp_path, HEADER) as journal, pytest.raises(ValueError):
        journal.append({"seq": 1, "box": float("nan")})
    content = (tmp_path / JOURNAL_NAME).read_text()
    assert [json.loads(line) for line in content.splitlines()] == [HEADER]
    assert os.listdir(tmp_path) == [JOURNAL_NAME]
