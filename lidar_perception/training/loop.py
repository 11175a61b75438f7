"""Training loop that all networks share.

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
DECAY_S = 600.0  # time constant of the weights in the mean step duration
SPARE_STEPS = 2  # safety margin of the time budget, in steps


def train(
    task: Task,
    params: LoopParams,
    out: Path,
    device: torch.device = torch.device("cpu"),
    resume: bool = False,
    deadline: float = math.inf,
    validation_s: float = 0.0,
) -> Progress:
    """Train until all steps are done, the deadline is near, or SIGINT or SIGTERM arrives, and save the state.

    If fewer steps than planned fit into the time, the learning rate falls faster, to the same final
    value. On the CPU, the same task and seed give the same weights, even after an interruption.

    Args:
        task: Network, loss, data and validation.
        params: Length of the training and optimizer.
        out: Folder of the run, for its state, log.csv, validation.csv, and the files of task.save.
        device: Device of the network.
        resume: Continue the run in out, if there is one.
        deadline: Value of time.monotonic() by which the last validation must end.
        validation_s: Expected duration of the first validation.

    Returns:
        Progress at the end.

    Raises:
        InputError: `out` contains a run and resume is False, or a run with other settings; `out` is
            not writable; or the loss is not finite for too many steps.
    """
    directory = RunDirectory(out)
    path = directory.state_file
    directory.require_absent(path, resume)
    make_folder(out)
    torch.manual_seed(params.seed + get_rank())
    run = Run(task, params, device)
    if path.exists():
        run.load(_read_state(path, run.collect_settings()))
    wait_for_all()  # rank 0 replaces the file that the others have read above
    log = Log(out, run.progress.step) if get_rank() == 0 else None
    start = time.monotonic() - run.progress.seconds
    budget, has_warned = TimeBudget(deadline, run.validate_steps, validation_s), False
    try:
        with _catch_signals() as stop, make_progress() as bar:
            bar_task = bar.add_task("training", total=run.steps, completed=int(run.position), visible=get_rank() == 0)
            batches = iter(task.batches(run.progress.step))
            while True:
                if is_true_anywhere(stop.is_set(), device):
                    run.progress.stopped = True
                    _save_state(path, run)
                    break
                run.progress.late = is_true_anywhere(budget.is_over(), device) and not run.is_done
                is_due = run.is_validation_due() and (run.is_done or not is_true_anywhere(budget.is_over(2), device))
                if is_due or (run.progress.late and run.progress.step > run.progress.validated):
                    _save_state(path, run)  # the run may be killed during the validation
                    with budget.time_validation(), pause_progress(bar):
                        _validate(run, log)
                    _save_state(path, run)
                if run.is_done or run.progress.late:
                    break
                row = run.step(_next_batch(batches, path, run))
                step = run.progress.step
                budget.count_step()
                if deadline < math.inf:
                    remaining_steps = max(0.0, find_minimum(budget.estimate_remaining_steps(step), device))
                    run.shorten_schedule(remaining_steps)
                    if step + remaining_steps < 0.9 * run.steps and not has_warned and get_rank() == 0:
                        has_warned = True
                        errors.print(
                            f"slower than planned, {budget.step_duration:.2g} s per step: about "
                            f"{step + remaining_steps:.0f} of {run.steps} steps fit into the budget, so the learning "
                            "rate falls faster"
                        )
                run.progress.seconds = time.monotonic() - start
                bar.update(bar_task, completed=run.position)
                if row is not None:
                    bar.update(bar_task, description=f"loss {row['loss']:.3f} lr {row['lr']:.1e}")
                    if log is not None and step % params.log_steps == 0:
                        log.add("loss", step, {**row, "skipped": run.progress.skipped, "seconds": run.progress.seconds})
                if step % params.save_steps == 0 and not run.is_validation_due():
                    _save_state(path, run)
    finally:
        if log is not None:
            log.close()
    return run.progress


class TimeBudget:
    """Time budget of a run. Estimates how many steps fit into the remaining time.

    Args:
        deadline: Value of time.monotonic() at the end of the budget.
        validate_steps: Steps between validations; there is one more at the end.
        validation_s: Expected duration of a validation.
    """

    def __init__(self, deadline: float, validate_steps: int, validation_s: float = 0.0):
        self.deadline, self.validate_steps, self.validation_s = deadline, validate_steps, validation_s
        self.start = self.last_step = time.monotonic()
        self.steps = self.seconds = 0.0  # exponentially weighted sums

    @property
    def step_duration(self) -> float:
        """Recent mean duration of a step, in seconds."""
        return self.seconds / self.steps

    def is_over(self, validations: int = 1) -> bool:
        """Return True if the remaining time is only enough for this many validations."""
        return time.monotonic() + validations * self.validation_s >= self.deadline

    def count_step(self) -> None:
        """Record the end of a step."""
        now = time.monotonic()
        duration, self.last_step = now - self.last_step, now
        weight = math.exp(-duration / DECAY_S)
        self.steps, self.seconds = weight * self.steps + 1, weight * self.seconds + duration

    def estimate_remaining_steps(self, step: int) -> float:
        """Return the number of steps that fit after this one: below 1 if none fits, inf while it is unknown."""
        now = time.monotonic()
        if now - self.start < WARM_UP_S or self.deadline == math.inf:
            return math.inf
        steps_since_validation = step % self.validate_steps
        # Time from the last validation on, without the final validation.
        seconds = self.deadline - now - self.validation_s + steps_since_validation * self.step_duration
        cycles, remainder = divmod(seconds, self.validate_steps * self.step_duration + self.validation_s)
        steps = cycles * self.validate_steps + min(remainder / self.step_duration, self.validate_steps)
        return steps - steps_since_validation - SPARE_STEPS

    @contextmanager
    def time_validation(self) -> Iterator[None]:
        """Measure the duration of the validation in this context, and exclude it from the step duration."""
        start = time.monotonic()
        yield
        self.validation_s = time.monotonic() - start
        self.last_step += self.validation_s


def _validate(run: Run, log: Log | None) -> None:
    """Validate the averaged weights on rank 0 (the process with a log), and save the best and last weights."""
    progress = run.progress
    progress.validated = progress.step
    if log is not None:
        metrics, calibration = run.task.validate(run.average.module)
        log.add("validation", progress.step, metrics)
        errors.print(f"step {progress.step}: {', '.join(f'{name} {value:.4g}' for name, value in metrics.items())}")
        if np.isnan(metrics["score"]):
            errors.print("the validation frames contain no object, so the latest weights count as the best")
        is_best = progress.best is None or not metrics["score"] <= progress.best
        if is_best:
            progress.best, progress.best_step = metrics["score"], progress.step
        record = {**vars(progress), "metrics": metrics, "calibration": calibration}
        if is_best:
            run.task.save("best", run.average.module, record)
        if run.is_done or progress.late:
            run.task.save("last", run.average.module, record)
    wait_for_all()


def _save_state(path: Path, run: Run) -> None:
    if get_rank() == 0:
        _write_state(path, run)
    wait_for_all()


def _write_state(path: Path, run: Run) -> None:
    content = io.BytesIO()
    torch.save(run.make_state(), content)
    write_bytes(path, content.getbuffer())


def _next_batch(batches: Iterator[Any], path: Path, run: Run) -> Any:
    """Return the next batch. If a worker process was killed, save the state and raise InputError.

    Only rank 0 saves, and it does not wait for the others, which may be at an earlier step.
    """
    try:
        return next(batches)
    except InputError:
        if get_rank() == 0 and run.progress.step:
            _write_state(path, run)
        raise


def _read_state(path: Path, settings: dict[str, Any]) -> dict[str, Any]:
    """Read a state. Raise InputError if it is damaged, or if its run has other settings."""
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        saved_settings = state["asked"]
    except (OSError, RuntimeError, KeyError, TypeError, EOFError, pickle.UnpicklingError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"cannot read {path}: {reason}; remove it to start again") from None
    if differences := find_differences(saved_settings, settings):
        raise InputError(
            f"{path} belongs to a run with {'; '.join(differences[:3])}; resume it with the same settings, "
            "or give another --out"
        )
    return state


@contextmanager
def _catch_signals() -> Iterator[threading.Event]:
    """Yield an event that the first SIGINT or SIGTERM sets; a second signal ends the process."""
    event = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield event
        return
    old_handlers: dict[int, Any] = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def set_event(number: int, _: Any) -> None:
        event.set()
        signal.signal(number, old_handlers[number])
        errors.print("stopping after this step; press Ctrl-C again to stop at once")

    for number in old_handlers:
        signal.signal(number, set_event)
    try:
        yield event
    finally:
        for number, handler in old_handlers.items():
            signal.signal(number, handler)
