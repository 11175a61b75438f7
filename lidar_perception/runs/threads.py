"""Settings of the threads of numerical libraries, for machines whose cores are shared."""

from __future__ import annotations

import os
import sys

from lidar_perception.runs.machine import count_cores

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
# Variables of the OpenMP standard and of GNU's OpenMP. Threads spin this often before they sleep,
# because the next layer of a network follows within microseconds.
PASSIVE_WAITING = {"OMP_WAIT_POLICY": "passive", "GOMP_SPINCOUNT": "1000"}

_thread_count = 0  # 0 if not set


def set_thread_count(count: int) -> None:
    """Set the number of threads of networks, in compiled kernels and in torch."""
    global _thread_count
    _thread_count = count
    set_torch_threads()


def set_torch_threads() -> None:
    """Apply set_thread_count() to torch if torch is loaded."""
    torch = sys.modules.get("torch")
    if _thread_count and torch is not None:
        torch.set_num_threads(_thread_count)


def thread_count() -> int:
    """Return the number of threads of networks: as set, or as OMP_NUM_THREADS says, or one per
    core."""
    by_environment = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0]
    return _thread_count or (int(by_environment) if by_environment.isdigit() else 0) or (count_cores())


def use_passive_waiting() -> None:
    """Make idle OpenMP threads sleep instead of spinning. Call this before torch is loaded.

    The user's own settings in the environment are kept. `fused` takes 102 ms on two free cores,
    120 ms if threads sleep at once and 96 ms if they spin; with two busy processes 230, 245 and
    339 ms. NumPy's OpenBLAS has no such setting and gains nothing for matrices of three columns,
    so it gets one thread.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if not PASSIVE_WAITING.keys() & os.environ.keys():
        os.environ.update(PASSIVE_WAITING)


def default_to_one_thread() -> None:
    """Set one thread per library as default, for processes that share few cores.

    Threads of linear algebra libraries spin while they wait. torch may use more threads if asked
    to; they sleep while idle. Call this before the libraries are loaded. The user's own settings in
    the environment are kept.
    """
    for variable in THREAD_VARIABLES:
        os.environ.setdefault(variable, "1")
    use_passive_waiting()


def limit_to_one_thread() -> None:
    """Limit each library in this process to one thread, loaded or not, against the user's settings.

    Two processes that prepare scenes on two free cores make 35 scenes per second, but 8 with two
    threads for matrices in each.
    """
    from threadpoolctl import threadpool_limits  # imported here to keep commands fast

    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))
    threadpool_limits(1)
    set_thread_count(1)
