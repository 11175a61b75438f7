"""Checkpoints, initial weights and validation metrics of a training run."""

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


def make_save_function(
    out: Path, config: Any, params: LoopParams, batches: Batches, data_info: dict[str, Any], commit: str
) -> Callable[[str, nn.Module, dict[str, Any]], None]:
    """Return a function save(name, module, record) that writes out/name.safetensors, see Task.save."""

    def save(name: str, module: nn.Module, record: dict[str, Any]) -> None:
        training = {
            **data_info,
            "seed": params.seed,
            "steps": record["step"],
            "seconds": round(record["seconds"]),
            "steps_skipped": record["skipped"],
            "scenes_skipped": len(batches.skipped),
            "batch": params.batch * batches.world_size,
            "params": flatten(params),
            "version": __version__,
        }
        header = Header(
            config, training, round_metrics(record.get("metrics", {})), commit, record.get("calibration", {})
        )
        save_checkpoint(out / f"{name}.safetensors", module, header)

    return save


def load_initial_weights(network: Net, init: Path | None, config_type: type[Config]) -> Net:
    """Load the tensors of a checkpoint that fit the network; print a message if some do not fit."""
    if init is not None:
        loaded_count, count = copy_matching_weights(network, init, config_type)
        if loaded_count < count:
            errors.print(f"loaded {loaded_count} of {count} tensors from {init}; the others are initialised at random")
    return network


def report_skipped(reasons: Sequence[str], frame_count: int, reported_reasons: set[str]) -> None:
    """Print the reasons why validation frames were skipped, each only once.

    Args:
        reasons: Reason for each skipped frame.
        frame_count: Number of frames that were not skipped.
        reported_reasons: Reasons that were printed before; new ones are added.

    Raises:
        InputError: All frames were skipped.
    """
    for reason in dict.fromkeys(reasons):
        if reason not in reported_reasons:
            errors.print(f"validation: {reason}")
    reported_reasons.update(reasons)
    if frame_count == 0:
        raise InputError(f"no usable validation frame ({next(iter(reasons), 'there are no frames')})")


def round_metrics(metrics: dict[str, float]) -> dict[str, float | None]:
    """Round metrics to 3 digits for JSON, with None for NaN."""
    return {key: None if math.isnan(value) else round(value, 3) for key, value in metrics.items()}


def summarize_report(report: DetectionReport, score: str, classes: Sequence[str]) -> Validation:
    """Return metrics and calibration for Task.validate."""
    return (
        select_metrics(report.compute(), score, classes),
        fit_calibrations(Comparison.concatenate(report.frames)) if report.frames else {},
    )


def select_metrics(content: dict[str, Any], score: str, classes: Sequence[str]) -> dict[str, float]:
    """Select the AP of each class at the relaxed BEV and strict 3D overlaps (moderate, R40).

    Args:
        content: Result of DetectionReport.compute.
        score: "bev" or "map": the AP whose mean over the classes becomes the metric "score".
        classes: Names of the classes.

    Returns:
        Metrics by name; NaN for a class without objects, which the score ignores.
    """
    metrics: dict[str, float] = {}
    for name in classes:
        for row in "bev_relaxed", "3d":
            value = content["ap"].get(name, {}).get(row, {}).get("moderate")
            metrics[f"{name}_{row}"] = float("nan") if value is None else value["r40"]
    row = "bev_relaxed" if score == "bev" else "3d"
    values = [value for name in classes if not np.isnan(value := metrics[f"{name}_{row}"])]
    return {"score": float(np.mean(values)) if values else float("nan"), **metrics}
