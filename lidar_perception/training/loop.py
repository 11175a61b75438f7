"""The training loop of every network of the package.

A network provides a Task. The loop provides one-cycle AdamW, mixed precision, gradient clipping,
averaged weights, validation, logs, and a state on disk from which a killed run resumes.
"""

from __future__ import annotations

import io
import math
import pickle
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lidar_perception.runs.files import make_folder, write_bytes
from lidar_perception.runs.resuming import find_differences
from lidar_perception.runs.terminal import errors, make_progress, pause_progress
from lidar_perception.training.distributed import find_minimum, get_rank, is_true_anywhere, wait_for_all
from lidar_perception.training.log import Log
from lidar_perception.training.params import LoopParams
from lidar_perception.training.run import Progress, Run, Task
from lidar_perception.training.run_directory import RunDirectory
from lidar_perception.types import InputError

WARM_UP_S = 60.0  # time until the duration of a step is known
MEMORY_S = 600.0  # time constant of the weights in the mean step duration
SPARE_STEPS = 2  # safety margin of the time budget, in steps


def train(
    task: Task,
    params: LoopParams,
    out: Path,
    device: torch.device = torch.device("cpu"),
    resume: bool = False,
    until: float = math.inf,
    validation: float = 0.0,
) -> Progress:
    """Train until the steps are done, the time is over, or SIGINT or SIGTERM arrives.

    The state is saved at the end. If fewer steps fit into the time, the learning rate falls
    faster, so that it ends as low as planned. The same task and seed give the same weights on the
    CPU, whether the run was interrupted or not.

    Args:
        out: Folder of the run. Gets the state for resuming, log.csv, validation.csv, and what
            task.save writes.
        resume: Continue the run in out; without one there, begin one.
        until: time.monotonic() at which to stop, the last validation included.
        validation: Expected duration of the first validation, in seconds.

    Raises:
        InputError: out holds a run and resume is False, or a run with other settings; nothing
            can be written; or the loss is not finite for too many steps.
    """
    directory = RunDirectory(out)
    directory.require_no_state(resume)
    path = directory.state_file
    make_folder(out)
    torch.manual_seed(params.seed + get_rank())
    run = Run(task, params, device)
    if path.exists():
        run.load(_read_state(path, run.settings()))
    wait_for_all()  # wait until every process has read the file that rank 0 replaces
    log = Log(out, run.progress.step) if get_rank() == 0 else None
    begun = time.monotonic() - run.progress.seconds
    pace, warned = Pace(until, run.validate_steps, validation), False
    try:
        with _catch_signals() as stop, make_progress() as bar:
            line = bar.add_task("training", total=run.steps, completed=int(run.position), visible=get_rank() == 0)
            batches = iter(task.batches(run.progress.step))
            while True:
                if is_true_anywhere(stop.is_set(), device):
                    run.progress.stopped = True
                    _save_state(path, run)
                    break
                run.progress.late = is_true_anywhere(pace.is_over(), device) and not run.done
                due = run.is_validation_due() and (run.done or not is_true_anywhere(pace.is_over(2), device))
                if due or (run.progress.late and run.progress.step > run.progress.validated):
                    _save_state(path, run)  # saved first, because validation takes a while
                    with pace.time_validation(), pause_progress(bar):
                        _validate(run, log)
                    _save_state(path, run)
                if run.done or run.progress.late:
                    break
                row = run.step(_next_batch(batches, path, run))
                step = run.progress.step
                pace.count_step()
                if until < math.inf:
                    fit = step + max(0.0, find_minimum(pace.steps_left(step), device))
                    run.shorten_schedule(fit - step)
                    if fit < 0.9 * run.steps and not warned and get_rank() == 0:
                        warned = True
                        errors.print(
                            f"slower than planned, {pace.step_duration:.2g} s a step: "
                            f"about {fit:.0f} of {run.steps} steps fit into the budget, "
                            "so the learning rate falls faster"
                        )
                run.progress.seconds = time.monotonic() - begun
                bar.update(line, completed=run.position)
                if row is not None:
                    bar.update(line, description=f"loss {row['loss']:.3f} lr {row['lr']:.1e}")
                    if log is not None and step % params.log_steps == 0:
                        log.add("loss", step, {**row, "skipped": run.progress.skipped, "seconds": run.progress.seconds})
                if step % params.save_steps == 0 and not run.is_validation_due():
                    _save_state(path, run)
    finally:
        if log is not None:
            log.close()
    return run.progress


