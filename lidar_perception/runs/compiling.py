"""The first compilation on a machine: reported while it lasts, in one process at a time.

Numba caches what it has compiled, so a later start loads it in a few seconds.
"""

from __future__ import annotations

import fcntl
import os
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter, sleep
from typing import Any

PATIENCE = 1.0  # seconds of compiling or waiting that are not reported
EVERY = 10.0    # seconds of compilation between two reports
TICK = 0.1      # seconds

COMPILING = ("compiling numeric code for this machine, once: about a minute on a free core; the "
             "result is cached")
WAITING = "waiting for another process to compile, or to load what is compiled"


class _Compilation:
    """A listener to the events of Numba, which sends none when it loads code from its cache."""

    current: _Compilation | None = None  # of the outermost block

    def __init__(self, say: Callable[[str], object]):
        self.say, self.over = say, threading.Event()
        self.count = self.depth = 0
        self.seconds = self.begun = 0.0
        self.said = False

    def notify(self, event: Any) -> None:
        """Numba calls this, under its compiler lock, when it begins and ends a function."""
        if event.is_start:
            self.begun = self.begun if self.depth else perf_counter()
            self.depth += 1
            return
        self.depth -= 1
        self.count += 1
        if not self.depth:
            self.seconds += perf_counter() - self.begun

    def spent(self) -> float:
        """Seconds of compilation so far."""
        return self.seconds + (perf_counter() - self.begun if self.depth else 0.0)

    def begin(self) -> None:
        """Say that it begins, once."""
        if not self.said:
            self.said = True
            self.say(COMPILING)

    def report(self) -> None:
        """Say how far it is, until the block is over."""
        limit = PATIENCE
        while not self.over.wait(TICK):
            if (spent := self.spent()) < limit:
                continue
            if self.said and spent >= EVERY:
                self.say(f"compiling: {self.count} functions in {spent:.0f} s so far")
            self.begin()
            limit = max(EVERY, spent + EVERY)


@contextmanager
def compilation_reported(say: Callable[[str], object] | None = None,
                         all_of_it: bool = False) -> Iterator[None]:
    """Report when Numba compiles for more than PATIENCE seconds within the block.

    Args:
        say: takes each line; None: standard error. Of nested blocks that of the outermost.
        all_of_it: the block runs what a detector runs, so it compiles where nothing is cached yet;
            that is reported at its start, before torch is loaded.
    """
    outer = _Compilation.current
    if outer is not None:
        if all_of_it and not _cached():
            outer.begin()
        yield
        return
    from numba.core import event
    if say is None:
        from lidar_perception.runs.terminal import errors
        say = errors.print
    event.Listener.register(_Compilation)  # as a base class numba would be loaded at import
    _Compilation.current = compilation = _Compilation(say)
    reporter = threading.Thread(target=compilation.report, daemon=True)
    event.register("numba:compile", compilation)
    reporter.start()
    try:
        if all_of_it and not _cached():
            compilation.begin()
        yield
    finally:
        _Compilation.current = None
        event.unregister("numba:compile", compilation)
        compilation.over.set()
        reporter.join()
    if compilation.count and compilation.said:
        say(f"compiled {compilation.count} functions in {compilation.seconds:.1f} s")


def _cached() -> bool:
    """Return True if Numba has cached a function that all detectors use, since its file changed."""
    from lidar_perception import geometry
    function: Any = geometry.counting_sort
    source = Path(geometry.__file__)
    if not hasattr(function, "stats"):  # NUMBA_DISABLE_JIT
        return True
    indices = Path(function.stats.cache_path).glob(f"{source.stem}.{function.__name__}-*.nbi")
    return any(index.stat().st_mtime >= source.stat().st_mtime for index in indices)


@contextmanager
def one_at_a_time(say: Callable[[str], object]) -> Iterator[None]:
    """Wait until no other process of this user is in such a block.

    The first node compiles and the others load what it has cached. If all compiled the same
    functions at once on few cores, each would take as many times longer.

    Args:
        say: takes a line when the wait is long, and one with its duration.
    """
    with open(Path(tempfile.gettempdir()) / f"lidar_perception-{os.getuid()}.lock", "w") as lock:
        begin, said = perf_counter(), False
        while not _locked(lock):
            sleep(TICK)
            if not said and perf_counter() - begin > PATIENCE:
                say(WAITING)
                said = True
        if said:
            say(f"waited {perf_counter() - begin:.1f} s for another process to compile")
        yield


def _locked(file: Any) -> bool:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
