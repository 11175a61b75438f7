"""Threads that soon wait for work asleep, not spinning, where other programs need the cores too."""

from __future__ import annotations

import os

ONE_EACH = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
# The standard; GNU's own: to look so often first, as the next layer follows within microseconds.
WAIT_ASLEEP = {"OMP_WAIT_POLICY": "passive", "GOMP_SPINCOUNT": "1000"}


def wait_asleep() -> None:
    """For OpenMP, which torch uses; it reads the environment when it is loaded, so call this
    before. What the user has set stays. `fused` takes 102 ms on two free cores so, 120 where
    threads sleep at once and 96 where they spin; beside two busy processes 230, 245 and 339.
    NumPy's OpenBLAS cannot do that, and gains nothing with matrices of three columns: one
    thread."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if not WAIT_ASLEEP.keys() & os.environ.keys():
        os.environ.update(WAIT_ASLEEP)


def one_thread_each() -> None:
    """For processes that share few cores: libraries of linear algebra wait actively, too, so each
    takes one thread, and torch's, which takes more where it is told to, wait asleep. Call this
    before they are loaded. What the user has set stays."""
    for variable in ONE_EACH:
        os.environ.setdefault(variable, "1")
    wait_asleep()


def one_thread_here() -> None:
    """Of each library in this process from now on, whether it is loaded yet or not, and whatever
    the user has set for others. Two processes that prepare scenes make 35 a second so on two free
    cores, and 8 where each has two threads for matrices."""
    from threadpoolctl import threadpool_limits  # which commands need not wait for
    os.environ.update(dict.fromkeys(ONE_EACH, "1"))
    threadpool_limits(1)