class Pace:
    """Estimates how many steps fit into the remaining time.

    There is one validation after every validate_steps steps, and one at the end.
    """

    def __init__(self, until: float, validate_steps: int, validation: float = 0.0):
        self.until, self.validate_steps, self.validation = until, validate_steps, validation
        self.begun = self.last_step = time.monotonic()
        self.steps = self.seconds = 0.0  # weighted sums in which earlier steps have less weight

    @property
    def step_duration(self) -> float:
        """Recent mean duration of a step, in seconds."""
        return self.seconds / self.steps

    def is_over(self, validations: int = 1) -> bool:
        """Return True if only the time of this many validations is left."""
        return time.monotonic() + validations * self.validation >= self.until

    def count_step(self) -> None:
        """Record the end of a step."""
        now = time.monotonic()
        passed, self.last_step = now - self.last_step, now
        weight = math.exp(-passed / MEMORY_S)
        self.steps, self.seconds = weight * self.steps + 1, weight * self.seconds + passed

    def steps_left(self, step: int) -> float:
        """Return how many steps fit after this one: below 1 if none, inf while unknown."""
        now = time.monotonic()
        if now - self.begun < WARM_UP_S or self.until == math.inf:
            return math.inf
        since = step % self.validate_steps
        left = self.until - now - self.validation + since * self.step_duration
        whole, rest = divmod(left, self.validate_steps * self.step_duration + self.validation)
        return whole * self.validate_steps + min(rest / self.step_duration, self.validate_steps) - since - SPARE_STEPS

    @contextmanager
    def time_validation(self) -> Iterator[None]:
        """Measure the validation inside; its duration does not count as part of a step."""
        begun = time.monotonic()
        yield
        self.validation = time.monotonic() - begun
        self.last_step += self.validation


def _validate(run: Run, log: Log | None) -> None:
    """Validate the averaged weights in rank 0, which has the log, and save the best and last."""
    progress = run.progress
    progress.validated = progress.step
    if log is not None:
        metrics, calibration = run.task.validate(run.average.module)
        log.add("validation", progress.step, metrics)
        shown = ", ".join(f"{name} {value:.4g}" for name, value in metrics.items())
        errors.print(f"step {progress.step}: {shown}")
        if np.isnan(metrics["score"]):
            errors.print("the validation frames contain no object, so the latest weights count as the best")
        better = progress.best is None or not metrics["score"] <= progress.best
        if better:
            progress.best, progress.best_step = metrics["score"], progress.step
        record = {**vars(progress), "metrics": metrics, "calibration": calibration}
        if better:
            run.task.save("best", run.average.module, record)
        if run.done or progress.late:
            run.task.save("last", run.average.module, record)
    wait_for_all()


def _save_state(path: Path, run: Run) -> None:
    if get_rank() == 0:
        _write_state(path, run)
    wait_for_all()


def _write_state(path: Path, run: Run) -> None:
    content = io.BytesIO()
    torch.save(run.state(), content)
    write_bytes(path, content.getbuffer())


def _next_batch(batches: Iterator[Any], path: Path, run: Run) -> Any:
    """Return the next batch. If a process that prepares them was killed, save the state first.

    Only rank 0 saves, without waiting: the other processes may be at an earlier step.
    """
    try:
        return next(batches)
    except InputError:
        if get_rank() == 0 and run.progress.step:
            _write_state(path, run)
        raise


def _read_state(path: Path, settings: dict[str, Any]) -> dict[str, Any]:
    """Read a state. Raise InputError if it is damaged or of a run with other settings."""
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        before = state["asked"]
    except (OSError, RuntimeError, KeyError, TypeError, EOFError, pickle.UnpicklingError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"cannot read {path}: {reason}; remove it to start again") from None
    if different := find_differences(before, settings):
        raise InputError(
            f"{path} is of a run with {'; '.join(different[:3])}; resume it with the "
            "same settings, or give another --out"
        )
    return state


@contextmanager
def _catch_signals() -> Iterator[threading.Event]:
    """Yield an event that the first SIGINT or SIGTERM sets; a second one ends the process."""
    event = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield event
        return
    numbers: tuple[int, ...] = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.getsignal(number) for number in numbers}

    def set_event(number: int, _: Any) -> None:
        event.set()
        signal.signal(number, before[number])
        errors.print("stopping after this step; press Ctrl-C again to stop at once")

    for number in numbers:
        signal.signal(number, set_event)
    try:
        yield event
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
