"""What adapting needs of a network, of whatever kind: how it is opened, trained and validated."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from lidar_perception.adapting.params import AdaptParams
from lidar_perception.data.frame import Frame
from lidar_perception.detectors.checkpoint import POINTPILLARS, Header
from lidar_perception.detectors.devices import chosen_device
from lidar_perception.detectors.fused.detector import FusedDetector, load_fused_detector
from lidar_perception.detectors.fused.params import FusedDetectorParams, FusedParams
from lidar_perception.param_fields import with_values
from lidar_perception.simulation.sensor import Sensor
from lidar_perception.training.asked import Asked
from lidar_perception.training.data import Batches
from lidar_perception.training.params import PointNetTraining, PointPillarsTraining
from lidar_perception.training.plan import SCANS
from lidar_perception.training.pointnet.start import PointNetStart
from lidar_perception.training.pointpillars.start import PointPillarsStart
from lidar_perception.training.preparing import keep_all
from lidar_perception.training.start import scenes_of

AT_THE_END = 10**9  # steps between validations: one, after the last


def network_to_train(header: Header) -> Any:
    """The training of a network like that of a header, see training/start.Network."""
    if header.network == POINTPILLARS:
        return PointPillarsStart(header.config)
    return PointNetStart(header.config)


def opened_with(weights: Path, header: Header, device: str) -> FusedDetector:
    """All sources together, with these weights, of the header's kind, in the place of their own.
    The cluster network sees all around, and so do all with it."""
    if header.network == POINTPILLARS:
        return load_fused_detector(weights, device)
    return load_fused_detector("", device, FusedDetectorParams(
        fused=FusedParams(classifier=str(weights)))).seeing("around")


def training_params(header: Header, params: AdaptParams, frames: int, height: float,
                    cache: Path) -> PointPillarsTraining | PointNetTraining:
    """The settings of a training that mixes so many real frames with simulated scans, which are
    kept in cache; params are settled."""
    values: dict[str, Any] = {
        "steps": params.steps, "lr": params.lr, "batch": params.batch, "seed": params.seed,
        "validate_steps": AT_THE_END, "scene": params.scene,
        "sensor": params.sensor, "mount_height": height,
        "data.scans": params.scans or max(SCANS[0], frames), "data.val_scans": params.val_scans,
        "data.cache": str(cache)}
    if header.network == POINTPILLARS:
        around = "around" if header.config.low[0] < 0 else "ahead"
        return with_values(PointPillarsTraining(), {**values, "range": around})
    return with_values(PointNetTraining(), values)


def simulated_frames(asked: Asked, params: Any, sensor: Sensor) -> list[Frame]:
    """The simulated scans that are validated on, with their labels; they are made once."""
    return [source.frame(i) for source in _held_out(asked, params, sensor)
            for i in range(len(source))]


def _held_out(asked: Asked, params: Any, sensor: Sensor) -> tuple[Any, ...]:
    _, held_out = scenes_of(replace(asked, data=()), params, sensor)
    keep_all(held_out, [range(len(s)) for s in held_out], asked.jobs, "simulating")
    return held_out


def simulated_score(network: Any, asked: Asked, params: Any, sensor: Sensor,
                    weights: Path) -> dict[str, float]:
    """The metrics of weights on the simulated scans that are validated on, see
    training/record.metrics_of."""
    held_out = _held_out(asked, params, sensor)
    cuts, numbers = network.cut(params, (), held_out, Path(params.data.cache))
    keep_all(cuts, numbers, asked.jobs, network.cutting)
    stream, to_validate = network.scenes(params, (), held_out, (cuts, numbers), asked.out)
    task = network.task(params, Batches(stream, params.batch, asked.jobs), to_validate, asked.out,
                        chosen_device(asked.device), {}, "", weights)
    return task.validate(task.module.eval())[0]


