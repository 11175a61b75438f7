"""reproduce: the experiments of paper A, and studies of what it leaves open."""

from __future__ import annotations

import importlib
import os
import platform
from datetime import datetime
from pathlib import Path
from time import perf_counter
from typing import Any

import click

from lidar_perception import __version__
from lidar_perception.cli.command import Choice, Command
from lidar_perception.cli.data import dask_option, data_option, limit_option, opened, split_option
from lidar_perception.reproduction.studies import STUDIES
from lidar_perception.runs.machine import cores, cpu_name
from lidar_perception.types import InputError

EXPERIMENTS = {"stm-cpa": "lidar_perception.reproduction.stm_cpa:STM_CPA"}
NAMES = ", ".join(STUDIES) or "none yet"


@click.command(cls=Command)
@click.argument("experiment", type=Choice(EXPERIMENTS), default="stm-cpa")
@click.option("--study", metavar="NAME", help="Measure one of the paper's open questions instead "
              f"of its tables: {NAMES}.")
@data_option
@split_option
@click.option("--out", type=click.Path(path_type=Path), metavar="DIR", required=True,
              help="Folder for the report; the same command resumes a run that was stopped.")
@click.option("--jobs", type=click.IntRange(1), help="Number of processes. Default: one for each "
                                                     "core.")
@dask_option
@limit_option
@click.option("--force", is_flag=True, help="Start over, whatever is in --out.")
def reproduce(experiment: str, study: str | None, data: Path, split: Path | None, out: Path,
              jobs: int | None, dask: str | None, limit: int | None, force: bool) -> None:
    """Run the whole experiment of the STM-CPA paper and report each figure beside the paper's.

    DIR gets report.html, report.md, report.json, the tables as CSV and the figures as PNG, and
    frames.jsonl with the record of every frame.

    \b
    Examples:
      lidar-perception reproduce stm-cpa --data /data/kitti/object --out report
      lidar-perception reproduce stm-cpa --study seeds --data /data/kitti/object --out seeds
      lidar-perception reproduce stm-cpa --data /nfs/kitti --out report --dask tcp://10.0.0.1:8786
    """
    if dask and jobs:
        raise click.UsageError("--jobs is for this machine, --dask for others: give one of them")
    if study is not None and study not in STUDIES:
        raise click.BadParameter(f"{study!r} is no study; known are: {NAMES}",
                                 param_hint="--study")
    from lidar_perception.data.frame import BOXES
    from lidar_perception.reproduction.report import print_report, skipped_groups, write_report
    from lidar_perception.reproduction.runner import run
    from lidar_perception.runs.terminal import console

    chosen = _load(EXPERIMENTS[experiment] if study is None else STUDIES[study])
    recording = opened(data, split=split)
    recording.require(BOXES, "reproduce")
    started, before = datetime.now().astimezone(), perf_counter()
    workers = jobs or cores()
    records = run(chosen, recording, out, jobs=workers, dask=dask, force=force, limit=limit)
    seconds = perf_counter() - before
    sections = chosen.sections(records)
    about = {
        "folder": str(data.resolve()) + (f", the first {limit} scans" if limit else ""),
        "started": started.isoformat(" ", "seconds"),
        "duration of this run": f"{seconds:.0f} s" + (
            f" on the cluster at {dask}" if dask else f", processes: {workers}"),
        "machine": f"{cpu_name()}, {os.cpu_count()} cores; Python {platform.python_version()}",
        "version": f"lidar_perception {__version__}"}
    page = write_report(out, chosen, records, sections, about)
    if all("skipped" in record for record in records):
        raise InputError(f"{data}: no frame could be measured ({records[0]['skipped']})")
    print_report(sections, skipped_groups(records), console)
    console.print(f"report: {page}")


def _load(target: str) -> Any:
    module, attribute = target.split(":")
    return getattr(importlib.import_module(module), attribute)
