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
from lidar_perception.cli.data import (
    WHAT,
    a_path,
    dask_option,
    limit_option,
    opened,
    out_folder,
    split_option,
)
from lidar_perception.reproduction.studies import STUDIES
from lidar_perception.runs.machine import count_cores, read_cpu_name
from lidar_perception.types import InputError

EXPERIMENTS = {"stm-cpa": "lidar_perception.reproduction.stm_cpa:STM_CPA"}


@click.command(cls=Command)
@click.argument("words", nargs=-1, metavar="[EXPERIMENT] DATA")
@click.option("--study", type=Choice(STUDIES), metavar="NAME", help="Measure one of the paper's "
              f"open questions instead of its tables: {', '.join(STUDIES)}.")
@a_path("--data", f"Same as DATA. {WHAT}", "DATA")
@split_option
@out_folder("Folder for the report; the same command resumes a run that was stopped.",
            required=True)
@click.option("--jobs", type=click.IntRange(1), help="Number of processes. Default: one for each "
                                                     "core.")
@dask_option
@limit_option
@click.option("--force", is_flag=True, help="Start over, whatever is in --out.")
def reproduce(words: tuple[str, ...], study: str | None, data: Path | None,
              split: Path | None, out: Path, jobs: int | None, dask: str | None,
              limit: int | None, force: bool) -> None:
    """Run the whole experiment of the STM-CPA paper and report each figure beside the paper's.

    FOLDER gets report.html, report.md, report.json, the tables as CSV and the figures as PNG, and
    frames.jsonl with the record of every frame.

    \b
    Examples:
      lidar-perception reproduce stm-cpa /data/kitti/object --out report
      lidar-perception reproduce stm-cpa /data/kitti/object --study seeds --out seeds
      lidar-perception reproduce stm-cpa /nfs/kitti --out report --dask tcp://10.0.0.1:8786
    """
    experiment, data = _experiment_and_data(words, data)
    if dask and jobs:
        raise click.UsageError("--jobs is for this machine, --dask for others: give one of them")
    from lidar_perception.data.frame import BOXES
    from lidar_perception.reproduction.report import print_report, skipped_groups, write_report
    from lidar_perception.reproduction.runner import run
    from lidar_perception.runs.terminal import console

    chosen = _load(EXPERIMENTS[experiment] if study is None else STUDIES[study])
    recording = opened(data, split=split)
    recording.require(BOXES, "reproduce")
    started, before = datetime.now().astimezone(), perf_counter()
    workers = jobs or count_cores()
    records = run(chosen, recording, out, jobs=workers, dask=dask, force=force, limit=limit)
    seconds = perf_counter() - before
    sections = chosen.sections(records)
    about = {
        "folder": str(data.resolve()) + (f", the first {limit} scans" if limit else ""),
        "started": started.isoformat(" ", "seconds"),
        "duration of this run": f"{seconds:.0f} s" + (
            f" on the cluster at {dask}" if dask else f", processes: {workers}"),
        "machine": f"{read_cpu_name()}, {os.cpu_count()} cores; Python {platform.python_version()}",
        "version": f"lidar_perception {__version__}"}
    page = write_report(out, chosen, records, sections, about)
    if all("skipped" in record for record in records):
        raise InputError(f"{data}: no frame could be measured ({records[0]['skipped']})")
    print_report(sections, skipped_groups(records), console)
    console.print(f"report: {page}")


def _experiment_and_data(words: tuple[str, ...], data: Path | None) -> tuple[str, Path]:
    """The arguments, of which the experiment may be left out. UsageError where DATA is missing, or
    something is given twice."""
    first = words[0] if words else ""
    is_experiment = first in EXPERIMENTS or len(words) > 1 or (
        first and data is not None and not Path(first).exists())
    named = first if is_experiment else None
    rest = words[named is not None:]
    experiment = Choice(EXPERIMENTS).convert(named or next(iter(EXPERIMENTS)), None, None)
    if len(rest) + (data is not None) > 1:
        raise click.UsageError(f"DATA is given twice, {' '.join(rest)}"
                               + (f" and --data {data}" if data else "") + "; give one")
    if not rest and data is None:
        raise click.UsageError("DATA is missing: give the path of a recording")
    return experiment, data or Path(rest[0])


def _load(target: str) -> Any:
    module, attribute = target.split(":")
    return getattr(importlib.import_module(module), attribute)
