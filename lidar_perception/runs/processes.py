"""Work on many items in many processes that end with the one that started them: after ctrl-C, after
a kill, out of memory."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerProcess
from typing import Any, cast

from lidar_perception.types import InputError


def in_processes(start: Callable[[], Callable[[Any], Any]], items: Sequence, jobs: int,
                 what: str, *, apart: bool = False) -> Generator:
    """start()(item) of all items, in the order in which they are done.

    start is called once in each of `jobs` new processes, and can be pickled; with one job or one
    item there is no new process, unless they are to be done apart. They are forked from a process
    that has imported what start needs, and nothing else has run in. InputError, and the end of all
    processes, where one fails: its own, or, naming what it did ("wrote frames"), where a process
    ended. They end with the iterator too.
    """
    jobs = min(jobs, len(items))
    if jobs <= 1 and not apart:
        if items:
            yield from map(start(), items)
        return
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([*_modules(start)])
    running: dict[Connection, ForkServerProcess] = {}
    try:
        for j in range(jobs):
            receiver, sender = context.Pipe(duplex=False)
            process = context.Process(target=_work, daemon=True,
                                      args=(start, items[j::jobs], sender))
            with _without_interrupts():
                process.start()
            sender.close()
            running[receiver] = process
        while running:
            for receiver in cast(list[Connection], wait(list(running))):
                yield from _receive(receiver, running, what)
    finally:
        for process in running.values():
            process.terminate()
        for process in running.values():
            process.join()


def _modules(work: Any) -> set[str]:
    """Where functions and objects come from that a process is given."""
    if isinstance(work, partial):
        return set[str]().union(*map(_modules, (work.func, *work.args, *work.keywords.values())))
    return {getattr(work, "__module__", "builtins")}


def _receive(receiver: Connection, running: dict[Connection, ForkServerProcess],
             what: str) -> Iterator:
    try:
        result, error = receiver.recv()
    except EOFError:
        process = running.pop(receiver)
        process.join()
        if process.exitcode:
            raise InputError(f"a process that {what} ended with exit code {process.exitcode}"
                             + (", perhaps out of memory: try fewer --jobs"
                                if process.exitcode == -signal.SIGKILL else "")) from None
        return
    if error is not None:
        raise InputError(error)
    yield result


def _work(start: Callable, items: Sequence, sender: Connection) -> None:
    parent = multiprocessing.parent_process()
    with suppress(BrokenPipeError):  # nobody is there any more
        try:
            work = start()
            for item in items:
                if parent is not None and not parent.is_alive():
                    return
                sender.send((work(item), None))
        except InputError as error:
            sender.send((None, str(error)))


@contextmanager
def _without_interrupts() -> Iterator[None]:
    """What is started in here never sees ctrl-C: the process that started it ends it."""
    resource_tracker.ensure_running()  # or it would be started below, and lift the block
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
