"""The verb reproduce: runs the experiments of the papers."""

from __future__ import annotations

import importlib
import os
import platform
from datetime import datetime
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING

import click

from lidar_perception import __version__
from lidar_perception.cli.command import Choice, Command
from lidar_perception.cli.data import (
    WHAT,
    a_path,
    dask_option,
    limit_option,
    open_and_describe,
    out_folder,
    split_option,
)
from lidar_perception.runs.machine import count_cores, read_cpu_name
from lidar_perception.types import InputError

if TYPE_CHECKING:
    from experiments.framework.experiment import Experiment

EXPERIMENTS = {  # name -> module:attribute of an Experiment; the first is the default
    "stm-cpa": "experiments.stm_cpa.experiment:STM_CPA",
    "stm-cpa-configurations": "experiments.stm_cpa.configurations:CONFIGURATIONS",
    "clusters": "experiments.clusters.experiment:CLUSTERS",
}


@click.command(cls=Command)
@click.argument("words", nargs=-1, metavar="[EXPERIMENT] DATA")
@a_path("--data", f"Same as DATA. {WHAT}", "DATA")
@split_option
@out_folder("Folder for the report; the same command resumes a run that was stopped.",
            required=True)
@click.option("--jobs", type=click.IntRange(1), help="Number of processes. Default: one for each "
                                                     "core.")
@dask_option
@limit_option
@click.option("--force", is_flag=True, help="Start over, whatever is in --out.")
def reproduce(words: tuple[str, ...], data: Path | None, split: Path | None, out: Path,
              jobs: int | None, dask: str | None, limit: int | None, force: bool) -> None:
    """Run an experiment of a paper and report each value next to the paper's.

    EXPERIMENT is stm-cpa (default: every table of the STM-CPA paper), stm-cpa-configurations
    (the configurations `paper` and `best`, with and without a labelled seed) or clusters (adaptive
    clustering and improved PointNet).

    FOLDER gets report.html, report.md, report.json, the tables as CSV and the figures as PNG, and
    frames.jsonl with the record of every frame. Workers of --dask need this checkout in their
    PYTHONPATH.

    \b
    Examples:
      ./lidar reproduce stm-cpa /data/kitti/object --out report
      ./lidar reproduce stm-cpa-configurations /data/kitti/object --out configurations
      ./lidar reproduce stm-cpa /nfs/kitti --out report --dask tcp://10.0.0.1:8786
    """
    name, data = _split_words(words, data)
    if dask and jobs:
        raise click.UsageError("--jobs is for this machine, --dask for others: give one of them")
    from experiments.framework.report import group_skipped_frames, print_report, write_report
    from experiments.framework.runner import run_experiment
    from lidar_perception.data.frame import BOXES
    from lidar_perception.runs.terminal import console

    experiment = load_experiment(name)
    recording = open_and_describe(data, split=split)
    recording.require(BOXES, "reproduce")
    started, before = datetime.now().astimezone(), perf_counter()
    workers = jobs or count_cores()
    records = run_experiment(experiment, recording, out, jobs=workers, dask=dask, force=force,
                             limit=limit)
    seconds = perf_counter() - before
    sections = experiment.make_sections(records)
    about = {
        "folder": str(data.resolve()) + (f", the first {limit} scans" if limit else ""),
        "started": started.isoformat(" ", "seconds"),
        "duration of this run": f"{seconds:.0f} s" + (
            f" on the cluster at {dask}" if dask else f", processes: {workers}"),
        "machine": f"{read_cpu_name()}, {os.cpu_count()} cores; Python {platform.python_version()}",
        "version": f"lidar_perception {__version__}"}
    page = write_report(out, experiment, records, sections, about)
    if all("skipped" in record for record in records):
        raise InputError(f"{data}: no frame could be measured ({records[0]['skipped']})")
    print_report(sections, group_skipped_frames(records), console)
    console.print(f"report: {page}")


def load_experiment(name: str) -> Experiment:
    """Import one of EXPERIMENTS."""
    module, attribute = EXPERIMENTS[name].split(":")
    return getattr(importlib.import_module(module), attribute)


def _split_words(words: tuple[str, ...], data: Path | None) -> tuple[str, Path]:
    """Return the name of the experiment, which may be left out, and DATA.

    Raises:
        UsageError: DATA is missing, or something is given twice.
    """
    first = words[0] if words else ""
    is_experiment = first in EXPERIMENTS or len(words) > 1 or (
        first and data is not None and not Path(first).exists())
    given = first if is_experiment else None
    rest = words[given is not None:]
    name = Choice(EXPERIMENTS).convert(given or next(iter(EXPERIMENTS)), None, None)
    if len(rest) + (data is not None) > 1:
        raise click.UsageError(f"DATA is given twice, {' '.join(rest)}"
                               + (f" and --data {data}" if data else "") + "; give one")
    if not rest and data is None:
        raise click.UsageError("DATA is missing: give the path of a recording")
    return name, data or Path(rest[0])
