"""The training loop of every network of the package.

A network brings a Task; the loop brings one-cycle AdamW, mixed precision, gradient clipping, the
average of the weights, validation, logs, and a state on disk from which a killed run resumes.
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
from lidar_perception.runs.resuming import differences
from lidar_perception.runs.terminal import errors, paused, progress
from lidar_perception.training.log import Log
from lidar_perception.training.out import may_begin
from lidar_perception.training.params import LoopParams
from lidar_perception.training.ranks import any_of, least, rank, wait
from lidar_perception.training.run import Progress, Run, Task
from lidar_perception.types import InputError

SETTLING = 60.0  # seconds until the pace of a run is known
MEMORY = 600.0   # seconds after which a step counts 1 / e in it
SPARE = 2        # steps whose time is kept, as no two steps take as long


def train(task: Task, params: LoopParams, out: Path, device: torch.device = torch.device("cpu"),
          resume: bool = False, until: float = math.inf, validation: float = 0.0) -> Progress:
    """Train until the steps are done, a signal (SIGINT, SIGTERM) comes, or time.monotonic() comes
    to `until`, with so much left as a validation takes (validation: seconds that the first one is
    expected to take); the state is saved then. Where fewer steps fit until then, the learning rate
    falls faster, so that it ends as low as planned.

    In out: STATE, for resuming; log.csv, validation.csv, and whatever task.keep writes. The same
    task and seed give the same weights on the CPU, whether the run was interrupted or not.
    InputError if out holds a run and resume is not asked for, or one of other settings, if nothing
    can be written, or if the loss stays not finite. resume without a run in out begins one.
    """
    path = may_begin(out, resume)
    make_folder(out)
    torch.manual_seed(params.seed + rank())
    run = Run(task, params, device)
    if path.exists():
        run.load(_read(path, run.asked()))
    wait()  # until all have read what rank 0 is going to replace
    log = Log(out, run.progress.step) if rank() == 0 else None
    begun = time.monotonic() - run.progress.seconds
    pace, said = Pace(until, run.every, validation), False
    try:
        with _signals() as stop, progress() as bar:
            line = bar.add_task("training", total=run.steps, completed=int(run.place),
                                visible=rank() == 0)
            batches = iter(task.batches(run.progress.step))
            while True:
                if any_of(stop.is_set(), device):
                    run.progress.stopped = True
                    _save(path, run)
                    break
                run.progress.late = any_of(pace.over(), device) and not run.done
                due = run.due() and (run.done or not any_of(pace.over(2), device))
                if due or (run.progress.late and run.progress.step > run.progress.validated):
                    _save(path, run)  # as validation takes its time
                    with pace.validating(), paused(bar):
                        _validate(run, log)
                    _save(path, run)
                if run.done or run.progress.late:
                    break
                row = run.step(_next(batches, path, run))
                step = run.progress.step
                pace.step()
                if until < math.inf:
                    fit = step + max(0.0, least(pace.fit(step), device))
                    run.hurry(fit - step)
                    if fit < 0.9 * run.steps and not said and rank() == 0:
                        said = True
                        errors.print(f"slower than planned, {pace.seconds:.2g} s a step: about "
                                     f"{fit:.0f} of {run.steps} steps fit into the budget, so the "
                                     "learning rate falls faster")
                run.progress.seconds = time.monotonic() - begun
                bar.update(line, completed=run.place)
                if row is not None:
                    bar.update(line, description=f"loss {row['loss']:.3f} lr {row['lr']:.1e}")
                    if log is not None and step % params.log_steps == 0:
                        log.add("loss", step, {**row, "skipped": run.progress.skipped,
                                               "seconds": run.progress.seconds})
                if step % params.save_steps == 0 and not run.due():
                    _save(path, run)
    finally:
        if log is not None:
            log.close()
    return run.progress


class Pace:
    """How many steps fit into the time that is left, one validation after each `every` of them and
    one at the end."""

    def __init__(self, until: float, every: int, validation: float = 0.0):
        self.until, self.every, self.validation = until, every, validation
        self.begun = self.before = time.monotonic()
        self.steps = self.passed = 0.0  # of late; earlier ones count less and less

    @property
    def seconds(self) -> float:
        """That a step takes."""
        return self.passed / self.steps

    def over(self, validations: int = 1) -> bool:
        """Whether there is no more time than so many validations take."""
        return time.monotonic() + validations * self.validation >= self.until

    def step(self) -> None:
        """After each step."""
        now = time.monotonic()
        taken, self.before = now - self.before, now
        kept = math.exp(-taken / MEMORY)
        self.steps, self.passed = kept * self.steps + 1, kept * self.passed + taken

    def fit(self, step: int) -> float:
        """How many steps after that one fit, below 1 if none; infinite before that is known."""
        now = time.monotonic()
        if now - self.begun < SETTLING or self.until == math.inf:
            return math.inf
        since = step % self.every
        left = self.until - now - self.validation + since * self.seconds
        whole, rest = divmod(left, self.every * self.seconds + self.validation)
        return whole * self.every + min(rest / self.seconds, self.every) - since - SPARE

    @contextmanager
    def validating(self) -> Iterator[None]:
        """Around a validation, to know how long one takes; it is no part of a step."""
        begun = time.monotonic()
        yield
        self.validation = time.monotonic() - begun
        self.before += self.validation


def _validate(run: Run, log: Log | None) -> None:
    """Score the averaged weights, in rank 0, which has the log, and keep them if they are the best
    so far, or the last."""
    progress = run.progress
    progress.validated = progress.step
    if log is not None:
        metrics, calibration = run.task.validate(run.average.module)
        log.add("validation", progress.step, metrics)
        shown = ", ".join(f"{name} {value:.4g}" for name, value in metrics.items())
        errors.print(f"step {progress.step}: {shown}")
        if np.isnan(metrics["score"]):
            errors.print("no object in the frames that are validated on, so the latest weights "
                         "count as the best")
        better = progress.best is None or not metrics["score"] <= progress.best
        if better:
            progress.best, progress.best_step = metrics["score"], progress.step
        record = {**vars(progress), "metrics": metrics, "calibration": calibration}
        if better:
            run.task.keep("best", run.average.module, record)
        if run.done or progress.late:
            run.task.keep("last", run.average.module, record)
    wait()


def _save(path: Path, run: Run) -> None:
    if rank() == 0:
        _write(path, run)
    wait()


def _write(path: Path, run: Run) -> None:
    content = io.BytesIO()
    torch.save(run.state(), content)
    write_bytes(path, content.getbuffer())


def _next(batches: Iterator[Any], path: Path, run: Run) -> Any:
    """The next batch. Where there is none, as a process that prepares them was killed, what was
    learned so far is saved, by rank 0: the others may not have come so far."""
    try:
        return next(batches)
    except InputError:
        if rank() == 0 and run.progress.step:
            _write(path, run)
        raise


def _read(path: Path, asked: dict[str, Any]) -> dict[str, Any]:
    """The state in path. InputError if it is broken, or of a run of other settings."""
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        before = state["asked"]
    except (OSError, RuntimeError, KeyError, TypeError, EOFError, pickle.UnpicklingError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"cannot read {path}: {reason}; remove it to start again") from None
    if different := differences(before, asked):
        raise InputError(f"{path} is of a run with {'; '.join(different[:3])}; resume it with the "
                         "same settings, or give another --out")
    return state


@contextmanager
def _signals() -> Iterator[threading.Event]:
    """An event that the first SIGINT or SIGTERM sets; a second one ends the process as usual."""
    event = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield event
        return
    numbers: tuple[int, ...] = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.getsignal(number) for number in numbers}

    def note(number: int, _: Any) -> None:
        event.set()
        signal.signal(number, before[number])
        errors.print("stopping after this step; once more to stop at once")

    for number in numbers:
        signal.signal(number, note)
    try:
        yield event
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
