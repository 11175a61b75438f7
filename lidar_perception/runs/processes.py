"""Processing of many items in several processes, which end with their parent process.

They also end after ctrl-C, if the parent is killed, or if memory runs out.
"""

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

from lidar_perception.runs.threads import limit_to_one_thread
from lidar_perception.types import InputError

EXIT_TIMEOUT_S = 30.0  # time for processes to end after they were told to terminate
# Number of runs of consecutive items per process. Such items often share work, like scans of one street.
RUNS_PER_PROCESS = 16


def run_in_processes(
    start: Callable[[], Callable[[Any], Any]], items: Sequence, jobs: int, work_done: str, *, separate: bool = False
) -> Generator:
    """Yield start()(item) for all items, in the order in which they are finished.

    Processes are forked from a process that has only imported the modules of `start`. Several
    processes use one thread each. All processes end with the iterator.

    Args:
        start: Picklable function that is called once in each new process and returns the function
            for the items.
        items: Items to process.
        jobs: Number of processes. With one job or one item no new process is started, unless
            `separate` is True.
        work_done: What the processes did, for error messages, such as "wrote frames".
        separate: Always start new processes.

    Raises:
        InputError: A worker raised InputError, or died. All processes are ended.
    """
    jobs = min(jobs, len(items))
    if jobs <= 1 and not separate:
        if items:
            yield from map(start(), items)
        return
    context = _make_context(start)
    process_by_pipe: dict[Connection, ForkServerProcess] = {}
    try:
        for j in range(jobs):
            receiver, sender = context.Pipe(duplex=False)
            process_by_pipe[receiver] = _start_process(
                context, _run_items, start, deal_items(items, jobs, j), jobs > 1, sender
            )
        while process_by_pipe:
            for receiver in cast(list[Connection], wait(list(process_by_pipe))):
                yield from _receive_result(receiver, process_by_pipe, work_done)
    finally:
        _end_processes(process_by_pipe)


