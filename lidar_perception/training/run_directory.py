"""Folder of a training run: its files, its plan, and its lock."""

from __future__ import annotations

import json
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

from lidar_perception.runs.files import check_writable_folder, read_text, remove_temporaries, write_text
from lidar_perception.runs.resuming import find_differences, lock_folder
from lidar_perception.training.distributed import get_rank
from lidar_perception.training.plan import AvailableScenes, Plan, Speed
from lidar_perception.types import InputError

RUN = "run.json"  # settings, measured speed and plan of the first start
STATE = "last.pt"  # state from which the run is resumed
WEIGHTS = "best.safetensors", "last.safetensors"
SCANS = "scans"  # the cache, unless another one is given
RUN_FILES = (RUN, STATE, *WEIGHTS, "objects.npz", "log.csv", "validation.csv")
MAX_RUN_BYTES = 10**6


class PlannedRun(NamedTuple):
    """Content of run.json. The settings must not change when the run is resumed."""

    settings: dict[str, Any]
    plan: Plan
    speed: Speed
    data: AvailableScenes


@dataclass(frozen=True)
class RunDirectory:
    """The folder of a training run."""

    path: Path

    @property
    def state_file(self) -> Path:
        return self.path / STATE

    @property
    def plan_file(self) -> Path:
        return self.path / RUN

    def require_no_run(self, resume: bool) -> None:
        """Check that a run can be started or resumed in this folder.

        Raises:
            InputError: The folder contains a run and resume is False, contains weights without a
                run, or is not writable.
        """
        files = self.plan_file, self.state_file
        for file in files:
            self.require_absent(file, resume)
        for name in WEIGHTS:
            if not any(file.exists() for file in files) and (self.path / name).exists():
                raise InputError(f"{self.path / name} exists and would be replaced; give another --out")

    def require_absent(self, file: Path, resume: bool) -> None:
        """Raise InputError if the folder contains this file and resume is False, or is not writable."""
        check_writable_folder(self.path)
        if file.exists() and not resume:
            raise InputError(
                f"{self.path} already contains a training run; give --resume to resume it, or another --out"
            )

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Lock the folder, treat SIGTERM like Ctrl-C, and remove temporary files of a killed run.

        Does nothing in processes other than rank 0.
        """
        if get_rank() > 0:
            yield
            return
        with lock_folder(self.path), _interrupt_on_sigterm():
            remove_temporaries(self.path, *RUN_FILES)
            for folder in (self.path / SCANS, *(self.path / SCANS).glob("*/")):
                remove_temporaries(folder, "*.npz")
            yield

    def write_plan(self, run: PlannedRun) -> None:
        """Write the plan file."""
        write_text(
            self.plan_file,
            json.dumps(
                {"asked": run.settings, "plan": asdict(run.plan), "speed": asdict(run.speed), "data": asdict(run.data)},
                indent=1,
            ),
        )

    def read_plan(self, settings: dict[str, Any]) -> PlannedRun:
        """Read the plan file. Raise InputError if it cannot be read, or was made with other settings."""
        text = read_text(self.plan_file, MAX_RUN_BYTES)
        try:
            content = json.loads(text)
            run = PlannedRun(
                content["asked"], Plan(**content["plan"]), Speed(**content["speed"]), AvailableScenes(**content["data"])
            )
            differences = find_differences(run.settings, json.loads(json.dumps(settings)))
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise InputError(f"cannot read {self.plan_file}: {error!r}; give another --out") from None
        if differences:
            raise InputError(
                f"{self.path} contains a run with {'; '.join(differences[:3])}; resume it with the same settings, "
                "or give another --out"
            )
        return run


@contextmanager
def _interrupt_on_sigterm() -> Iterator[None]:
    """Raise KeyboardInterrupt on SIGTERM, if this is the main thread and there is no other handler."""
    in_main_thread = threading.current_thread() is threading.main_thread()
    if not in_main_thread or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield
        return
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
