"""Records of a training run: the header of its checkpoints, and its metrics."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from torch import nn

from lidar_perception import __version__
from lidar_perception.detectors.checkpoint import Config, Header, Net, copy_matching_weights, save_checkpoint
from lidar_perception.param_fields import flatten
from lidar_perception.runs.terminal import errors
from lidar_perception.scoring.kitti.protocol import Comparison
from lidar_perception.scoring.kitti.reliability import fit_calibrations
from lidar_perception.scoring.kitti.report import DetectionReport
from lidar_perception.training.data import Batches
from lidar_perception.training.params import LoopParams
from lidar_perception.training.run import Validation
from lidar_perception.types import InputError


def make_save(
    out: Path, config: Any, params: LoopParams, batches: Batches, about: dict[str, Any], commit: str
) -> Callable[[str, nn.Module, dict[str, Any]], None]:
    """Return the save function of a Task, which writes out/name.safetensors."""

    def save(name: str, module: nn.Module, record: dict[str, Any]) -> None:
        training = {
            **about,
            "seed": params.seed,
            "steps": record["step"],
            "seconds": round(record["seconds"]),
            "steps_skipped": record["skipped"],
            "scenes_skipped": len(batches.skipped),
            "batch": params.batch * batches.world,
            "params": flatten(params),
            "version": __version__,
        }
        header = Header(
            config, training, round_metrics(record.get("metrics", {})), commit, record.get("calibration", {})
        )
        save_checkpoint(out / f"{name}.safetensors", module, header)

    return save


def load_initial_weights(network: Net, init: Path | None, kind: type[Config]) -> Net:
    """Load the tensors of a checkpoint that fit the network, and report how many do."""
    if init is not None:
        taken, count = copy_matching_weights(network, init, kind)
        if taken < count:
            errors.print(f"{taken} of {count} tensors are from {init}, the others begin at random")
    return network


def report_skipped(skipped: Sequence[str], left: int, reported: set[str]) -> None:
    """Print why validation frames were skipped, and add the reasons to those already reported.

    Args:
        left: Number of frames that remain.
        reported: Reasons that were printed before.

    Raises:
        InputError: No frame is left.
    """
    for reason in dict.fromkeys(skipped):
        if reason not in reported:
            errors.print(f"validation: {reason}")
    reported.update(skipped)
    if left == 0:
        raise InputError(f"no frame to validate on can be used ({next(iter(skipped), 'there is none')})")


def round_metrics(metrics: dict[str, float]) -> dict[str, float | None]:
    """Return metrics for JSON, in which NaN is None."""
    return {key: None if math.isnan(value) else round(value, 3) for key, value in metrics.items()}


def summarize_report(report: DetectionReport, score: str, classes: Sequence[str]) -> Validation:
    """Return metrics and calibration, as Task.validate does, of a network's own scores."""
    return (
        select_metrics(report.compute(), score, classes),
        fit_calibrations(Comparison.of(report.frames)) if report.frames else {},
    )


def select_metrics(content: dict[str, Any], score: str, classes: Sequence[str]) -> dict[str, float]:
    """Return each class's AP at the relaxed BEV and strict 3D overlaps (moderate, R40).

    Args:
        content: Content of a DetectionReport.
        score: "bev" or "map": the AP whose mean over the classes is the "score".
        classes: Names of the classes.

    Returns:
        Metrics by name, NaN where there are no objects. The score ignores such classes.
    """
    metrics: dict[str, float] = {}
    for name in classes:
        for row in "bev_relaxed", "3d":
            value = content["ap"].get(name, {}).get(row, {}).get("moderate")
            metrics[f"{name}_{row}"] = float("nan") if value is None else value["r40"]
    row = "bev_relaxed" if score == "bev" else "3d"
    known = [v for name in classes if not np.isnan(v := metrics[f"{name}_{row}"])]
    return {"score": float(np.mean(known)) if known else float("nan"), **metrics}
