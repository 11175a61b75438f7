"""Threads that soon wait for work asleep, not spinning, where other programs need the cores too."""

from __future__ import annotations

import os

ONE_EACH = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
# The standard; GNU's own: to look so often first, as the next layer follows within microseconds.
WAIT_ASLEEP = {"OMP_WAIT_POLICY": "passive", "GOMP_SPINCOUNT": "1000"}


def wait_asleep() -> None:
    """For OpenMP, which torch uses; it reads the environment when it is loaded, so call this
    before. What the user has set stays. `fused` takes 102 ms on two free cores so, 120 where
    threads sleep at once and 96 where they spin; beside two busy processes 230, 245 and 339."""
    if not WAIT_ASLEEP.keys() & os.environ.keys():
        os.environ.update(WAIT_ASLEEP)


def one_thread_each() -> None:
    """For processes that share few cores: libraries of linear algebra wait actively, too, so each
    takes one thread, and torch's, which takes more where it is told to, wait asleep. Call this
    before they are loaded. What the user has set stays."""
    for variable in ONE_EACH:
        os.environ.setdefault(variable, "1")
    wait_asleep()
