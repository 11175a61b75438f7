"""adapt: learn from drives without labels."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import click

from lidar_perception.adapting.params import MADE, RECORD, REPORT, TITLE, AdaptParams
from lidar_perception.cli.data import WHAT, a_path, device_option, jobs_for_all_cores
from lidar_perception.cli.options import parameter_options
from lidar_perception.runs.files import read_text, refuse_others
from lidar_perception.runs.terminal import console, errors
from lidar_perception.types import InputError


@click.command()
@a_path("--data", f"Drives, of some minutes at best: {WHAT} No label is needed, nor used.", "PATH",
        required=True)
@a_path("--weights", "Checkpoint of PointPillars or of the cluster network to begin with, or "
        "pointpillars or pointnet for those that come with the package. It stays as it is.",
        "FILE|NAME", required=True)
@a_path("--out", "Folder for best.safetensors, adapt.json, report.html and the labels that were "
        "concluded.", "DIR", required=True)
@click.option("--budget", type=float, default=1.0, show_default=True, metavar="HOURS",
              help="How long all of it may take on this machine: frames and steps are chosen so.")
@click.option("--resume", is_flag=True, help="Resume the run in --out, if there is one.")
@click.option("--force", is_flag=True, help="Replace an earlier run in --out.")
@device_option
@jobs_for_all_cores("Processes that prepare scenes; 0: only this one.")
@parameter_options(AdaptParams())
def adapt(data: Path, weights: Path, out: Path, budget: float, resume: bool, force: bool,
          device: str, jobs: int, params: AdaptParams) -> None:
    """Adapt a detector to drives without labels.

    What PointPillars, silhouettes and the cluster network agree on while objects are tracked is
    learned as objects, what cannot be one as background; unclear ones are ignored. Simulated scans
    and objects are mixed in. After each round simulated scans, and frames that were not learned
    from, test the weights; a round that makes them worse is discarded.

    \b
    Examples:
      lidar-perception adapt --data drive.bag --weights robot/v4/best.safetensors --out adapted
      lidar-perception adapt --data /data/kitti/tracking --weights pointpillars --budget 2 --out v4
      lidar-perception label --data drive.bag --import openlabel:adapted/labels
    """
    from lidar_perception.runs.resuming import locked
    if resume and force:
        raise click.UsageError("--resume resumes, --force starts over: give one of them")
    weights = package_weights(weights)
    begin(out, weights, resume, force)
    console.print(f"adapting {weights} to {data}", style="dim")
    from lidar_perception.adapting.adapt import Adapting
    from lidar_perception.adapting.drives import Refused
    from lidar_perception.adapting.report import write_report
    run = Adapting(data, weights, out, budget, params, device, jobs)
    with locked(out):
        if force:
            empty(out)
        if not (out / RECORD).exists():
            (out / REPORT).unlink(missing_ok=True)
        try:
            run.run()
        except InputError as error:
            if isinstance(error, Refused):
                run.clear()
            if run.seen:  # so that one sees why
                write_report(run)
            raise
        except KeyboardInterrupt:
            errors.print(f"stopped; what is in {out} is kept, --resume goes on")
            raise
        write_report(run)
    tell(run)


def begin(out: Path, weights: Path, resume: bool, force: bool) -> None:
    """InputError where out holds something that is neither to be resumed nor replaced."""
    there = [path.name for path in out.iterdir()] if out.is_dir() else []
    free = not out.exists() or (out.is_dir() and not there)
    if free or (there == [REPORT] and TITLE in read_text(out / REPORT, 10**9)):
        return  # at most the report of a run that was refused
    ours = (out / RECORD).is_file()
    if not ours:
        raise InputError(f"{out} exists and is no run of adapt; give another name")
    if not (resume or force):
        raise InputError(f"{out} exists already; give another name, --resume or --force")
    if force:
        refuse_others(out, MADE)
        if weights.resolve().is_relative_to(out.resolve()):
            raise InputError(f"{weights} would be replaced with {out}; give another --out")


def empty(out: Path) -> None:
    """Remove all that is in out, but not out itself, which is locked; the record last, so that what
    a stop leaves is still a run that --force replaces."""
    for path in sorted(out.iterdir(), key=lambda path: path.name == RECORD):
        shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()


def package_weights(weights: Path) -> Path:
    """The file of --weights, which may be the name of a network."""
    from lidar_perception.detectors.pointnet.config import PointNetConfig
    from lidar_perception.detectors.pointnet.params import PointNetParams
    from lidar_perception.detectors.pointnet.weights_file import weights_file as of_pointnet
    from lidar_perception.detectors.pointpillars.config import NetworkConfig
    from lidar_perception.detectors.pointpillars.params import PointPillarsParams
    from lidar_perception.detectors.pointpillars.weights_file import weights_file
    if str(weights) == NetworkConfig.network:
        return weights_file(PointPillarsParams())
    return of_pointnet(PointNetParams()) if str(weights) == PointNetConfig.network else weights


def tell(run: Any) -> None:
    """Say how it ended."""
    from lidar_perception.scoring.tables import narrow_table
    table = narrow_table("Before and after", "", "simulated AP", "agreement", "confirmed", "")
    rows = [("before", run.before, "")] + [
        (f"round {n}", each.after, "not taken" if each.refused else "taken")
        for n, each in enumerate(run.rounds, 1)]
    for name, seen, taken in rows:
        table.add_row(name, f"{seen.simulated:.1f}", f"{seen.agreement:.2f}",
                      f"{seen.confirmed:.2f}", taken)
    console.print(table)
    for n, each in enumerate(run.rounds, 1):
        if each.refused:
            console.print(f"round {n}: {each.refused}")
    if run.best == run.weights:
        console.print("no round was taken: best.safetensors is the file that it began with")
    console.print(f"{run.out}: best.safetensors, {RECORD}, report.html, labels")
