"""train: train networks on labelled or simulated scenes."""

from __future__ import annotations

import functools
import subprocess
import sys
from collections.abc import Callable
from dataclasses import Field, fields
from pathlib import Path
from typing import Any

import click

from lidar_perception import __version__
from lidar_perception.cli.command import Choice, Group
from lidar_perception.cli.data import data_argument, make_jobs_option, out_file_option, out_folder_option, path_option
from lidar_perception.cli.options import apply_values, device_option, parameter_options
from lidar_perception.param_fields import collect_fields
from lidar_perception.runs.terminal import console
from lidar_perception.training.params import FusedTraining, PointNetTraining, PointPillarsTraining
from lidar_perception.training.request import TrainingRequest
from lidar_perception.types import InputError

OPTIONS = (
    data_argument(
        "Training data: a data set or bag, or `sim` for simulated scenes; repeat it to mix them.",
        several=True,
        value_type=str,
    ),
    click.option(
        "--val",
        multiple=True,
        metavar="PATH|sim",
        help="Validation data. Default: frames held out of --data, and other simulated streets.",
    ),
    path_option("--split", "Train on the frames of --data, or whole sequences, listed in this file, one per line."),
    path_option("--val-split", "Validate on the frames or sequences listed in this file."),
    out_folder_option("Folder for best.safetensors, last.safetensors, logs and the training state.", required=True),
    click.option("--resume", is_flag=True, help="Resume the run in --out, if there is one."),
    path_option(
        "--init", "Start from the matching weights of this checkpoint; `package`: the shipped weights.", "FILE|package"
    ),
    device_option,
    make_jobs_option("Processes that prepare scenes; 0: only this process."),
    click.option(
        "--budget",
        type=float,
        metavar="HOURS",
        help="Time budget on this machine. It determines the number of scans, steps and validations unless given. "
        "When it is used up, the run stops and can be resumed. Default: 2, or no limit with --steps or "
        "--epochs.",
    ),
)


def shared_options(function: Callable) -> Callable:
    """Add the options shared by all networks. The command receives them as `request`, a TrainingRequest."""

    @functools.wraps(function)
    def wrapper(*args: Any, **kwargs: Any) -> Any:
        request = TrainingRequest(**{f.name: kwargs.pop(f.name) for f in fields(TrainingRequest)})
        return function(*args, request=request, **kwargs)

    for option in reversed(OPTIONS):
        wrapper = option(wrapper)
    return wrapper


def training_options(defaults: Any) -> Callable:
    """Return a decorator that adds --config, --set and one flag for each training parameter.

    The decorated function receives the result as `params`. Flags take precedence.
    """
    fields_by_name = collect_fields(defaults)

    def decorate(function: Callable) -> Callable:
        @functools.wraps(function)
        def wrapper(*args: Any, params: Any, **kwargs: Any) -> Any:
            flag_values = {
                name: value for name in fields_by_name if (value := kwargs.pop(name.replace(".", "_"))) is not None
            }
            return function(*args, params=apply_values(params, flag_values), **kwargs)

        for name, f in reversed(fields_by_name.items()):
            wrapper = _make_flag(name, f)(wrapper)
        return parameter_options(defaults, "training", None, "scene=campus")(wrapper)

    return decorate


def _make_flag(name: str, f: Field[Any]) -> Callable:
    flag, variable = "--" + name.replace(".", "-").replace("_", "-"), name.replace(".", "_")
    meta, default = f.metadata, f.default
    if isinstance(default, bool):
        return click.option(
            f"{flag}/--no-{flag[2:]}",
            variable,
            default=None,
            help=f"{meta['doc']} Default: {'on' if default else 'off'}.",
        )
    default_text = f"{default:.4g}" if isinstance(default, float) else default
    return click.option(
        flag,
        variable,
        type=Choice(meta["choices"]) if meta["choices"] else type(default),
        default=None,
        help=f"{meta['doc']}{f' [{unit}]' if (unit := meta['unit']) else ''} "
        f"Default: {'none' if default_text == '' else default_text}.",
    )


@click.group(cls=Group)
def train() -> None:
    """Train a network."""


@train.command()
@shared_options
@training_options(PointPillarsTraining())
def pointpillars(request: TrainingRequest, params: PointPillarsTraining) -> None:
    """Train PointPillars or EG-PointPillars on labelled frames, simulated streets, or both.

    Scans, steps and validations are chosen for a duration of --budget hours on this machine.
    OUT/best.safetensors has the weights with the best validation AP so far. Ctrl-C saves and stops;
    --resume resumes, even after the process was killed. Use torchrun for several GPUs.

    \b
    Examples:
      lidar-perception train pointpillars sim --version v4 --out v4
      lidar-perception train pointpillars sim --sensor vlp16 --mount-height 0.6 \\
          --range around --init package --out robot
      lidar-perception train pointpillars /data/kitti/object --split train.txt \\
          --val-split val.txt --epochs 80 --out v4 --resume
      torchrun --nproc-per-node 4 -m lidar_perception.cli.main train pointpillars sim \\
          --size full --budget 12 --out v4
    """
    run(request, params)


