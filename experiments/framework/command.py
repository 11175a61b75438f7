"""Command reproduce: run the experiments of the papers."""

from __future__ import annotations

import importlib
import os
import platform
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import click

from lidar_perception import __version__
from lidar_perception.cli.command import Choice, Command, refuse_options
from lidar_perception.cli.data import (
    DATA_HELP,
    dask_option,
    limit_option,
    open_and_describe,
    out_folder_option,
    path_option,
    refuse_jobs_with_dask,
)
from lidar_perception.cli.options import Algorithm, Settings, apply_values, device_option, settings_options
from lidar_perception.param_fields import collect_fields
from lidar_perception.runs.machine import count_cores, read_cpu_name
from lidar_perception.types import InputError

if TYPE_CHECKING:
    from experiments.framework.experiment import Experiment
    from experiments.framework.trained_models import ModelRequest
    from lidar_perception.data.frame import Recording

SIM = "sim"
EXPERIMENTS = {  # name -> "module:attribute" of an Experiment; the first is the default
    "stm-cpa": "experiments.stm_cpa.experiment:STM_CPA",
    "stm-cpa-configurations": "experiments.stm_cpa.configurations:CONFIGURATIONS",
    "eg-pointpillars": "experiments.eg_pointpillars.experiment:EG_POINTPILLARS",
    "eg-pointpillars-shipped": "experiments.eg_pointpillars.experiment:SHIPPED",
    "clusters": "experiments.clusters.experiment:CLUSTERS",
    "clusters-segmentation": "experiments.clusters.experiment:SEGMENTATION",
    "clusters-shipped": "experiments.clusters.experiment:SHIPPED",
}


def _list_parameters(options: Mapping[str, Any]) -> list[Algorithm]:
    """Return the training parameters of the selected experiment, for --set help."""
    names = [word for word in options.get("words", ()) if word in EXPERIMENTS]
    training = load_experiment(names[0]).training if names else None
    return [] if training is None else [Algorithm(names[0], collect_fields(training), None)]


@click.command(cls=Command)
@click.argument("words", nargs=-1, metavar="[EXPERIMENT] DATA|sim")
@path_option("--data", f"Same as DATA. {DATA_HELP} `sim`: simulated scans.", "DATA|sim")
@path_option(
    "--split",
    "Measure only the frames or sequences named in this file, one per line. "
    "Experiments that train networks use the other frames for training.",
)
@out_folder_option("Folder for the report. The same command resumes an interrupted run.", required=True)
@click.option(
    "--budget",
    type=click.FloatRange(0, min_open=True),
    metavar="HOURS",
    help="Time budget for training and measuring, which determines the number of training steps of all "
    "networks. Default: 2 with `sim`, otherwise the paper's number of epochs.",
)
@click.option(
    "--seeds",
    type=click.IntRange(1, 20),
    metavar="N",
    help="Train every network with this many seeds. Default: up to 3, as the budget allows.",
)
@device_option
@click.option("--jobs", type=click.IntRange(1), help="Number of processes. Default: one per core.")
@dask_option
@limit_option
@click.option(
    "--force",
    is_flag=True,
    help="Start over and replace the results in --out. Networks trained there with the same settings are reused.",
)
@settings_options(_list_parameters, "batch=8")
def reproduce(
    words: tuple[str, ...],
    data: Path | None,
    split: Path | None,
    out: Path,
    budget: float | None,
    seeds: int | None,
    device: str,
    jobs: int | None,
    dask: str | None,
    limit: int | None,
    force: bool,
    settings: Settings,
) -> None:
    """Run an experiment of a paper and report each value next to the paper's.

    \b
    EXPERIMENT is one of:
      stm-cpa                  every table of the STM-CPA paper (default)
      stm-cpa-configurations   configurations `paper` and `best`, with and without a labelled seed
      eg-pointpillars          the versions of EG-PointPillars after their training
      eg-pointpillars-shipped  the versions with the shipped weights, without training
      clusters                 every table of adaptive clustering and improved PointNet
      clusters-segmentation    the tables of clusters that need no network
      clusters-shipped         the detection tables of clusters with the shipped weights

    FOLDER gets report.html, report.md, report.json, the tables as CSV and the figures as PNG, and
    frames.jsonl with the record of every frame. Trained networks are in models/. Workers of --dask
    need this checkout in their PYTHONPATH.

    \b
    Examples:
      ./lidar reproduce stm-cpa /data/kitti/object --out report
      ./lidar reproduce stm-cpa-configurations /data/kitti/object --out configurations
      ./lidar reproduce clusters sim --budget 2 --out clusters
      ./lidar reproduce stm-cpa /nfs/kitti --out report --dask tcp://10.0.0.1:8786
      ./lidar reproduce eg-pointpillars sim --budget 2 --out eg
    """
    name, data = _split_words(words, data)
    refuse_jobs_with_dask(bool(jobs), dask)
    from experiments.framework.report import group_skipped_frames, print_report, write_report
    from experiments.framework.runner import run_experiment, run_with_models
    from lidar_perception.runs.terminal import console

    experiment = load_experiment(name)
    start_time, start_s = datetime.now().astimezone(), perf_counter()
    workers = jobs or count_cores()
    if experiment.training is None:
        refuse_options(
            ("budget", "seeds", "device", "config", "assignments"),
            f"requires an experiment that trains networks; {name} trains none",
        )
        recording = _open_recording(data, split, out)
        records = run_experiment(experiment, recording, out, jobs=workers, dask=dask, force=force, limit=limit)
    else:
        request = _make_request(experiment, data, split, out, budget, seeds, device, workers, limit, settings)
        recording = request.scenes.open_test_recording(request.params, out / "scans")
        experiment, records = run_with_models(experiment, request, recording, dask=dask, force=force, limit=limit)
    seconds = perf_counter() - start_s
    sections = experiment.make_sections(records)
    if experiment.illustrate is not None:
        sections = [*sections, *experiment.illustrate(records, recording.frames)]
    run_info = {
        "data": ("simulated scans" if str(data) == SIM else str(data.resolve()))
        + (f", the first {limit} scans" if limit else ""),
        "started": start_time.isoformat(" ", "seconds"),
        "duration of this run": f"{seconds:.0f} s"
        + (f" on the cluster at {dask}" if dask else f", processes: {workers}"),
        "machine": f"{read_cpu_name()}, {os.cpu_count()} cores; Python {platform.python_version()}",
        "version": f"lidar_perception {__version__}",
    }
    report_page = write_report(out, experiment, records, sections, run_info)
    if all("skipped" in record for record in records):
        raise InputError(f"{data}: no frame could be measured ({records[0]['skipped']})")
    print_report(sections, group_skipped_frames(records), console)
    console.print(f"report: {report_page}")


