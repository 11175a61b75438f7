"""Run commands like a user, each in a fork of a process that has already imported everything."""

from __future__ import annotations

import importlib
import os
import pkgutil
import resource
import runpy
import signal
import sys
import traceback
from contextlib import suppress
from pathlib import Path
from time import monotonic, sleep

from fuzz.case import FAILED, REFUSED, SURVIVED, Outcome
from lidar_perception.candidates.warm_up import warm_up
from lidar_perception.wire.codec import make_bag_message


def judge_command(code: int | None, out: str, errors: str) -> Outcome:
    """Check that a command gave a result, or one line with the reason. code: exit code, the negative signal that
    ended it, or None if it took too long."""
    lines = [line for line in errors.splitlines() if line.strip()]
    last = lines[-1] if lines else ""
    if code is None:
        return Outcome(FAILED, "the command did not end in time")
    if code < 0:
        return Outcome(FAILED, f"the command ended with {signal.Signals(-code).name}")
    if "Traceback (most recent call last)" in errors:
        return Outcome(FAILED, f"traceback: {last}")
    if code == 0:
        return Outcome(SURVIVED)
    output_lines = [line for line in out.splitlines() if line.strip()] or lines
    if code == 1 and output_lines:
        return Outcome(REFUSED, f"exit code 1: {output_lines[-1]}")
    if code == 2 and last.startswith("Error: "):
        return Outcome(REFUSED, last.removeprefix("Error: "))
    return Outcome(FAILED, f"exit code {code} without one line that says why: {last}")


def load_all() -> None:
    """Import and compile everything that commands use, without starting threads."""
    for room in ("data", "scoring", "detectors", "simulation"):
        package = importlib.import_module(f"lidar_perception.{room}")
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            with suppress(ImportError):  # belongs to an optional extra
                importlib.import_module(module.name)
    make_bag_message("sensor_msgs/msg/PointCloud2")
    warm_up()


def run_command(arguments: list[str], folder: Path, seconds: float, max_mb: float) -> Outcome:
    """Run `lidar-perception ARGUMENTS` in a folder, and end it after `seconds`."""
    texts = [folder / f".output.{name}" for name in ("out", "errors")]
    child = os.fork()
    if child == 0:
        _exec_command(arguments, folder, texts)
    end, pid = monotonic() + seconds, 0
    while not pid:
        pid, status, usage = os.wait4(child, os.WNOHANG)
        if not pid and monotonic() > end:
            os.kill(child, signal.SIGKILL)
            os.wait4(child, 0)
            return judge_command(None, "", "")
        sleep(0 if pid else 0.01)
    outcome = judge_command(os.waitstatus_to_exitcode(status), *(text.read_text(errors="replace") for text in texts))
    if (used_mb := usage.ru_maxrss / 1024) > max_mb:
        return Outcome(FAILED, f"the command took {used_mb:.0f} MB, more than {max_mb:g}")
    return outcome


def _exec_command(arguments: list[str], folder: Path, texts: list[Path]) -> None:
    code = 70
    try:
        for number, text in enumerate(texts, 1):
            os.dup2(os.open(text, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644), number)
        resource.setrlimit(resource.RLIMIT_AS, (2**34, 2**34))
        os.chdir(folder)
        sys.argv = ["lidar-perception", *arguments]
        sys.modules.pop("lidar_perception.cli.main", None)
        runpy.run_module("lidar_perception.cli.main", run_name="__main__", alter_sys=True)
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 0 if end.code is None else 1
    except BaseException:
        traceback.print_exc()
        code = 1
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