def deal_items(items: Sequence, jobs: int, job: int) -> list:
    """Return the items of one job: runs of consecutive items, which are dealt to the jobs in turn.

    The jobs differ by at most one run, at most 1 / RUNS_PER_PROCESS of the items of a job.
    """
    run_length = max(1, len(items) // (jobs * RUNS_PER_PROCESS))
    return [
        item
        for start in range(job * run_length, len(items), jobs * run_length)
        for item in items[start : start + run_length]
    ]


def run_in_order(
    start: Callable[[], Callable[[Any], Any]], items: Iterable, jobs: int, max_ahead: int, work_done: str
) -> Generator:
    """Yield start()(item) for all items in their order; the items may be endless.

    Other arguments are as in run_in_processes, but even a single job runs in a new process, with
    one thread.

    Args:
        max_ahead: Maximum number of items that each process works ahead of the caller.
    """
    remaining_items = iter(items)
    first_items = list(islice(remaining_items, jobs * max_ahead))
    context = _make_context(start)
    process_by_pipe: dict[Connection, ForkServerProcess] = {}
    try:
        for _ in first_items[:jobs]:
            parent_end, worker_end = context.Pipe()
            process_by_pipe[parent_end] = _start_process(context, _serve_items, start, worker_end)
        pipes = list(process_by_pipe)
        pending = deque(_send_item(pipes[k % len(pipes)], item) for k, item in enumerate(first_items))
        while pending:
            pipe = pending.popleft()
            for result in _receive_result(pipe, process_by_pipe, work_done):
                pending += [_send_item(pipe, item) for item in islice(remaining_items, 1)]
                yield result
    finally:
        _end_processes(process_by_pipe)


def _make_context(start: Callable) -> ForkServerContext:
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([*_find_modules(start)])
    return context


def _start_process(context: ForkServerContext, target: Callable, *args: Any) -> ForkServerProcess:
    """Start a process that runs target(*args); the last argument is its end of a pipe.

    No other process keeps this end open, so the pipe closes when the process ends, even if it is
    killed while it sends a result.
    """
    process = context.Process(target=target, args=args, daemon=True)
    with _block_interrupts():
        process.start()
    args[-1].close()
    return process


def _end_processes(process_by_pipe: dict[Connection, ForkServerProcess]) -> None:
    for process in process_by_pipe.values():
        process.terminate()
    for pipe in process_by_pipe:
        pipe.close()
    deadline = monotonic() + EXIT_TIMEOUT_S
    for process in process_by_pipe.values():
        process.join(max(0.0, deadline - monotonic()))
        process.kill()  # in case the process has not ended, for example because it holds a lock
        process.join()


def _find_modules(work: Any) -> set[str]:
    """Return the modules of the functions and objects that are passed to a process.

    The attribute `later_imports` of an object can name modules that its methods will import.
    """
    if isinstance(work, partial):
        return set[str]().union(*map(_find_modules, (work.func, *work.args, *work.keywords.values())))
    later_imports = getattr(getattr(work, "__self__", work), "later_imports", ())
    return {getattr(work, "__module__", "builtins"), *later_imports}


def _receive_result(
    receiver: Connection, process_by_pipe: dict[Connection, ForkServerProcess], work_done: str
) -> Iterator:
    """Yield a result, or nothing if the process has ended normally. Raise InputError if it failed or died."""
    try:
        result, error = receiver.recv()
    except (EOFError, OSError):  # OSError if the result is cut off
        process = process_by_pipe.pop(receiver)
        process.join()
        if process.exitcode:
            raise InputError(
                f"a process that {work_done} ended with exit code {process.exitcode}"
                + (", perhaps out of memory: try fewer --jobs" if process.exitcode == -signal.SIGKILL else "")
            ) from None
        return
    if error is not None:
        raise InputError(error)
    yield result


def _run_items(start: Callable, items: Sequence, one_thread: bool, sender: Connection) -> None:
    if one_thread:
        limit_to_one_thread()
    parent = multiprocessing.parent_process()
    with suppress(BrokenPipeError):  # the reader has ended
        try:
            process_item = start()
            for item in items:
                if parent is not None and not parent.is_alive():
                    return
                sender.send((process_item(item), None))
        except InputError as error:
            sender.send((None, str(error)))


def _send_item(pipe: Connection, item: Any) -> Connection:
    """Send an item through a pipe and return the pipe."""
    with suppress(OSError):  # _receive_result reports that the process has ended
        pipe.send(item)
    return pipe


def _serve_items(start: Callable, pipe: Connection) -> None:
    limit_to_one_thread()
    signal.signal(signal.SIGTERM, _exit_once)
    results: SimpleQueue[Any] = SimpleQueue()
    Thread(target=_send_results, args=(results, pipe), daemon=True).start()
    process_item = start()
    while True:
        try:
            item = pipe.recv()
        except (EOFError, OSError):
            return  # the parent has ended
        try:
            results.put(ForkingPickler.dumps((process_item(item), None)))
        except InputError as error:
            results.put(ForkingPickler.dumps((None, str(error))))


def _exit_once(*_: Any) -> None:
    """Exit on the first SIGTERM and ignore later ones, so that system resources are released."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    sys.exit()


def _send_results(results: SimpleQueue[Any], pipe: Connection) -> None:
    """Send results to the parent; this runs in a thread because the parent may be busy for a long time."""
    while True:
        try:
            pipe.send_bytes(results.get())
        except OSError:
            os.kill(os.getpid(), signal.SIGTERM)  # the parent has ended
            return


@contextmanager
def _block_interrupts() -> Iterator[None]:
    """Block SIGINT, so that processes started in the block ignore ctrl-C and are ended by their parent."""
    resource_tracker.ensure_running()  # if it started inside the block, it would unblock the signals
    previous_mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, previous_mask)
