"""The first compilation on a machine is reported, and waited for by other processes."""

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
from lidar_perception.runs.compiling import compilation_reported, one_at_a_time


@pytest.fixture
def patience(monkeypatch):
    """Every compilation and every wait is long."""
    monkeypatch.setattr(compiling, "PATIENCE", 0.0)
    monkeypatch.setattr(compiling, "TICK", 0.001)


def test_compilation_is_reported_by_the_outermost_block(patience, capsys):
    lines = []
    with compilation_reported(lines.append), compilation_reported(lambda _: pytest.fail("twice")):
        assert njit(lambda x: x + 1)(1) == 2
    assert lines[0] == compiling.COMPILING and lines[-1].startswith("compiled 1 functions in ")
    assert lines.count(compiling.COMPILING) == 1
    with compilation_reported():  # again, and on standard error
        njit(lambda x: x + 2)(1)
    captured = capsys.readouterr()
    assert compiling.COMPILING in captured.err and captured.out == ""


def test_what_is_compiled_already_is_not_reported(monkeypatch):
    function = njit(lambda x: x + 1)
    function(1)
    monkeypatch.setattr(compiling, "PATIENCE", 1e-9)
    monkeypatch.setattr(compiling, "TICK", 0.001)
    with compilation_reported(pytest.fail):
        assert function(1) == 2
        threading.Event().wait(0.01)  # the reporter has looked


def test_wait_for_another_process_is_reported(patience, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    lines = []
    with open(tmp_path / f"lidar_perception-{os.getuid()}.lock", "w") as other:
        fcntl.flock(other, fcntl.LOCK_EX)

        def say(line):
            lines.append(line)
            other.close()  # it is done

        with one_at_a_time(say):
            pass
    assert lines[0] == compiling.WAITING and lines[1].startswith("waited ")
    with one_at_a_time(pytest.fail):  # it is free
        pass


@pytest.mark.parametrize("cached", [True, False])
def test_empty_cache_is_reported_before_anything_is_compiled(cached, monkeypatch):
    monkeypatch.setattr(compiling, "_cached", lambda: cached)
    lines = []
    with compilation_reported(lines.append), compilation_reported(all_of_it=True):
        assert lines == [compiling.COMPILING] * (not cached)


def test_cache_is_found_where_numba_keeps_it(tmp_path):
    """In a process of its own, as the folder is chosen when a function is compiled."""
    code = ("from lidar_perception.runs.compiling import _cached; print(_cached());"
            "import numpy, lidar_perception.geometry as g;"
            "g.stable_order(numpy.zeros(1, int), 1, numpy.zeros(1, int)); print(_cached())")
    done = subprocess.run([sys.executable, "-c", code], text=True, capture_output=True,
                          env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}, check=True)
    assert done.stdout.split() == ["False", "True"]
