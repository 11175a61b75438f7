"""What is written about a training run, in a checkpoint and in the log."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from torch import nn

from lidar_perception import __version__
from lidar_perception.detectors.checkpoint import Config, Header, Net, adopt, save_checkpoint
from lidar_perception.param_fields import flatten
from lidar_perception.runs.terminal import errors
from lidar_perception.scoring.kitti.protocol import Comparison
from lidar_perception.scoring.kitti.reliability import lines
from lidar_perception.scoring.kitti.report import DetectionReport
from lidar_perception.training.data import Batches
from lidar_perception.training.params import LoopParams
from lidar_perception.training.run import Judged
from lidar_perception.types import InputError


def record_of(params: LoopParams, batches: Batches, record: dict[str, Any],
              about: dict[str, Any]) -> dict[str, Any]:
    """What the header says of the training. record: what the loop gives keep; about: of the
    data."""
    return {**about, "seed": params.seed, "steps": record["step"],
            "seconds": round(record["seconds"]), "steps_skipped": record["skipped"],
            "scenes_skipped": len(batches.skipped), "batch": params.batch * batches.world,
            "params": flatten(params), "version": __version__}


def keeper(out: Path, config: Any, params: LoopParams, batches: Batches,
           about: dict[str, Any], commit: str) -> Callable[[str, nn.Module, dict[str, Any]], None]:
    """keep(name, module, record) of a Task: writes out/name.safetensors."""
    def keep(name: str, module: nn.Module, record: dict[str, Any]) -> None:
        header = Header(config, record_of(params, batches, record, about),
                      rounded(record.get("metrics", {})), commit, record.get("calibration", {}))
        save_checkpoint(out / f"{name}.safetensors", module, header)

    return keep


def begun_with(network: Net, init: Path | None, kind: type[Config]) -> Net:
    """The network, with the weights of init as far as they fit; what does not is said."""
    if init is not None:
        taken, count = adopt(network, init, kind)
        if taken < count:
            errors.print(f"{taken} of {count} tensors are of {init}, the others begin at random")
    return network


def name_skipped(skipped: Sequence[str], left: int, named: set[str]) -> None:
    """Say of which frames nothing was found, and why, but for the reasons in named, which they are
    added to. InputError where none is left to validate on."""
    for reason in dict.fromkeys(skipped):
        if reason not in named:
            errors.print(f"validation: {reason}")
    named.update(skipped)
    if left == 0:
        raise InputError("no frame to validate on can be used "
                         f"({next(iter(skipped), 'there is none')})")


def rounded(metrics: dict[str, float]) -> dict[str, float | None]:
    """For JSON: NaN as None."""
    return {key: None if math.isnan(value) else round(value, 3) for key, value in metrics.items()}


def judged(report: DetectionReport, score: str, classes: Sequence[str]) -> Judged:
    """What Task.validate gives of a report of the network's own scores."""
    return (metrics_of(report.compute(), score, classes),
            lines(Comparison.of(report.frames)) if report.frames else {})


def metrics_of(content: dict[str, Any], score: str, classes: Sequence[str]) -> dict[str, float]:
    """score, the mean over the classes with objects, and each class's AP from above at the relaxed
    overlaps and in space at the strict ones (moderate, R40); each is NaN without objects. content
    is that of a DetectionReport."""
    metrics: dict[str, float] = {}
    for name in classes:
        for row in "bev_relaxed", "3d":
            value = content["ap"].get(name, {}).get(row, {}).get("moderate")
            metrics[f"{name}_{row}"] = float("nan") if value is None else value["r40"]
    row = "bev_relaxed" if score == "bev" else "3d"
    known = [v for name in classes if not np.isnan(v := metrics[f"{name}_{row}"])]
    return {"score": float(np.mean(known)) if known else float("nan"), **metrics}
