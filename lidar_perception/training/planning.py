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
from lidar_perception.training.plan import (
    AvailableScenes,
    Plan,
    Speed,
    estimate_preparation_duration,
    estimate_training_durations,
    fit_plan,
)
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
        params: Parameters given by the user.
        sensor: Sensor of the simulated scans.
        device: Device of the network.
        speed: Durations for the plan; None measures them.
    """

    trainer: Trainer
    request: TrainingRequest
    params: Any
    sensor: Sensor
    device: torch.device
    speed: Speed | None = None

    def make_plan(self, settings: dict[str, Any]) -> PlannedRun:
        """Measure the speed of this machine, and print and return a plan that fits the budget.

        Raises:
            InputError: No scene can be used, the budget is too short, or the disk is too small.
        """
        params = self.params
        sources, val_sources = self.open_few_scenes()
        if (speed := self.speed) is None:
            errors.print("benchmarking this machine on a few scenes ...")
            speed = self.measure_speed(sources, val_sources)
        data = self.count_scenes(sources, val_sources)
        user_plan = Plan(
            params.data.scans,
            params.data.val_scans,
            0,
            params.steps,
            params.validate_steps,
            bool(self.trainer.find_reduced_range(params)),
        )
        plan = fit_plan(self.request.budget or DEFAULT_BUDGET_H, count_cores(), speed, data, user_plan, params.epochs)
        if params.validate_epochs and not params.validate_steps:
            epoch = max(1, round((plan.scans + data.recorded) / data.batch))
            plan = replace(plan, validate_steps=params.compute_validation_steps(epoch))
        _require_disk_space(Path(params.data.cache), params.data.cache_gb, plan, speed)
        self._print_plan(plan, speed, data, find_recorded_height(sources))
        return PlannedRun(settings, plan, speed, data)

    def count_scenes(self, sources: Sequence[Any], val_sources: Sequence[Any]) -> AvailableScenes:
        """Count the training and validation scenes."""
        return AvailableScenes(
            has_simulated(sources),
            has_simulated(val_sources),
            _count_recorded(sources),
            _count_recorded(val_sources),
            self.params.batch * get_world_size(),
            self.trainer.find_max_cut_scenes(self.params),
        )

    def apply_plan(self, plan: Plan) -> Any:
        """Return the parameters with the numbers of a plan."""
        reduced_range = self.trainer.find_reduced_range(self.params) if plan.part else {}
        return with_values(
            self.params,
            {
                "steps": plan.steps,
                "validate_steps": plan.validate_steps,
                "data.scans": plan.scans,
                "data.val_scans": plan.val_scans,
                **reduced_range,
            },
        )

    def open_few_scenes(self) -> tuple[Sequence[Any], Sequence[Any]]:
        """Open the training and validation sources with only a few simulated scans and no cache."""
        return open_sources(self.request, limit_to_few_scans(self.params), self.sensor)

    def measure_speed(self, sources: Sequence[Any], val_sources: Sequence[Any]) -> Speed:
        """Measure durations on this machine with the sources from open_few_scenes."""
        scenes, scan, scan_mb = _time_scans((*sources, *val_sources))
        speed = self.trainer.measure_speed(limit_to_few_scans(self.params), scenes, val_sources, self.device)
        return replace(speed, scan=scan, scan_mb=scan_mb)

    def _print_plan(self, plan: Plan, speed: Speed, data: AvailableScenes, height: float | None) -> None:
        params = self.params
        height_text = "" if height is None else f" at {height:g} m"
        scenes = " and ".join(
            text
            for count, text in (
                (plan.scans, f"{plan.scans} {params.scene} scans of {params.sensor} at {self.sensor.height:g} m"),
                (data.recorded, f"{data.recorded} recorded scenes{height_text}"),
            )
            if count
        )
        reduced_range = self.trainer.find_reduced_range(params) if plan.part else {}
        region = (
            f" up to {reduced_range['ahead']:g} m ahead and {reduced_range['aside']:g} m to each side"
            if reduced_range
            else ""
        )
        interval = f"every {plan.validate_steps} steps" if plan.validate_steps < plan.steps else "at the end"
        errors.print(
            f"{self.trainer.name}: {scenes}, {plan.steps} steps of {data.batch} scenes{region}, "
            f"validated {interval} on {plan.val_scans + data.val_recorded} other scenes"
        )
        steps, validations = estimate_training_durations(plan, speed, data)
        cutting = estimate_preparation_duration(replace(plan, scans=0, val_scans=0), count_cores(), speed)
        durations = {
            "simulating": estimate_preparation_duration(plan, count_cores(), speed) - cutting,
            self.trainer.cutting_title: cutting,
            "steps": steps,
            "validation": validations,
        }
        errors.print(
            f"about {format_duration(sum(durations.values()))} on {count_cores()} cores at "
            f"their current load, with {torch.get_num_threads()} torch threads: "
            + ", ".join(f"{name} {format_duration(value)}" for name, value in durations.items())
        )
        errors.print(f"cache: {params.data.cache}; resume an interrupted run with --resume")


def limit_to_few_scans(params: Any) -> Any:
    """Return the parameters with only a few simulated scans and no cache."""
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

    The duration includes a part of the time to make the scene. Without simulated scans, duration
    and size are 0, and the scenes are recorded ones that are read on demand.
    """
    for source in sources:
        if isinstance(source, SimulatedScenes):
            count = source.scans_per_scene
            source.load_scene(0)  # compiles the simulator
            start = time.perf_counter()
            scenes = [source.load_scene(i) for i in range(count, count + min(count, MAX_TIMED_SCENES))]
            duration = (time.perf_counter() - start) / len(scenes)
            return [Item(scene) for scene in scenes], duration, scenes[0].points.nbytes * 1.02e-6
    recorded_scenes = SceneReader(tuple(sources), lambda source, i: source.load_scene(i))
    return (recorded_scenes[n] for n in range(len(recorded_scenes))), 0.0, 0.0


def _require_disk_space(cache: Path, max_gb: float, plan: Plan, speed: Speed) -> None:
    required_gb = min((plan.scans + plan.val_scans) * speed.scan_mb / 1e3, max_gb)
    free_gb = shutil.disk_usage(cache).free / 1e9
    if required_gb + MIN_FREE_GB > free_gb:
        raise InputError(
            f"{cache} needs {required_gb:.1f} GB for scans, but only {free_gb:.1f} GB are free: "
            "give fewer --data-scans, a smaller --data-cache-gb or another --out"
        )
