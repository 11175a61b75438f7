"""Worker processes end with their parent and release resources; freed memory is kept."""

from __future__ import annotations

import functools
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

from lidar_perception.detectors.open import DetectorChoice
from lidar_perception.runs import processes

SEMAPHORES = []
ROOT = Path(__file__).resolve().parents[1]


def hold_semaphores() -> Callable[[int], bytes]:
    """Create many semaphores; each result is larger than the buffer of a pipe."""
    SEMAPHORES.extend(multiprocessing.get_context("forkserver").Semaphore() for _ in range(40))
    return lambda item: bytes(300_000)


def ignore_sigterm() -> Callable[[int], int | None]:
    """Return the process id for two items, then sleep and ignore SIGTERM."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    return lambda item: os.getpid() if item < 2 else sleep(600)


def count_threads() -> Callable[[int], int]:
    """Return the number of threads that multiply matrices."""
    np.ones((2, 2)) @ np.ones((2, 2))
    return lambda item: max(library["num_threads"] for library in threadpool_info())


def run_script(script: str, **environment: str) -> subprocess.CompletedProcess:
    path = os.pathsep.join(map(str, (ROOT, ROOT / "test", ROOT / "test/support")))
    return subprocess.run(
        [sys.executable, "-c", script],
        text=True,
        capture_output=True,
        env={**os.environ, "PYTHONPATH": path, **environment},
        check=False,
    )


@pytest.mark.skipif(os.cpu_count() == 1, reason="has one core")
def test_processes_that_share_cores_use_one_thread_each():
    """Threads of linear algebra libraries use CPU time while they wait."""
    script = (
        "from lidar_perception.runs.processes import run_in_order, run_in_processes\n"
        "from test_processes import count_threads\n"
        "print(*run_in_processes(count_threads, [0, 1], 2, 'worked'),\n"
        "      *run_in_order(count_threads, [0], 1, 1, 'worked'),\n"
        "      *run_in_processes(count_threads, [0], 1, 'worked', separate=True))\n"
    )
    assert run_script(script, OPENBLAS_NUM_THREADS="2").stdout.split() == ["1", "1", "1", "2"]


@pytest.mark.parametrize(
    "work",
    [
        DetectorChoice("pointnet"),
        DetectorChoice("pointnet").open,
        functools.partial(map, DetectorChoice("pointnet").open),
    ],
)
def test_processes_share_the_imports_of_a_detector(work):
    """Opening a detector imports torch, which takes longer than detecting for some clouds."""
    assert "lidar_perception.detectors.pointnet.detector" in processes._find_modules(work)
    assert "torch" not in str(processes._find_modules(DetectorChoice("tests:Own").open))


def test_ended_processes_release_system_resources():
    script = (
        "import itertools\n"
        "from lidar_perception.runs.processes import run_in_order\n"
        "from test_processes import hold_semaphores\n"
        "for _ in range(8):\n"
        "    results = run_in_order(hold_semaphores, itertools.count(), 2, 4, 'worked')\n"
        "    assert [len(next(results)) for _ in range(3)] == [300_000] * 3\n"
        "    results.close()\n"
    )
    run = run_script(script)
    assert (run.returncode, run.stderr) == (0, "")


def test_process_that_ignores_sigterm_is_killed(monkeypatch):
    monkeypatch.setattr(processes, "EXIT_TIMEOUT_S", 0.2)
    results = processes.run_in_order(ignore_sigterm, itertools.count(), 2, 2, "worked")
    stuck = [next(results), next(results)]
    results.close()
    for process in stuck:
        with pytest.raises(ProcessLookupError):
            os.kill(process, 0)


@pytest.mark.skipif(os.confstr("CS_GNU_LIBC_VERSION") is None, reason="not glibc")
@pytest.mark.parametrize("user", [{}, {"MALLOC_TRIM_THRESHOLD_": "131072"}], ids=["default", "set by the user"])
def test_freed_memory_is_reused_unless_malloc_is_configured(user):
    """Count the page faults of repeated allocations."""
    script = (
        "import resource\n"
        "import numpy as np\n"
        "from lidar_perception.runs.memory import keep_freed_memory\n"
        "keep_freed_memory()\n"
        "for _ in range(2):\n"
        "    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt\n"
        "    for _ in range(5):\n"
        "        np.ones(8_000_000)\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)\n"
    )
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("MALLOC", "GLIBC"))}
    pages = int(subprocess.check_output([sys.executable, "-c", script], env=environment | user))
    assert (pages > 100) == bool(user)


@pytest.mark.parametrize("count", [1, 5, 57, 1001])
def test_processes_get_equal_runs_of_consecutive_items(count):
    """Consecutive items share work, such as scans of one street or clouds of one chunk."""
    items = list(range(count))
    shares = [processes.deal_items(items, 3, job) for job in range(3)]
    assert sorted(itertools.chain(*shares)) == items
    assert max(map(len, shares)) - min(map(len, shares)) <= max(1, count // 48)
    together = sum(b == a + 1 for share in shares for a, b in itertools.pairwise(share))
    assert together >= count - 3 * (processes.RUNS_PER_PROCESS + 1) - count % 48
