"""The first compilation on a machine is reported, and other processes wait for it."""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys
import tempfile
import threading

import pytest
from numba import njit

from lidar_perception.runs import compiling
from lidar_perception.runs.compiling import lock_compilation, report_compilation


@pytest.fixture
def report_all(monkeypatch):
    """Report every compilation and every wait, however short."""
    monkeypatch.setattr(compiling, "REPORT_AFTER_S", 0.0)
    monkeypatch.setattr(compiling, "POLL_INTERVAL_S", 0.001)


def test_compilation_is_reported_by_the_outermost_block(report_all, capsys):
    lines = []
    with report_compilation(lines.append), report_compilation(lambda _: pytest.fail("twice")):
        assert njit(lambda x: x + 1)(1) == 2
    assert lines[0] == compiling.COMPILING_MESSAGE
    assert lines[-1].startswith("compiled 1 functions in ")
    assert lines.count(compiling.COMPILING_MESSAGE) == 1
    with report_compilation():  # on standard error by default
        njit(lambda x: x + 2)(1)
    captured = capsys.readouterr()
    assert compiling.COMPILING_MESSAGE in captured.err and captured.out == ""


def test_calls_to_compiled_code_are_not_reported(monkeypatch):
    function = njit(lambda x: x + 1)
    function(1)
    monkeypatch.setattr(compiling, "REPORT_AFTER_S", 1e-9)
    monkeypatch.setattr(compiling, "POLL_INTERVAL_S", 0.001)
    with report_compilation(pytest.fail):
        assert function(1) == 2
        threading.Event().wait(0.01)  # time for the reporter to poll


def test_waiting_for_another_process_is_reported(report_all, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    lines = []
    with open(tmp_path / f"lidar_perception-{os.getuid()}.lock", "w") as other:
        fcntl.flock(other, fcntl.LOCK_EX)

        def report(line):
            lines.append(line)
            other.close()  # releases the lock

        with lock_compilation(report):
            pass
    assert lines[0] == compiling.WAITING_MESSAGE and lines[1].startswith("waited ")
    with lock_compilation(pytest.fail):  # the lock is free
        pass


@pytest.mark.parametrize("cached", [True, False])
def test_empty_cache_is_reported_before_anything_is_compiled(cached, monkeypatch):
    monkeypatch.setattr(compiling, "_is_cached", lambda: cached)
    lines = []
    with report_compilation(lines.append), report_compilation(full_detector=True):
        assert lines == [compiling.COMPILING_MESSAGE] * (not cached)


def test_cache_is_found_where_numba_keeps_it(tmp_path):
    """Runs in a separate process, because the folder is chosen when a function is compiled."""
    code = (
        "from lidar_perception.runs.compiling import _is_cached; print(_is_cached());"
        "import numpy, lidar_perception.geometry as g;"
        "g.counting_sort(numpy.zeros(1, int), 1, numpy.zeros(1, int)); print(_is_cached())"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        text=True,
        capture_output=True,
        env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)},
        check=True,
    )
    assert done.stdout.split() == ["False", "True"]


def test_block_waits_for_another_process_that_compiles(tmp_path, monkeypatch):
    log, lines, done = tmp_path / "compile.log", [], tmp_path / "done"
    code = f"import pathlib, time; time.sleep(0.3); print('said'); pathlib.Path({str(done)!r}).touch()"
    monkeypatch.setattr(compiling, "_is_cached", lambda: True)
    with compiling.compile_in_background(code, log, lines.append):
        pass
    assert not log.exists() and not lines  # nothing to compile
    monkeypatch.setattr(compiling, "_is_cached", lambda: False)
    with compiling.compile_in_background(code, log, lines.append):
        assert not done.exists()
    assert done.exists() and log.read_text() == "said\n"
    assert len(lines) == 1 and str(log) in lines[0]
    with (
        pytest.raises(ZeroDivisionError),
        compiling.compile_in_background("import time; time.sleep(60)", log, lines.append),
    ):
        raise ZeroDivisionError  # an exception does not wait
