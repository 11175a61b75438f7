"""Measurement of the frames of a recording, in one process, in several, or on a Dask cluster.

    for i, result in measure_frames(recording, start, jobs=4): ...
    fill(report, recording, start)          # update() with each result, skipped frames named

start(recording) is called once per process and returns measure(frame), which returns any picklable
result, or None for a frame without one. InputError from measure, or from reading the frame in it,
skips the frame. Results are in the order of the frames.
"""

from __future__ import annotations

import functools
import json
import os
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import closing
from itertools import islice
from typing import Any, Protocol
from uuid import uuid4

from threadpoolctl import threadpool_limits

from lidar_perception.data.frame import Frame, Recording
from lidar_perception.runs.journal import Journal
from lidar_perception.runs.processes import run_in_processes
from lidar_perception.runs.terminal import show_progress
from lidar_perception.types import InputError, RunError

Start = Callable[[Recording], Callable[[Frame], Any]]

CONNECT_S = 20.0  # timeout for a Dask scheduler and its first worker
TASKS_PER_THREAD = 2  # number of tasks per thread of a Dask cluster


class Report(Protocol):
    """Collection of the results of frames; skipped has one line per skipped frame."""

    skipped: list[str]

    def update(self, result: Any) -> None:
        """Add the result of one frame."""

    def compute(self) -> dict[str, Any]:
        """Return the scores as a JSON object."""


class Skipped(str):
    """Reason why a frame was not measured."""


def fill(
    report: Report,
    recording: Recording,
    start: Start,
    *,
    limit: int | None = None,
    jobs: int = 1,
    dask: str | None = None,
    title: str = "evaluating",
) -> None:
    """Update a report with the results of a recording under a progress bar.

    Skipped frames are added to report.skipped. Without a limit these include labels whose scan is
    missing.

    Args:
        limit: number of frames to measure, None for all.

    Raises:
        InputError: a process or the cluster failed.
    """
    count = min(len(recording), limit or len(recording))
    found = measure_frames(recording, start, range(count), jobs=jobs, dask=dask)
    with closing(found):
        for _, result in show_progress(found, title, count):
            if isinstance(result, Skipped):
                report.skipped.append(str(result))
            elif result is not None:
                report.update(result)
    if limit is None:
        report.skipped.extend(reason for _, reason in recording.missing_scans)


def fill_journal(
    journal: Journal,
    recording: Recording,
    start: Start,
    names: Sequence[str],
    *,
    jobs: int = 1,
    dask: str | None = None,
    title: str,
) -> None:
    """Measure frames and add each result to a journal as soon as it is complete.

    Frames that are already in the journal are not measured again. measure() returns a JSON object
    with the frame's name under "frame". A skipped frame is written as {"frame": name, "skipped":
    reason}.

    Args:
        names: names of the first frames of the recording.

    Raises:
        InputError: a process or the cluster failed.
    """
    missing = [i for i, name in enumerate(names) if name not in journal.lines]
    found = measure_frames(recording, start, missing, jobs=jobs, dask=dask)
    with closing(found):
        for i, line in show_progress(found, title, len(missing)):
            journal.add(json.dumps({"frame": names[i], "skipped": str(line)}) if isinstance(line, Skipped) else line)


def measure_frames(
    recording: Recording, start: Start, numbers: Sequence[int] | None = None, *, jobs: int = 1, dask: str | None = None
) -> Generator[tuple[int, Any]]:
    """Yield (i, result of frame i, or Skipped) in the order of the frames.

    Args:
        numbers: indices of the frames in ascending order, None for all.
        jobs: number of processes.
        dask: address of a Dask scheduler. Its workers need this package and the recording under the
            same path.

    Raises:
        InputError: a process or the cluster failed.
    """
    numbers = range(len(recording)) if numbers is None else numbers
    if dask is not None:
        return sort_results(_measure_on_dask(dask, recording, start, numbers), numbers)
    if jobs > 1 and len(numbers) > 1:
        work = functools.partial(_make_worker, _require_reopen(recording), start)
        return sort_results(run_in_processes(work, numbers, jobs, "measured frames"), numbers)
    return _measure_in_process(recording, start, numbers)


def sort_results(pairs: Iterable[tuple[int, Any]], numbers: Sequence[int]) -> Generator[tuple[int, Any]]:
    """Yield pairs (number, value) in the order of `numbers`, each as early as possible."""
    waiting: dict[int, Any] = {}
    wanted = iter(numbers)
    following = next(wanted, None)
    for number, value in pairs:
        waiting[number] = value
        while following in waiting:
            yield following, waiting.pop(following)
            following = next(wanted, None)


def _measure_in_process(recording: Recording, start: Start, numbers: Sequence[int]) -> Generator[tuple[int, Any]]:
    measure, wanted = start(recording), set(numbers)
    for i, frame in enumerate(islice(recording, max(wanted, default=-1) + 1)):
        if i in wanted:
            yield i, _measure_safely(measure, frame)


def _measure_safely(measure: Callable[[Frame], Any], frame: Frame) -> Any:
    try:
        return measure(frame)
    except RunError:
        raise
    except InputError as error:
        return Skipped(error)
    except Exception as error:
        error.add_note(f"while frame {frame.name} was measured")
        raise


def _require_reopen(recording: Recording) -> Callable[[], Recording]:
    if recording.reopen is None:
        raise InputError(f"{recording.path} cannot be opened by other processes; use one job")
    return recording.reopen


def _make_worker(reopen: Callable[[], Recording], start: Start) -> Callable[[int], tuple[int, Any]]:
    """Return a function index -> (index, result), for use in the process that calls this."""
    recording = reopen()
    measure = start(recording)
    return lambda i: (i, _measure_safely(measure, recording.frames[i]))


_get_worker = functools.lru_cache(maxsize=1)(lambda run, reopen, start: _make_worker(reopen, start))


def _measure_on_cluster(run: str, reopen: Callable[[], Recording], start: Start, i: int) -> tuple[int, Any]:
    """Measure a frame in a process that other runs may share."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # read by libraries that are loaded later
    with threadpool_limits(1):
        return _get_worker(run, reopen, start)(i)


def _measure_on_dask(
    address: str, recording: Recording, start: Start, numbers: Sequence[int]
) -> Iterator[tuple[int, Any]]:
    """Yield results in the order in which the workers of a Dask cluster finish."""
    try:
        import distributed
        from distributed.comm import CommClosedError
    except ImportError:
        raise InputError(
            "--dask needs the package distributed; run pip install 'lidar_perception[distributed]'"
        ) from None
    work = functools.partial(_measure_on_cluster, uuid4().hex, _require_reopen(recording), start)
    try:
        client = distributed.Client(address, timeout=CONNECT_S, set_as_default=False)
        client.wait_for_workers(1, timeout=CONNECT_S)
    except (OSError, ValueError) as error:
        raise InputError(
            f"cannot reach a Dask scheduler with workers at {address}: {str(error) or repr(error)}"
        ) from None
    with client:
        ahead = TASKS_PER_THREAD * sum(client.nthreads().values())
        waiting = iter(numbers)
        running = distributed.as_completed(client.map(work, [*islice(waiting, ahead)], pure=False), loop=client.loop)
        try:
            for future in running:
                yield future.result()
                for number in islice(waiting, 1):
                    running.add(client.submit(work, number, pure=False))
        except (distributed.KilledWorker, CommClosedError, CancelledError) as error:
            raise InputError(
                f"the Dask cluster at {address} failed: {error}; finished frames are kept, and the same command resumes"
            ) from None
