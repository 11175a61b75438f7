"""Processing of the frames of a recording in one process, in several, or on a Dask cluster.

    for i, result in measure_frames(recording, start, jobs=4): ...
    fill_report(report, recording, start)   # calls update() with each result, lists skipped frames

start(recording) is called once per process and returns a function measure(frame). It returns any
picklable result, or None for a frame without a result. If it raises InputError, the frame is
skipped. Results come in the order of the frames.
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

StartMeasurement = Callable[[Recording], Callable[[Frame], Any]]

CONNECT_TIMEOUT_S = 20.0  # timeout for a Dask scheduler and its first worker
TASKS_PER_THREAD = 2  # number of tasks per thread of a Dask cluster


class Report(Protocol):
    """Collection of frame results. `skipped` has one line for each skipped frame."""

    skipped: list[str]

    def update(self, result: Any) -> None:
        """Add the result of one frame."""

    def compute(self) -> dict[str, Any]:
        """Return the scores as a JSON object."""


class SkipReason(str):
    """Reason why a frame was skipped."""


def fill_report(
    report: Report,
    recording: Recording,
    start: StartMeasurement,
    *,
    limit: int | None = None,
    jobs: int = 1,
    dask: str | None = None,
    title: str = "evaluating",
) -> None:
    """Measure a recording, add the results to a report, and show a progress bar.

    Skipped frames are added to report.skipped. Without a limit, these include labels without a scan.

    Args:
        limit: Number of frames to measure, None for all.

    Raises:
        InputError: A process or the cluster failed.
    """
    count = min(len(recording), limit or len(recording))
    results = measure_frames(recording, start, range(count), jobs=jobs, dask=dask)
    with closing(results):
        for _, result in show_progress(results, title, count):
            if isinstance(result, SkipReason):
                report.skipped.append(str(result))
            elif result is not None:
                report.update(result)
    if limit is None:
        report.skipped.extend(reason for _, reason in recording.missing_scans)


def fill_journal(
    journal: Journal,
    recording: Recording,
    start: StartMeasurement,
    names: Sequence[str],
    *,
    jobs: int = 1,
    dask: str | None = None,
    title: str,
) -> None:
    """Measure frames and add each result to a journal as soon as it is complete.

    Frames that are already in the journal are not measured again. measure() returns a JSON object
    that contains {"frame": name}. A skipped frame is written as {"frame": name, "skipped": reason}.

    Args:
        names: Names of the first frames of the recording, which are measured.

    Raises:
        InputError: A process or the cluster failed.
    """
    unfinished_numbers = [i for i, name in enumerate(names) if name not in journal.lines]
    results = measure_frames(recording, start, unfinished_numbers, jobs=jobs, dask=dask)
    with closing(results):
        for i, line in show_progress(results, title, len(unfinished_numbers)):
            journal.add(json.dumps({"frame": names[i], "skipped": str(line)}) if isinstance(line, SkipReason) else line)


def measure_frames(
    recording: Recording,
    start: StartMeasurement,
    numbers: Sequence[int] | None = None,
    *,
    jobs: int = 1,
    dask: str | None = None,
) -> Generator[tuple[int, Any]]:
    """Yield (i, result), or (i, SkipReason) for a skipped frame, in the order of the frames.

    Args:
        numbers: Indices of the frames in ascending order, None for all.
        jobs: Number of processes.
        dask: Address of a Dask scheduler. Its workers need this package and the recording under the
            same path.

    Raises:
        InputError: A process or the cluster failed.
    """
    numbers = range(len(recording)) if numbers is None else numbers
    if dask is not None:
        return sort_results(_measure_on_dask(dask, recording, start, numbers), numbers)
    if jobs > 1 and len(numbers) > 1:
        make_worker = functools.partial(_make_worker, _require_reopen(recording), start)
        return sort_results(run_in_processes(make_worker, numbers, jobs, "measured frames"), numbers)
    return _measure_in_process(recording, start, numbers)


def sort_results(pairs: Iterable[tuple[int, Any]], numbers: Sequence[int]) -> Generator[tuple[int, Any]]:
    """Yield pairs (number, value) in the order of `numbers`, each as soon as it is available."""
    finished_values: dict[int, Any] = {}
    remaining_numbers = iter(numbers)
    next_number = next(remaining_numbers, None)
    for number, value in pairs:
        finished_values[number] = value
        while next_number in finished_values:
            yield next_number, finished_values.pop(next_number)
            next_number = next(remaining_numbers, None)


def _measure_in_process(
    recording: Recording, start: StartMeasurement, numbers: Sequence[int]
) -> Generator[tuple[int, Any]]:
    measure, selected_numbers = start(recording), set(numbers)
    for i, frame in enumerate(islice(recording, max(selected_numbers, default=-1) + 1)):
        if i in selected_numbers:
            yield i, _measure_safely(measure, frame)


def _measure_safely(measure: Callable[[Frame], Any], frame: Frame) -> Any:
    try:
        return measure(frame)
    except RunError:
        raise
    except InputError as error:
        return SkipReason(error)
    except Exception as error:
        error.add_note(f"while processing frame {frame.name}")
        raise


def _require_reopen(recording: Recording) -> Callable[[], Recording]:
    if recording.reopen is None:
        raise InputError(f"{recording.path} cannot be opened by other processes; use --jobs 1")
    return recording.reopen


def _make_worker(reopen: Callable[[], Recording], start: StartMeasurement) -> Callable[[int], tuple[int, Any]]:
    """Open the recording in this process and return a function index -> (index, result)."""
    recording = reopen()
    measure = start(recording)
    return lambda i: (i, _measure_safely(measure, recording.frames[i]))


_get_worker = functools.lru_cache(maxsize=1)(lambda run, reopen, start: _make_worker(reopen, start))


def _measure_on_cluster(run: str, reopen: Callable[[], Recording], start: StartMeasurement, i: int) -> tuple[int, Any]:
    """Measure a frame in a worker process that may also be used by other runs."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # read by libraries that are loaded later
    with threadpool_limits(1):
        return _get_worker(run, reopen, start)(i)


def _measure_on_dask(
    address: str, recording: Recording, start: StartMeasurement, numbers: Sequence[int]
) -> Iterator[tuple[int, Any]]:
    """Yield results in the order in which the workers of a Dask cluster finish them."""
    try:
        import distributed
        from distributed.comm import CommClosedError
    except ImportError:
        raise InputError(
            "--dask requires the package distributed; run pip install 'lidar_perception[distributed]'"
        ) from None
    measure_on_worker = functools.partial(_measure_on_cluster, uuid4().hex, _require_reopen(recording), start)
    try:
        client = distributed.Client(address, timeout=CONNECT_TIMEOUT_S, set_as_default=False)
        client.wait_for_workers(1, timeout=CONNECT_TIMEOUT_S)
    except (OSError, ValueError) as error:
        raise InputError(
            f"cannot reach a Dask scheduler with workers at {address}: {str(error) or repr(error)}"
        ) from None
    with client:
        max_submitted = TASKS_PER_THREAD * sum(client.nthreads().values())
        waiting_numbers = iter(numbers)
        futures = distributed.as_completed(
            client.map(measure_on_worker, [*islice(waiting_numbers, max_submitted)], pure=False), loop=client.loop
        )
        try:
            for future in futures:
                yield future.result()
                for number in islice(waiting_numbers, 1):
                    futures.add(client.submit(measure_on_worker, number, pure=False))
        except (distributed.KilledWorker, CommClosedError, CancelledError) as error:
            raise InputError(
                f"the Dask cluster at {address} failed: {error}; finished frames are kept, run the "
                "same command again to resume"
            ) from None
