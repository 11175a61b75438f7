"""The command line as a user starts it, in a process that is forked from one with all its imports:
thousands of commands need not import NumPy and torch thousands of times."""

from __future__ import annotations

import importlib
import os
import pkgutil
import resource
import runpy
import signal
import sys
import traceback
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from time import monotonic, sleep

from lidar_perception.campaign.case import FAILED, REFUSED, SURVIVED, Outcome
from lidar_perception.candidates.warm_up import warm_up
from lidar_perception.wire.codec import bag_message

MODULE = "lidar_perception.cli.main"
ROOMS = ("data", "scoring", "detectors", "simulation")
MAX_TEXT = 2**20  # bytes of what a command says


@dataclass(frozen=True)
class Said:
    """What a command has left: its exit code (negative: the signal that ended it; None: it had to
    be ended), what it said, and megabytes at most."""

    code: int | None
    out: str
    errors: str
    megabytes: float

    def outcome(self, most_megabytes: float) -> Outcome:
        """The law for every command: a result, or one line that says why not."""
        lines = [line for line in self.errors.splitlines() if line.strip()]
        last = lines[-1] if lines else ""
        if self.code is None:
            return Outcome(FAILED, "the command did not end in time")
        if self.code < 0:
            return Outcome(FAILED, f"the command ended with {signal.Signals(-self.code).name}")
        if self.megabytes > most_megabytes:
            return Outcome(FAILED, f"the command took {self.megabytes:.0f} MB, more than "
                           f"{most_megabytes:g}")
        if "Traceback (most recent call last)" in self.errors:
            return Outcome(FAILED, f"traceback: {last}")
        if self.code == 0:
            return Outcome(SURVIVED)
        said = [line for line in self.out.splitlines() if line.strip()] or lines
        if self.code == 1 and said:
            return Outcome(REFUSED, f"exit code 1: {said[-1]}")
        if self.code == 2 and last.startswith("Error: "):
            return Outcome(REFUSED, last.removeprefix("Error: "))
        return Outcome(FAILED, f"exit code {self.code} without one line that says why: {last}")


def load_all() -> None:
    """Import what commands import, and compile; no thread is started."""
    for room in ROOMS:
        package = importlib.import_module(f"lidar_perception.{room}")
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            with suppress(ImportError):  # of an extra
                importlib.import_module(module.name)
    bag_message("sensor_msgs/msg/PointCloud2")
    warm_up()


def run_command(arguments: Sequence[str | Path], folder: Path, seconds: float,
                file_bytes: int | None = None) -> Said:
    """Run `lidar-perception ARGUMENTS` in a folder, for so many seconds at most; file_bytes: how
    large a file it may write, as on a disk that is nearly full."""
    texts = [folder / f".said.{name}" for name in ("out", "errors")]
    child = os.fork()
    if child == 0:
        _become(list(map(str, arguments)), folder, texts, file_bytes)
    end, pause = monotonic() + seconds, 0.002
    while True:
        pid, status, usage = os.wait4(child, os.WNOHANG)
        if pid:
            code: int | None = os.waitstatus_to_exitcode(status)
            break
        if monotonic() > end:
            os.kill(child, signal.SIGKILL)
            _, _, usage = os.wait4(child, 0)
            code = None
            break
        sleep(pause)
        pause = min(0.05, 1.2 * pause)
    out, errors = (text.read_bytes()[:MAX_TEXT].decode(errors="replace") for text in texts)
    return Said(code, out, errors, usage.ru_maxrss / 1024)


def _become(arguments: list[str], folder: Path, texts: list[Path],
            file_bytes: int | None) -> None:
    code = 70
    try:
        for number, text in enumerate(texts, 1):
            stream = os.open(text, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
            os.dup2(stream, number)
        if file_bytes is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (file_bytes, file_bytes))
        os.chdir(folder)
        sys.argv = ["lidar-perception", *arguments]
        sys.modules.pop(MODULE, None)
        runpy.run_module(MODULE, run_name="__main__", alter_sys=True)
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 0 if end.code is None else 1
    except BaseException:
        traceback.print_exc()
        code = 1
    finally:
        try:
            sys.stdout.flush()
            sys.stderr.flush()
        finally:
            os._exit(code)
