"""Planning of a training run on this machine: measure its speed, fit the steps, and report."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any

import torch

from lidar_perception.detectors.checkpoint import MIN_HEIGHT_DIFFERENCE_M
from lidar_perception.param_fields import with_values
from lidar_perception.runs.machine import count_cores
from lidar_perception.runs.terminal import errors, format_duration
from lidar_perception.simulation.sensor import Sensor
from lidar_perception.training.data import Item, SceneReader
from lidar_perception.training.distributed import get_world_size
from lidar_perception.training.plan import Data, Plan, Speed, fit_plan, preparation_duration, training_durations
from lidar_perception.training.request import TrainingRequest
from lidar_perception.training.run_directory import PlannedRun
from lidar_perception.training.scenes import RecordedScenes, SimulatedScenes
from lidar_perception.training.sources import open_sources
from lidar_perception.training.timing import MAX_TIMED_SCENES
from lidar_perception.training.trainer import Trainer
from lidar_perception.types import InputError

DEFAULT_BUDGET_H = 2.0
MIN_FREE_GB = 0.5  # free disk space to leave


@dataclass(frozen=True)
class Planner:
    """Planner of a training run.

    Attributes:
        trainer: Trainer of the network.
        request: Data and budget.
        params: Parameters as requested by the user.
        sensor: Sensor of simulated scans.
        device: Device of the network.
        speed: Durations; None measures them.
    """

    trainer: Trainer
    request: TrainingRequest
    params: Any
    sensor: Sensor
    device: torch.device
    speed: Speed | None = None

    def make_plan(self, settings: dict[str, Any]) -> PlannedRun:
        """Measure this machine, and print and return a plan that fits the budget.

        Raises:
            InputError: No scene can be used, the budget is too short, or the disk is too small.
        """
        params = self.params
        sources, held_out = self.open_few_scenes()
        if (speed := self.speed) is None:
            errors.print("measuring this machine with a few scenes ...")
            speed = self.measure_speed(sources, held_out)
        data = self.count_scenes(sources, held_out)
        fixed = Plan(
            params.data.scans,
            params.data.val_scans,
            0,
            params.steps,
            params.validate_steps,
            bool(self.trainer.reduced_range(params)),
        )
        plan = fit_plan(self.request.budget or DEFAULT_BUDGET_H, count_cores(), speed, data, fixed, params.epochs)
        if params.validate_epochs and not params.validate_steps:
            epoch = max(1, round((plan.scans + data.recorded) / data.batch))
            plan = replace(plan, validate_steps=params.validation_steps(epoch))
        _require_disk_space(Path(params.data.cache), params.data.cache_gb, plan, speed)
        self._print_plan(plan, speed, data, find_recorded_height(sources))
        return PlannedRun(settings, plan, speed, data)

    def count_scenes(self, sources: Sequence[Any], held_out: Sequence[Any]) -> Data:
        """Count the training and validation scenes."""
        return Data(
            has_simulated(sources),
            has_simulated(held_out),
            _count_recorded(sources),
            _count_recorded(held_out),
            self.params.batch * get_world_size(),
            self.trainer.max_cuts(self.params),
        )

    def apply_plan(self, plan: Plan) -> Any:
        """Return the parameters with the numbers of a plan."""
        part = self.trainer.reduced_range(self.params) if plan.part else {}
        return with_values(
            self.params,
            {
                "steps": plan.steps,
                "validate_steps": plan.validate_steps,
                "data.scans": plan.scans,
                "data.val_scans": plan.val_scans,
                **part,
            },
        )

    def open_few_scenes(self) -> tuple[Sequence[Any], Sequence[Any]]:
        """Open the training and validation sources with few simulated scans and no cache."""
        return open_scenes(self.request, limit_to_few_scans(self.params), self.sensor)

    def measure_speed(self, sources: Sequence[Any], held_out: Sequence[Any]) -> Speed:
        """Measure durations on this machine with the sources from open_few_scenes."""
        scenes, scan, scan_mb = _time_scans((*sources, *held_out))
        cut, step, whole, frame = self.trainer.measure_speed(
            limit_to_few_scans(self.params), scenes, held_out, self.device
        )
        return Speed(scan, cut, step, whole, frame, scan_mb)

    def _print_plan(self, plan: Plan, speed: Speed, data: Data, height: float | None) -> None:
        params = self.params
        at_height = "" if height is None else f" at {height:g} m"
        scenes = " and ".join(
            text
            for count, text in (
                (plan.scans, f"{plan.scans} {params.scene} scans of {params.sensor} at {self.sensor.height:g} m"),
                (data.recorded, f"{data.recorded} recorded scenes{at_height}"),
            )
            if count
        )
        part = self.trainer.reduced_range(params) if plan.part else {}
        region = f" up to {part['ahead']:g} m ahead and {part['aside']:g} m aside" if part else ""
        interval = f"every {plan.validate_steps} steps" if plan.validate_steps < plan.steps else "at the end"
        errors.print(
            f"{self.trainer.name}: {scenes}, {plan.steps} steps of {data.batch} scenes{region}, "
            f"validated {interval} on {plan.val_scans + data.val_recorded} other scenes"
        )
        steps, validations = training_durations(plan, speed, data)
        cutting = preparation_duration(replace(plan, scans=0, val_scans=0), count_cores(), speed)
        parts = {
            "simulating": preparation_duration(plan, count_cores(), speed) - cutting,
            self.trainer.cutting_title: cutting,
            "steps": steps,
            "validation": validations,
        }
        errors.print(
            f"about {format_duration(sum(parts.values()))} on {count_cores()} cores at "
            f"their present load, torch with {torch.get_num_threads()} threads: "
            + ", ".join(f"{name} {format_duration(value)}" for name, value in parts.items())
        )
        errors.print(f"cache: {params.data.cache}; an interrupted run continues with --resume")


def open_scenes(request: TrainingRequest, params: Any, sensor: Sensor) -> tuple[tuple, tuple]:
    """Open the training and validation sources of a request, see sources.open_sources."""
    around = getattr(params, "range", "") == "around"
    return open_sources(
        request.data,
        request.val,
        request.split,
        request.val_split,
        params.data,
        params.seed,
        sensor,
        around,
        params.scene,
        params.mount_height,
    )


def limit_to_few_scans(params: Any) -> Any:
    """Return the parameters with few simulated scans and no cache."""
    return with_values(params, {"data.scans": 8, "data.val_scans": 1, "data.cache": ""})


def has_simulated(sources: Sequence[Any]) -> bool:
    """Return True if any source simulates its scans."""
    return any(isinstance(source, SimulatedScenes) for source in sources)


def find_recorded_height(sources: Sequence[Any]) -> float | None:
    """Return the sensor height of the recordings in metres; None if there are none, or the heights differ."""
    heights = [source.sensor_height for source in sources if isinstance(source, RecordedScenes)]
    if not heights or max(heights) - min(heights) >= MIN_HEIGHT_DIFFERENCE_M:
        return None
    return round(median(heights), 2)


def _count_recorded(sources: Sequence[Any]) -> int:
    return sum(len(source) for source in sources if not isinstance(source, SimulatedScenes))


def _time_scans(sources: Sequence[Any]) -> tuple[Iterable[Item], float, float]:
    """Return a few scenes, and the duration (s) and size (MB) of a simulated scan.

    The duration includes a share of making the scene. Without simulated scans, both are 0 and the
    scenes are recorded ones, read on demand.
    """
    for source in sources:
        if isinstance(source, SimulatedScenes):
            count = source.per_scene
            source.scene(0)  # compiles the simulator
            start = time.perf_counter()
            scenes = [source.scene(i) for i in range(count, count + min(count, MAX_TIMED_SCENES))]
            duration = (time.perf_counter() - start) / len(scenes)
            return [Item(scene) for scene in scenes], duration, scenes[0].points.nbytes * 1.02e-6
    recorded = SceneReader(tuple(sources), lambda source, i: source.scene(i))
    return (recorded[n] for n in range(len(recorded))), 0.0, 0.0


def _require_disk_space(cache: Path, max_gb: float, plan: Plan, speed: Speed) -> None:
    needed = min((plan.scans + plan.val_scans) * speed.scan_mb / 1e3, max_gb)
    free = shutil.disk_usage(cache).free / 1e9
    if needed + MIN_FREE_GB > free:
        raise InputError(
            f"{cache} needs {needed:.1f} GB for scans, but only {free:.1f} GB are free: "
            "give fewer --data-scans, a smaller --data-cache-gb or another --out"
        )
