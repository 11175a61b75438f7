"""Work on many items in many processes that end with the one that started them: after ctrl-C, after
a kill, out of memory."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from itertools import islice
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerContext, ForkServerProcess
from multiprocessing.reduction import ForkingPickler
from queue import SimpleQueue
from threading import Thread
from time import monotonic
from typing import Any, cast

from lidar_perception.runs.threads import one_thread_here
from lidar_perception.types import InputError

PATIENCE = 30.0  # seconds, with processes that have been asked to end


def in_processes(start: Callable[[], Callable[[Any], Any]], items: Sequence, jobs: int,
                 what: str, *, apart: bool = False) -> Generator:
    """start()(item) of all items, in the order in which they are done.

    start is called once in each of `jobs` new processes, and can be pickled; with one job or one
    item there is no new process, unless they are to be done apart. Several processes share the
    cores, so each computes with one thread. They are forked from a process that has imported what
    start needs, and nothing else has run in. InputError, and the end of all processes, where one
    fails: its own, or, naming what it did ("wrote frames"), where a process
    ended. They end with the iterator too.
    """
    jobs = min(jobs, len(items))
    if jobs <= 1 and not apart:
        if items:
            yield from map(start(), items)
        return
    context = _context(start)
    running: dict[Connection, ForkServerProcess] = {}
    try:
        for j in range(jobs):
            receiver, sender = context.Pipe(duplex=False)
            running[receiver] = _begun(context, _work, start, items[j::jobs], jobs > 1, sender)
        while running:
            for receiver in cast(list[Connection], wait(list(running))):
                yield from _receive(receiver, running, what)
    finally:
        _end(running)


def in_order(start: Callable[[], Callable[[Any], Any]], items: Iterable, jobs: int, ahead: int,
             what: str) -> Generator:
    """start()(item) of all items, of which there may be no end, in their order. As in_processes,
    with a new process, of one thread, for a single job too; each makes up to `ahead` items that
    nobody has asked for yet."""
    waiting = iter(items)
    first = list(islice(waiting, jobs * ahead))
    context = _context(start)
    crew: dict[Connection, ForkServerProcess] = {}
    try:
        for _ in first[:jobs]:
            here, there = context.Pipe()
            crew[here] = _begun(context, _serve, start, there)
        pipes = list(crew)
        asked = deque(_asked(pipes[k % len(pipes)], item) for k, item in enumerate(first))
        while asked:
            pipe = asked.popleft()
            for result in _receive(pipe, crew, what):
                asked += [_asked(pipe, item) for item in islice(waiting, 1)]
                yield result
    finally:
        _end(crew)


def _context(start: Callable) -> ForkServerContext:
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([*_modules(start)])
    return context


def _begun(context: ForkServerContext, work: Callable, *args: Any) -> ForkServerProcess:
    """A process that does work(*args). The last argument is its end of a pipe, which nobody else
    keeps: so the pipe ends with the process, even one that is killed in the middle of a result."""
    process = context.Process(target=work, args=args, daemon=True)
    with _without_interrupts():
        process.start()
    args[-1].close()
    return process


def _end(running: dict[Connection, ForkServerProcess]) -> None:
    for process in running.values():
        process.terminate()
    for pipe in running:
        pipe.close()
    end = monotonic() + PATIENCE
    for process in running.values():
        process.join(max(0.0, end - monotonic()))
        process.kill()  # one that has not ended, such as one that was interrupted with a lock held
        process.join()


def _modules(work: Any) -> set[str]:
    """Where functions and objects come from that a process is given."""
    if isinstance(work, partial):
        return set[str]().union(*map(_modules, (work.func, *work.args, *work.keywords.values())))
    return {getattr(work, "__module__", "builtins")}


def _receive(receiver: Connection, running: dict[Connection, ForkServerProcess],
             what: str) -> Iterator:
    """The next result. None where a process has ended as it should; InputError where it did not."""
    try:
        result, error = receiver.recv()
    except (EOFError, OSError):  # the latter in the middle of a result
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


def _work(start: Callable, items: Sequence, shared: bool, sender: Connection) -> None:
    if shared:
        one_thread_here()
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


def _asked(pipe: Connection, item: Any) -> Connection:
    """The pipe, through which the item was sent."""
    with suppress(OSError):  # of a process that has ended, which is said when it is heard
        pipe.send(item)
    return pipe


def _serve(start: Callable, pipe: Connection) -> None:
    one_thread_here()
    signal.signal(signal.SIGTERM, _leave)
    results: SimpleQueue[Any] = SimpleQueue()
    Thread(target=_send, args=(results, pipe), daemon=True).start()
    work = start()
    while True:
        try:
            item = pipe.recv()
        except (EOFError, OSError):
            return  # nobody is there any more
        try:
            results.put(ForkingPickler.dumps((work(item), None)))
        except InputError as error:
            results.put(ForkingPickler.dumps((None, str(error))))


def _leave(*_: Any) -> None:
    """The end of a process is asked for, perhaps twice: it gives back what it holds of the
    system."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    sys.exit()


def _send(results: SimpleQueue[Any], pipe: Connection) -> None:
    """Beside the work: the reader may be at something else for long."""
    while True:
        try:
            pipe.send_bytes(results.get())
        except OSError:
            os.kill(os.getpid(), signal.SIGTERM)  # nobody is there any more
            return


@contextmanager
def _without_interrupts() -> Iterator[None]:
    """What is started in here never sees ctrl-C: the process that started it ends it."""
    resource_tracker.ensure_running()  # or it would be started below, and lift the block
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
