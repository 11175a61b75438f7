"""Threads that wait for work asleep, not spinning, where other programs need the cores too."""

from __future__ import annotations

import os

ONE_EACH = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
WAIT_ASLEEP = {"OMP_WAIT_POLICY": "passive", "GOMP_SPINCOUNT": "0"}  # the standard; GNU's own


def wait_asleep() -> None:
    """For OpenMP, which torch uses; it reads the environment when it is loaded, so call this
    before. What the user has set stays. A network of 12 convolutions on two cores with other load:
    390 to 540 ms so, 1020 to 1070 spinning; with two more busy processes 690 to 1190 and 2420 to
    2910."""
    if not WAIT_ASLEEP.keys() & os.environ.keys():
        os.environ.update(WAIT_ASLEEP)


def one_thread_each() -> None:
    """For processes that share few cores: libraries of linear algebra wait actively, too, so each
    takes one thread, and torch's, which takes more where it is told to, wait asleep. Call this
    before they are loaded. What the user has set stays."""
    for variable in ONE_EACH:
        os.environ.setdefault(variable, "1")
    wait_asleep()
