"""Progress reports and locks for the first compilation on a machine.

Numba caches compiled code, so later starts take only a few seconds.
"""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter, sleep
from typing import Any

REPORT_AFTER_S = 1.0  # minimum duration of compilations and waits that are reported
REPORT_INTERVAL_S = 10.0  # time between two progress reports during compilation
POLL_INTERVAL_S = 0.1  # time between checks for the end of a compilation or a wait

COMPILING_MESSAGE = "compiling numeric code for this machine, once: about a minute on a free core; the result is cached"
WAITING_MESSAGE = "waiting for another process to compile, or to load compiled code"


class _Compilation:
    """Listener for Numba's compile events, which are not sent when code is loaded from the cache."""

    current: _Compilation | None = None  # compilation of the outermost block of report_compilation

    def __init__(self, report: Callable[[str], object]):
        self.report, self.finished = report, threading.Event()
        self.count = self.depth = 0
        self.seconds = self.start = 0.0
        self.announced = False

    def notify(self, event: Any) -> None:
        """Handle the start or end of the compilation of a function.

        Numba calls this method while it holds its compiler lock.
        """
        if event.is_start:
            self.start = self.start if self.depth else perf_counter()
            self.depth += 1
            return
        self.depth -= 1
        self.count += 1
        if not self.depth:
            self.seconds += perf_counter() - self.start

    def compute_elapsed(self) -> float:
        """Return the compilation time so far, in seconds."""
        return self.seconds + (perf_counter() - self.start if self.depth else 0.0)

    def announce(self) -> None:
        """Report the start of the compilation, once."""
        if not self.announced:
            self.announced = True
            self.report(COMPILING_MESSAGE)

    def report_until_finished(self) -> None:
        """Report the progress until the block ends."""
        limit = REPORT_AFTER_S
        while not self.finished.wait(POLL_INTERVAL_S):
            if (elapsed := self.compute_elapsed()) < limit:
                continue
            if self.announced and elapsed >= REPORT_INTERVAL_S:
                self.report(f"compiling: {self.count} functions in {elapsed:.0f} s so far")
            self.announce()
            limit = max(REPORT_INTERVAL_S, elapsed + REPORT_INTERVAL_S)


@contextmanager
def report_compilation(report: Callable[[str], object] | None = None, full_detector: bool = False) -> Iterator[None]:
    """Report the progress if Numba compiles for more than REPORT_AFTER_S within the block.

    Args:
        report: Function that is called with each line; the default prints to standard error. Nested
            blocks use the function of the outermost block.
        full_detector: True if the block runs a complete detector. If nothing is cached yet, the
            compilation is then announced at the start of the block, before torch is loaded.
    """
    outer_compilation = _Compilation.current
    if outer_compilation is not None:
        if full_detector and not _is_cached():
            outer_compilation.announce()
        yield
        return
    from numba.core import event

    if report is None:
        from lidar_perception.runs.terminal import errors

        report = errors.print
    event.Listener.register(_Compilation)  # inheriting from Listener would load numba at import
    _Compilation.current = compilation = _Compilation(report)
    reporter = threading.Thread(target=compilation.report_until_finished, daemon=True)
    event.register("numba:compile", compilation)
    reporter.start()
    try:
        if full_detector and not _is_cached():
            compilation.announce()
        yield
    finally:
        _Compilation.current = None
        event.unregister("numba:compile", compilation)
        compilation.finished.set()
        reporter.join()
    if compilation.count and compilation.announced:
        report(f"compiled {compilation.count} functions in {compilation.seconds:.1f} s")


def _is_cached() -> bool:
    """Return True if Numba's cache is up to date, judged by a function that all detectors use."""
    from lidar_perception import geometry

    function: Any = geometry.counting_sort
    source = Path(geometry.__file__)
    if not hasattr(function, "stats"):  # true with NUMBA_DISABLE_JIT
        return True
    indices = Path(function.stats.cache_path).glob(f"{source.stem}.{function.__name__}-*.nbi")
    return any(index.stat().st_mtime >= source.stat().st_mtime for index in indices)


@contextmanager
def compile_in_background(code: str, log: Path, report: Callable[[str], object]) -> Iterator[None]:
    """Compile in a second process during the block, if nothing is compiled yet.

    The block ends after the process has ended. Errors of the process are not raised here, because
    this process later runs the same code and raises them then.

    Args:
        code: Python code that triggers the compilation, for example by opening a detector.
        log: File for the output of the process.
        report: Function that is called with a line if the block has to wait for the process.
    """
    if _is_cached():
        yield
        return
    with open(log, "w") as output:
        process = subprocess.Popen([sys.executable, "-c", code], stdout=output, stderr=output)
        try:
            yield
            if process.poll() is None:
                report(f"{COMPILING_MESSAGE}; see {log}")
            process.wait()
        finally:
            process.kill()
            process.wait()


@contextmanager
def lock_compilation(report: Callable[[str], object]) -> Iterator[None]:
    """Let only one process of this user at a time execute the block.

    The first node compiles, and the others load the cached code. If all nodes compiled the same
    functions at the same time on few cores, each would take many times longer.

    Args:
        report: Function that is called with a line if the wait is long, and again at its end.
    """
    with open(Path(tempfile.gettempdir()) / f"lidar_perception-{os.getuid()}.lock", "w") as lock:
        start, has_reported = perf_counter(), False
        while not _try_lock(lock):
            sleep(POLL_INTERVAL_S)
            if not has_reported and perf_counter() - start > REPORT_AFTER_S:
                report(WAITING_MESSAGE)
                has_reported = True
        if has_reported:
            report(f"waited {perf_counter() - start:.1f} s for another process to compile")
        yield


def _try_lock(file: Any) -> bool:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
