"""Start of a new or resumed training run: make the plan, prepare the scenes, and train."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

import torch

from lidar_perception.detectors.checkpoint import read_header
from lidar_perception.detectors.devices import find_device
from lidar_perception.param_fields import with_values
from lidar_perception.runs.files import make_folder
from lidar_perception.runs.resuming import hash_names
from lidar_perception.runs.terminal import errors
from lidar_perception.simulation.sensor import Sensor, find_sensor
from lidar_perception.training.cache import fill_cache
from lidar_perception.training.data import Batches
from lidar_perception.training.distributed import get_rank, get_world_size, join_process_group, wait_for_all
from lidar_perception.training.loop import train
from lidar_perception.training.plan import Speed, estimate_validation_duration
from lidar_perception.training.planning import (
    DEFAULT_BUDGET_H,
    Planner,
    find_recorded_height,
    has_simulated,
    limit_to_few_scans,
)
from lidar_perception.training.record import load_initial_weights, make_save_function
from lidar_perception.training.request import PACKAGE, TrainingRequest
from lidar_perception.training.run import Progress, Task
from lidar_perception.training.run_directory import SCANS, RunDirectory
from lidar_perception.training.scenes import RecordedScenes, SimulatedScenes
from lidar_perception.training.sources import open_sources
from lidar_perception.training.trainer import Trainer
from lidar_perception.types import InputError


class TrainingResult(NamedTuple):
    """Result of a training run.

    Attributes:
        progress: Progress at the end.
        steps: Number of planned steps.
        batches: Batches that the network was trained on.
    """

    progress: Progress
    steps: int
    batches: Batches


def start_training(
    trainer: Trainer, request: TrainingRequest, params: Any, commit: str = "", speed: Speed | None = None
) -> TrainingResult | None:
    """Start or resume a training run.

    The first start measures this machine and writes a plan into the run's folder; a resumed run
    follows the same plan. All prepared scenes are cached, so a run may be killed at any time.

    Args:
        request: Data, output folder and limits.
        commit: Version of the code, for the header of the checkpoints.
        speed: Durations for the plan; None measures them on this machine.

    Returns:
        Result of the run; None in all processes but rank 0.

    Raises:
        InputError: An input cannot be used. Inputs are checked before long computations where possible.
    """
    start = time.monotonic()
    init = trainer.find_packaged_weights(params) if request.init == PACKAGE else request.init
    directory = RunDirectory(request.out)
    _check_request(request, directory, init)
    if not params.data.cache:
        params = with_values(params, {"data.cache": str(request.out / SCANS)})
    hours = request.budget
    if hours is None and not (params.steps or params.epochs):
        hours = DEFAULT_BUDGET_H
    sensor = find_sensor(params.sensor, params.mount_height)
    settings = _collect_settings(request, params, sensor, init)
    with join_process_group(torch.device(find_device(request.device))) as device, directory.lock():
        wait_for_all()  # rank 0 writes files that the others have checked above
        planner = Planner(trainer, request, params, sensor, device, speed)
        if get_rank() == 0:
            make_folder(Path(params.data.cache))
            if directory.plan_file.is_file():
                errors.print(f"resuming {directory.path}")
            else:
                with _explain_interrupt():
                    directory.write_plan(planner.make_plan(settings))
        wait_for_all()
        run = directory.read_plan(settings)
        params = planner.apply_plan(run.plan)
        sources, val_sources = open_sources(request, params, sensor)
        cuts = trainer.make_cuts(params, sources, val_sources, Path(params.data.cache))
        if get_rank() == 0:
            with _explain_interrupt():
                simulated_sources = [s for s in (*sources, *val_sources) if isinstance(s, SimulatedScenes)]
                scan_numbers = [range(len(source)) for source in simulated_sources]
                fill_cache(simulated_sources, scan_numbers, request.jobs, "simulating", params.data.cache_gb)
                fill_cache(*cuts, request.jobs, trainer.cutting_title)
                trainer.collect_cuts(params, cuts, request.out)
        wait_for_all()
        stream, validation = trainer.make_streams(params, sources, val_sources, cuts, request.out)
        batches = Batches(stream, params.batch, request.jobs, get_rank(), get_world_size())
        data_info = {
            "data": list(request.data),
            "scenes": len(stream),
            "validation": list(request.val) or "held out",
            "validation_scenes": sum(map(len, val_sources)),
            "init": str(request.init or ""),
            "sensor": _describe_sensor(params, sensor, sources),
        }
        torch.manual_seed(params.seed)
        network = load_initial_weights(trainer.make_network(), init, type(trainer.config)).to(device)
        task = Task(
            network,
            trainer.make_loss(params, device),
            batches,
            trainer.make_validate(params, validation, device, request.jobs),
            make_save_function(request.out, trainer.config, params, batches, data_info, commit),
            batches.steps_per_epoch,
            data_info,
        )
        deadline = math.inf if hours is None else start + 3600 * hours
        progress = train(
            task,
            params,
            request.out,
            device,
            request.resume,
            deadline,
            estimate_validation_duration(run.plan, run.speed, run.data),
        )
        return TrainingResult(progress, params.steps, batches) if get_rank() == 0 else None


def _check_request(request: TrainingRequest, directory: RunDirectory, init: Path | None) -> None:
    """Raise InputError for an invalid budget, init or output folder."""
    if request.budget is not None and not 0 < request.budget < math.inf:
        raise InputError(f"--budget {request.budget:g} must be a number of hours above 0")
    if init is not None:
        read_header(init)
    directory.require_no_run(request.resume)


@contextmanager
def _explain_interrupt() -> Iterator[None]:
    try:
        yield
    except KeyboardInterrupt:
        errors.print("stopped; prepared scenes are kept, so continue with --resume")
        raise


def _collect_settings(request: TrainingRequest, params: Any, sensor: Sensor, init: Path | None) -> dict[str, Any]:
    """Return the settings that must not change when the run is resumed.

    Splits and weights are represented by their content, because their files may change.
    """
    sources, val_sources = open_sources(request, limit_to_few_scans(params), sensor)
    weights_hash = sha256(init.read_bytes()).hexdigest()[:12] if init else ""
    return {
        **params.get_fixed_settings(),
        "data": list(request.data),
        "val": list(request.val),
        "split": str(request.split or ""),
        "val_split": str(request.val_split or ""),
        "frame_names": _hash_frame_names(sources),
        "val_frame_names": _hash_frame_names(val_sources),
        "init": str(request.init or ""),
        "init_weights": weights_hash,
        "sensor": asdict(sensor),
    }


def _hash_frame_names(sources: Sequence[Any]) -> list[str]:
    return [hash_names(source.names) for source in sources if isinstance(source, RecordedScenes)]


def _describe_sensor(params: Any, sensor: Sensor, sources: Sequence[Any]) -> dict[str, Any]:
    """Describe the sensor for the header of a checkpoint: the simulated sensor, or the height of the real one."""
    if has_simulated(sources):
        return {"name": params.sensor, "height": sensor.height, "beams": sensor.rings}
    height = find_recorded_height(sources)
    return {} if height is None else {"height": height}
