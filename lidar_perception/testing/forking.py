"""Nodes forked from a process with preloaded modules, because imports take most of the start-up time."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

CONTEXT = multiprocessing.get_context("forkserver")  # the server process starts with the first node
CONTEXT.set_forkserver_preload(["lidar_perception.testing.preload"])


class ForkedNode:
    """Node in a forked process, with an interface like subprocess.Popen."""

    def __init__(self, arguments: Sequence[str], environment: Mapping[str, str], log: Path):
        self.args = list(arguments)
        log.write_text("")
        self.process = CONTEXT.Process(target=_run_node, args=(self.args, dict(environment), log), daemon=True)
        self.process.start()
        self.pid = self.process.pid

    @property
    def returncode(self) -> int | None:
        return self.process.exitcode

    def poll(self) -> int | None:
        """Return the exit code, or None while the process is running."""
        return self.process.exitcode

    def wait(self, timeout: float | None = None) -> int:
        """Wait for the process to end and return its exit code.

        Raises:
            TimeoutExpired: The process is still running after `timeout` seconds.
        """
        self.process.join(timeout)
        if self.returncode is None:
            raise subprocess.TimeoutExpired(self.args, timeout or 0.0)
        return self.returncode

    def send_signal(self, number: int) -> None:
        if self.poll() is None and self.pid:
            os.kill(self.pid, number)

    def kill(self) -> None:
        self.process.kill()


def _run_node(arguments: list[str], environment: dict[str, str], log: Path) -> None:
    """Run a node in the forked process."""
    os.environ.clear()
    os.environ.update(environment)
    file = os.open(log, os.O_WRONLY | os.O_APPEND)
    os.dup2(file, 1)
    os.dup2(file, 2)
    from lidar_perception.nodes.main import run

    sys.exit(run(arguments[0], arguments))