def _open_recording(data: Path, split: Path | None, out: Path) -> Recording:
    """Open the recording for an experiment that trains no networks."""
    from lidar_perception.data.frame import BOXES

    if str(data) != SIM:
        recording = open_and_describe(data, split=split)
        recording.require(BOXES, "reproduce")
        return recording
    from experiments.framework.scenes import ExperimentScenes
    from lidar_perception.training.params import PointNetTraining

    return ExperimentScenes.split(SIM, split).open_test_recording(PointNetTraining(), out / "scans")


def _make_request(
    experiment: Experiment,
    data: Path,
    split: Path | None,
    out: Path,
    budget: float | None,
    seeds: int | None,
    device: str,
    jobs: int,
    limit: int | None,
    settings: Settings,
) -> ModelRequest:
    """Return the request for the models of an experiment.

    Raises:
        InputError: A parameter is unknown or invalid, or the frames cannot be split.
    """
    from experiments.framework.scenes import TEST_SCANS, ExperimentScenes
    from experiments.framework.trained_models import DEFAULT_BUDGET_H, ModelRequest

    assert experiment.training is not None and experiment.models is not None
    scenes = ExperimentScenes.split(str(data), split)
    values = settings.resolve(Algorithm(experiment.name, collect_fields(experiment.training), None))[0]
    has_steps = any(values.get(name) for name in ("steps", "epochs"))
    if scenes.is_simulated and not has_steps:
        budget = budget or DEFAULT_BUDGET_H
    protocol = experiment.protocol if budget is None and not has_steps else {}
    params = apply_values(experiment.training, {**protocol, **values})
    frames = TEST_SCANS if scenes.is_simulated else len(scenes.test)
    return ModelRequest(
        experiment.models, params, scenes, out, budget, seeds, device, jobs, min(frames, limit or frames)
    )


def load_experiment(name: str) -> Experiment:
    """Import one of EXPERIMENTS."""
    module, attribute = EXPERIMENTS[name].split(":")
    return getattr(importlib.import_module(module), attribute)


def _split_words(words: tuple[str, ...], data: Path | None) -> tuple[str, Path]:
    """Split the arguments into the name of the experiment (or the default one) and DATA.

    Raises:
        UsageError: DATA is missing or given twice.
    """
    first = words[0] if words else ""
    is_experiment = first in EXPERIMENTS or len(words) > 1 or (first and data is not None and not Path(first).exists())
    experiment_name = first if is_experiment else None
    paths = words[experiment_name is not None :]
    name = Choice(EXPERIMENTS).convert(experiment_name or next(iter(EXPERIMENTS)), None, None)
    if len(paths) + (data is not None) > 1:
        raise click.UsageError(f"expected one DATA, got {' '.join(paths)}" + (f" and --data {data}" if data else ""))
    if not paths and data is None:
        raise click.UsageError("DATA is missing: give the path of a recording, or `sim`")
    return name, data or Path(paths[0])
