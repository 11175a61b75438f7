"""Thread settings of numerical libraries for machines on which processes share the cores."""

from __future__ import annotations

import os
import sys

from lidar_perception.runs.machine import count_cores

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
# Settings of OpenMP with which idle threads sleep after a short spin. They spin at all because the next
# layer of a network follows within microseconds; GOMP_SPINCOUNT is specific to GNU's OpenMP.
PASSIVE_WAITING = {"OMP_WAIT_POLICY": "passive", "GOMP_SPINCOUNT": "1000"}

_thread_count = 0  # 0 if not set


def set_thread_count(count: int) -> None:
    """Set the number of threads with which networks run in compiled kernels and in torch."""
    global _thread_count
    _thread_count = count
    set_torch_threads()


def set_torch_threads() -> None:
    """Apply the count of set_thread_count() to torch, if torch is loaded."""
    torch = sys.modules.get("torch")
    if _thread_count and torch is not None:
        torch.set_num_threads(_thread_count)


def get_thread_count() -> int:
    """Return the number of threads with which networks run.

    It is the first of these that is set: the count of set_thread_count(), OMP_NUM_THREADS, and the
    number of cores.
    """
    omp_threads = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0]
    return _thread_count or (int(omp_threads) if omp_threads.isdigit() else 0) or count_cores()


def use_passive_waiting() -> None:
    """Make idle OpenMP threads sleep after a short spin. Call this before torch is loaded.

    Settings of the user in the environment take precedence. NumPy's OpenBLAS has no such setting,
    and for matrices of three columns it is not faster with several threads, so it gets one thread.

    Run time of the detector `fused` on two cores, if the cores are free or shared with two busy
    processes:

        idle threads                 free cores    shared cores
        spin shortly, then sleep       102 ms         230 ms
        sleep at once                  120 ms         245 ms
        spin                            96 ms         339 ms
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if not PASSIVE_WAITING.keys() & os.environ.keys():
        os.environ.update(PASSIVE_WAITING)


def default_to_one_thread() -> None:
    """Set the default number of threads of each library to one, for processes that share few cores.

    Threads of linear algebra libraries spin while they wait. set_thread_count() can give torch more
    threads, which sleep while idle. Call this before the libraries are loaded. Settings of the user
    in the environment take precedence.
    """
    for variable in THREAD_VARIABLES:
        os.environ.setdefault(variable, "1")
    use_passive_waiting()


def limit_to_one_thread() -> None:
    """Limit each library in this process to one thread, even if the user has set another number.

    The limit also applies to libraries that are loaded later. Two processes on two free cores
    prepare 35 scenes per second with this limit, and 8 with two threads each.
    """
    from threadpoolctl import threadpool_limits  # imported here to keep commands fast

    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))
    threadpool_limits(1)
    set_thread_count(1)
