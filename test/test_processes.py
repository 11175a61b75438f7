"""Processes that work for another one end with it, and give back what they hold; freed memory stays
with those that work on clouds."""

from __future__ import annotations

import itertools
import multiprocessing
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from time import sleep

import numpy as np
import pytest
from threadpoolctl import threadpool_info

from lidar_perception.runs import processes

HELD = []
ROOT = Path(__file__).resolve().parents[1]


def holding() -> Callable[[int], bytes]:
    """Work that holds many semaphores of the system and makes more than a pipe takes."""
    HELD.extend(multiprocessing.get_context("forkserver").Semaphore() for _ in range(40))
    return lambda item: bytes(300_000)


def stubborn() -> Callable[[int], int | None]:
    """Work that says who does it, and then takes long, whatever it is told."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    return lambda item: os.getpid() if item < 2 else sleep(600)


def counting() -> Callable[[int], int]:
    """Work that says with how many threads matrices are multiplied."""
    np.ones((2, 2)) @ np.ones((2, 2))
    return lambda item: max(library["num_threads"] for library in threadpool_info())


def result_of(script: str, **environment: str) -> subprocess.CompletedProcess:
    path = os.pathsep.join(map(str, (ROOT, ROOT / "test", ROOT / "test/support")))
    return subprocess.run([sys.executable, "-c", script], text=True, capture_output=True,
                          env={**os.environ, "PYTHONPATH": path, **environment}, check=False)


@pytest.mark.skipif(os.cpu_count() == 1, reason="has one core")
def test_processes_that_share_the_cores_compute_with_one_thread_each():
    """Threads of linear algebra wait actively, for each other and for those of other processes."""
    script = ("from lidar_perception.runs.processes import in_order, in_processes\n"
              "from test_processes import counting\n"
              "print(*in_processes(counting, [0, 1], 2, 'worked'),\n"
              "      *in_order(counting, [0], 1, 1, 'worked'),\n"
              "      *in_processes(counting, [0], 1, 'worked', apart=True))\n")
    assert result_of(script, OPENBLAS_NUM_THREADS="2").stdout.split() == ["1", "1", "1", "2"]


def test_processes_that_are_ended_give_back_what_they_hold():
    script = ("import itertools\n"
              "from lidar_perception.runs.processes import in_order\n"
              "from test_processes import holding\n"
              "for _ in range(8):\n"
              "    made = in_order(holding, itertools.count(), 2, 4, 'worked')\n"
              "    assert [len(next(made)) for _ in range(3)] == [300_000] * 3\n"
              "    made.close()\n")
    run = result_of(script)
    assert (run.returncode, run.stderr) == (0, "")


def test_a_process_that_does_not_end_when_it_is_asked_to_is_killed(monkeypatch):
    """Else who waits for its end would wait for ever."""
    monkeypatch.setattr(processes, "PATIENCE", 0.2)
    made = processes.in_order(stubborn, itertools.count(), 2, 2, "worked")
    stuck = [next(made), next(made)]
    made.close()
    for process in stuck:
        with pytest.raises(ProcessLookupError):
            os.kill(process, 0)


@pytest.mark.skipif(os.confstr("CS_GNU_LIBC_VERSION") is None, reason="not glibc")
@pytest.mark.parametrize("own", [{}, {"MALLOC_TRIM_THRESHOLD_": "131072"}],
                         ids=["ours", "the user's"])
def test_memory_is_used_again_where_the_user_does_not_say_otherwise(own):
    """Counted in pages that the system gives out."""
    script = ("import resource\n"
              "import numpy as np\n"
              "from lidar_perception.runs.memory import keep_freed\n"
              "keep_freed()\n"
              "for _ in range(2):\n"
              "    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt\n"
              "    for _ in range(5):\n"
              "        np.ones(8_000_000)\n"
              "print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)\n")
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("MALLOC", "GLIBC"))}
    pages = int(subprocess.check_output([sys.executable, "-c", script], env=environment | own))
    assert (pages > 100) == bool(own)