@train.command()
@shared_options
@training_options(PointNetTraining())
def pointnet(request: TrainingRequest, params: PointNetTraining) -> None:
    """Train PointNet on labelled frames, simulated streets, or both.

    Scenes are split into clusters by ground segmentation and clustering. Scans and steps are chosen
    for a duration of --budget hours on this machine. OUT/best.safetensors has the best weights so
    far, with scores calibrated on the validation data.

    \b
    Examples:
      lidar-perception train pointnet sim --out pointnet
      lidar-perception train pointnet sim --scene campus,indoor --sensor vlp16 \\
          --mount-height 0.6 --init package --out robot
      lidar-perception train pointnet /data/kitti/object --split train.txt \\
          --val-split val.txt --epochs 20 --out pointnet --resume
    """
    run(request, params)


@train.command()
@path_option("--weights", "Checkpoint or exported network (.onnx) of PointPillars. Default: the shipped one.")
@path_option("--classifier", "Checkpoint of PointNet. Default: the shipped one.")
@out_file_option("--out", "File to write (.json), for --weights and `fused.weights`.", required=True)
@click.option("--force", is_flag=True, help="Replace --out.")
@make_jobs_option("Processes that evaluate scans.", 1)
@training_options(FusedTraining())
def fused(
    weights: Path | None, classifier: Path | None, out: Path, force: bool, jobs: int, params: FusedTraining
) -> None:
    """Fit the fused detector to your own weights.

    PointPillars, silhouettes and PointNet are evaluated on simulated scans of the sensor that the
    weights were trained for, with and without intensity. The fitted curves, one set for each,
    combine their scores into a calibrated probability. This takes a few minutes. The file refers to
    the weights of both networks by their paths.

    \b
    Examples:
      lidar-perception train fused --weights robot/v4/best.safetensors \\
          --classifier robot/pointnet/best.safetensors --out robot/fused.json
      lidar-perception train fused --sensor vlp-16 --mount-height 0.6 --scene campus \\
          --range around --out vlp16.json
      lidar-perception evaluate detection drive --weights robot/fused.json
      lidar-perception run fused_detector --ros-args -p fused.weights:=$PWD/robot/fused.json
    """
    from lidar_perception.detectors.fused.fusion import SUFFIX

    if out.suffix != SUFFIX:
        raise InputError(f"--out {out} must end with {SUFFIX}")
    if out.exists() and not force:
        raise InputError(f"{out} already exists; give another name, or --force")
    from lidar_perception.training.fusion_curves import fit_fusion

    for kind, fits in fit_fusion(weights, classifier, out, params, jobs).items():
        print_fusion_fits(kind, fits)
    console.print(f"use {out} with --weights of commands, or as fused.weights of the node")


def run(request: TrainingRequest, params: PointPillarsTraining | PointNetTraining) -> None:
    """Train a network and print the result."""
    from lidar_perception.training.start import start_training
    from lidar_perception.training.trainers import make_trainer

    result = start_training(make_trainer(params), request, params, find_commit())
    if result is not None:
        print_result(*result, request.out)


def print_fusion_fits(kind: str, fits: Any) -> None:
    """Print the fitted curves of each class for one kind of cloud, compared with the packaged ones."""
    from lidar_perception.scoring.tables import make_table

    table = make_table(
        f"Fitted curves on held-out scans, {kind}", "", "proposals", "correct", ">= 0.4", "correct", "log loss"
    )
    unfitted_classes = []
    for name, fit in fits.items():
        rows = [("package", fit.old_score)]
        rows += [("fitted", fit.new_score)] if fit.new_score else []
        unfitted_classes += [] if fit.new_score else [name]
        for k, (source, score) in enumerate(rows):
            table.add_row(
                f"{name}, {source}",
                *((str(fit.proposals), str(fit.correct)) if k == 0 else ("", "")),
                str(score.correct + score.wrong),
                str(score.correct),
                f"{score.loss:.3f}",
            )
    console.print(table)
    if unfitted_classes:
        console.print(
            f"{', '.join(unfitted_classes)}: too few samples to fit curves, so the packaged curves are kept; use more "
            "--scans or another --scene"
        )


def print_result(progress: Any, steps: int, batches: Any, out: Path) -> None:
    """Print the result of a run. If it was stopped, exit with code 130."""
    if batches.skipped:
        console.print(f"{len(batches.skipped)} scenes were skipped; first reason: {next(iter(batches.skipped))}")
    if progress.skipped:
        console.print(f"{progress.skipped} of {progress.step} steps were skipped because of non-finite values")
    if progress.best is not None:
        console.print(f"{out / 'best.safetensors'}: score {progress.best:.2f} at step {progress.best_step}")
    if progress.left_out:
        console.print(f"{progress.left_out:.0f} of {steps} planned steps were skipped to end within the budget")
    if progress.late:
        console.print(
            "the budget ran out before the learning rate decayed: "
            f"{steps - progress.step - progress.left_out:.0f} of {steps} steps are "
            "missing; continue with --resume"
        )
    if progress.stopped:
        console.print(f"stopped at step {progress.step}; continue with --resume")
        sys.exit(130)


def find_commit() -> str:
    """Return the commit of this checkout, with + if files are changed; the version if unknown."""
    folder = Path(__file__).resolve().parents[2]
    try:
        head, changes = (
            subprocess.run(
                ["git", "-C", str(folder), *words], capture_output=True, text=True, check=True, timeout=20
            ).stdout.strip()
            for words in (("rev-parse", "HEAD"), ("status", "--porcelain", "--untracked-files=no"))
        )
    except (OSError, subprocess.SubprocessError):
        return __version__
    return head + ("+" if changes else "")
