"""A part of the campaign in a process of its own: a case that hangs, dies or takes all memory ends
the process, and the campaign goes on with the next case in a new one."""

from __future__ import annotations

import importlib
import multiprocessing
import os
import resource
import shutil
import signal
import sys
import traceback
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection, wait
from pathlib import Path
from threading import Thread
from time import monotonic
from typing import Any

from lidar_perception.campaign.case import FAILED, Case, Outcome
from lidar_perception.runs.memory import keep_freed
from lidar_perception.types import InputError

START_SECONDS = 900.0     # for what a part makes before its first case, on a busy machine
END_SECONDS = 30.0
ADDRESS_BYTES = 16 * 2**30  # no process of the campaign gets more than this


@dataclass(frozen=True)
class Limits:
    """Of one case: seconds, and megabytes beyond what the process held before; 0 where the part
    measures its own processes."""

    seconds: float
    megabytes: float


class Worker:
    """The process of one part. A context manager that ends it, and all that it has started."""

    def __init__(self, part: str, limits: Limits, folder: Path, quiet: bool = True):
        self.part, self.limits, self.folder, self.quiet = part, limits, folder, quiet
        self.process: Any = None
        self.connection: Any = None

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *_: object) -> None:
        if self.process is not None:  # nodes that are killed leave shared memory behind
            with suppress(OSError):
                self.connection.send(("close",))
                self.process.join(END_SECONDS)
        self.stop()

    def start(self) -> None:
        """Start the process, if it is not there. InputError where the part cannot run here."""
        if self.process is not None:
            return
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(
            self.part, self.limits, self.folder, self.quiet, theirs))
        self.process.start()
        theirs.close()
        kind, *rest = self._receive(START_SECONDS)
        if kind != "ready":
            self.stop()
            raise InputError(f"the part '{self.part}' cannot start: {rest[0]}")

    def stop(self) -> None:
        """End the process and what it has started."""
        if self.process is None:
            return
        for kill in (os.killpg, os.kill):  # the group is there once the process has made it
            with suppress(ProcessLookupError):
                kill(self.process.pid, signal.SIGKILL)
        self.process.join()
        self.connection.close()
        self.process = self.connection = None

    def cases(self, seed: int, first: int, last: int, deadline: float
              ) -> Iterator[tuple[int, Outcome, Case | None]]:
        """number, outcome and, of those that failed, the case, from first to before last, until
        there are no more, or until the monotonic time `deadline`."""
        number = first
        while number < last and monotonic() < deadline:
            self.start()
            self.connection.send(("cases", seed, number, last, deadline))
            while True:
                answer = self._receive(self.limits.seconds)
                if answer[0] == "end":
                    return
                if answer[0] == "lost":  # the process has gone, and the case with it
                    self.stop()
                    yield number, Outcome(FAILED, answer[1]), self._described(seed, number)
                    number += 1
                    break
                yield answer[1:]
                number = answer[1] + 1

    def attempt(self, case: Case) -> Outcome:
        """What comes of one case."""
        self.start()
        self.connection.send(("case", case))
        answer = self._receive(self.limits.seconds)
        if answer[0] == "lost":
            self.stop()
            return Outcome(FAILED, answer[1])
        return answer[2]

    def _described(self, seed: int, number: int) -> Case | None:
        self.start()
        self.connection.send(("describe", seed, number))
        answer = self._receive(START_SECONDS)
        return answer[3] if answer[0] == "outcome" else None

    def _receive(self, seconds: float) -> Any:
        try:
            if self.connection.poll(seconds):
                return self.connection.recv()
            return "lost", f"no end within {seconds:g} s"
        except (EOFError, ConnectionError):
            self.process.join(10.0)
            code = self.process.exitcode
            name = signal.Signals(-code).name if code and code < 0 else f"exit code {code}"
            return "lost", f"the process ended with {name}"


def _serve(part: str, limits: Limits, folder: Path, quiet: bool, connection: Connection) -> None:
    os.setsid()
    Thread(target=_leave_with_parent, daemon=True).start()
    keep_freed()  # as nodes do
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_BYTES, ADDRESS_BYTES))
    if quiet:
        log = os.open(folder / f"{part}.log", os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
        for stream in (1, 2):
            os.dup2(log, stream)
    work = (folder / "work" / part).absolute()  # commands run in it
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True, exist_ok=True)
    try:
        module = importlib.import_module(f"lidar_perception.campaign.{part}")
        attempt = module.Attempt(work)
    except Exception as error:
        traceback.print_exc()
        connection.send(("failed", f"{type(error).__name__}: {error}"))
        return
    connection.send(("ready",))
    with suppress(EOFError, ConnectionError):
        while True:
            what, *order = connection.recv()
            if what == "close":
                if hasattr(attempt, "close"):
                    attempt.close()
                os._exit(0)  # without waiting for what DDS or torch still do
            if what == "describe":
                seed, number = order
                connection.send(("outcome", number, None, module.case_of(seed, number)))
            elif what == "case":
                connection.send(("outcome", 0, _measured(attempt, order[0], limits), None))
            else:
                seed, first, last, deadline = order
                for number in range(first, last):
                    case = module.case_of(seed, number)
                    if case is None or monotonic() + case.seconds >= deadline:
                        break
                    outcome = _measured(attempt, case, limits)
                    connection.send(("outcome", number, outcome,
                                     case if outcome.verdict == FAILED else None))
                connection.send(("end",))


def _leave_with_parent() -> None:
    """A campaign that is killed leaves nothing of this session behind."""
    parent = multiprocessing.parent_process()
    assert parent is not None  # this process is spawned
    wait([parent.sentinel])
    os.killpg(0, signal.SIGKILL)


def _measured(attempt: Any, case: Case, limits: Limits) -> Outcome:
    """The outcome, with its time and memory, which may make it a failure."""
    held, begin = memory_mb("VmRSS", reset=True), monotonic()
    try:
        outcome = attempt(case)
    except Exception as error:
        traceback.print_exc()
        last = traceback.extract_tb(error.__traceback__)[-1]
        outcome = Outcome(FAILED, f"{type(error).__name__}: {error} "
                          f"({Path(last.filename).name}:{last.lineno})")
    sys.stderr.flush()
    taken = max(0.0, memory_mb("VmHWM") - held)
    outcome = replace(outcome, seconds=monotonic() - begin, megabytes=taken)
    if 0 < limits.megabytes < taken and outcome.verdict != FAILED:
        return replace(outcome, verdict=FAILED, reason=f"took {taken:.0f} MB, more than "
                       f"{limits.megabytes:g}")
    return outcome


def memory_mb(name: str, reset: bool = False) -> float:
    """Of this process, as Linux calls it: VmRSS now, VmHWM at most since the last reset; 0 where
    there is no /proc."""
    try:
        if reset:
            with open("/proc/self/clear_refs", "w") as file:
                file.write("5")
        with open("/proc/self/status") as file:
            return next(int(line.split()[1]) / 1024 for line in file if line.startswith(name))
    except OSError:
        return 0.0
