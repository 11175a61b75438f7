"""train: networks from labelled or simulated scenes."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lidar_perception import __version__
from lidar_perception.cli.options import parameter_options
from lidar_perception.runs.terminal import console
from lidar_perception.training.params import PointNetTraining, PointPillarsTraining

if TYPE_CHECKING:
    from lidar_perception.training.data import Batches
    from lidar_perception.training.run import Progress

PAPER_ABLATION = (75.52, 80.15, 81.33, 83.44, 85.10, 86.33, 86.89, 88.96)  # paper C, Table 5

SCENES_AND_RUN = (
    click.option("--data", multiple=True, required=True, metavar="DIR|sim",
                 help="What to train on: a data set or bag, or simulated streets; may be repeated "
                 "to mix them."),
    click.option("--val", multiple=True, metavar="DIR|sim",
                 help="What to validate on. Default: frames held out of --data, and other "
                 "simulated streets."),
    click.option("--split", type=click.Path(path_type=Path), metavar="FILE",
                 help="Train on the frames of --data, or whole sequences, that are named in this "
                 "file, one a line."),
    click.option("--val-split", type=click.Path(path_type=Path), metavar="FILE",
                 help="Likewise the frames to validate on."),
    click.option("--out", type=click.Path(path_type=Path), required=True, metavar="DIR",
                 help="Folder for best.safetensors, last.safetensors, logs and the state."),
    click.option("--resume", is_flag=True, help="Resume the run in --out, if there is one."),
    click.option("--init", type=click.Path(path_type=Path), metavar="FILE",
                 help="Start from the weights of this checkpoint, as far as they fit."),
    click.option("--device", default="auto", show_default=True, help="auto, cpu, cuda or cuda:N."),
    click.option("--jobs", type=click.IntRange(0), default=2, show_default=True,
                 help="Processes that prepare scenes; 0: only this one. The result is the "
                 "same."),
)


def scene_options(command):
    """The options of scenes and runs that all networks share."""
    for option in reversed(SCENES_AND_RUN):
        command = option(command)
    return command


@click.group()
def train() -> None:
    """Train a network."""


@train.command()
@scene_options
@parameter_options(PointPillarsTraining())
def pointpillars(data: tuple[str, ...], val: tuple[str, ...], split: Path | None,
                 val_split: Path | None, out: Path, resume: bool, init: Path | None, device: str,
                 jobs: int, params: PointPillarsTraining) -> None:
    """PointPillars and EG-PointPillars, on labelled frames, simulated streets, or both.

    OUT/best.safetensors holds the weights with the best validation AP so far. Ctrl-C saves and
    stops; --resume resumes, also after a kill. Several GPUs: torchrun.

    \b
    Examples:
      lidar-perception train pointpillars --version v4 --data sim --data-cache scans --out v4
      lidar-perception train pointpillars --data /data/kitti/object --split train.txt \\
          --val-split val.txt --epochs 80 --out v4 --resume
      torchrun --nproc-per-node 4 -m lidar_perception.cli.main train pointpillars --size full \\
          --data sim --out v4
    """
    from lidar_perception.detectors.devices import chosen_device
    from lidar_perception.detectors.pointpillars.config import network_config
    from lidar_perception.training.cut_objects import cut_objects
    from lidar_perception.training.data import Batches, JudgedScenes, RawScenes, Stream
    from lidar_perception.training.loop import may_begin
    from lidar_perception.training.loop import train as run
    from lidar_perception.training.pointpillars.task import (
        Preparation,
        frame_to_judge,
        make_task,
        narrowed,
    )
    from lidar_perception.training.ranks import joined, rank, wait, world
    from lidar_perception.training.sources import about_data, training_scenes
    may_begin(out, resume)
    config = network_config(params.version, params.size)
    sources, held_out = training_scenes(data, val, split, val_split, params.data, params.seed)
    with joined(chosen_device(device)) as place:
        database = None
        wanted = params.augment
        if wanted.database_scans and wanted.crowded and (
                wanted.cars or wanted.pedestrians or wanted.cyclists or wanted.things):
            database = out / "objects.npz"
            if rank() == 0 and not (resume and database.is_file()):
                raw = Stream(sources, None, params.seed)
                scenes = RawScenes(raw).some(wanted.database_scans, jobs)
                cut_objects(scenes, config.classes, params.data.min_points).save(database)
            wait()
        seen = narrowed(config, params.ahead, params.aside)
        stream = Stream(sources, Preparation(seen, params.augment, params.data.min_points,
                                             database), params.seed)
        batches = Batches(stream, params.batch, jobs, rank(), world())
        about = about_data(data, val, stream, held_out, init)
        task = make_task(config, params, batches, JudgedScenes(held_out, frame_to_judge), out,
                         place, about, commit(), init)
        progress = run(task, params, out, place, resume)
        if rank() > 0:
            return
    tell(progress, batches, out)


@train.command()
@scene_options
@click.option("--ablation", is_flag=True, help="Train every row of the paper's ablation, each into "
              "a folder in --out, and compare them.")
@parameter_options(PointNetTraining())
def pointnet(data: tuple[str, ...], val: tuple[str, ...], split: Path | None,
             val_split: Path | None, out: Path, resume: bool, init: Path | None, device: str,
             jobs: int, ablation: bool, params: PointNetTraining) -> None:
    """The cluster network of paper C, on labelled frames, simulated streets, or both.

    Scenes are cut into clusters by the package's own ground and clustering; with --data-cache the
    clusters are kept, too. The best weights so far lie in OUT/best.safetensors, their scores
    calibrated on what is validated on.

    \b
    Examples:
      lidar-perception train pointnet --data sim --data-cache scans --out pointnet
      lidar-perception train pointnet --data /data/kitti/object --split train.txt \\
          --val-split val.txt --epochs 20 --out pointnet --resume
      lidar-perception train pointnet --ablation --data sim --data-cache scans --steps 1000 \\
          --out ablation
    """
    from lidar_perception.detectors.devices import chosen_device
    from lidar_perception.detectors.pointnet.config import ABLATIONS
    from lidar_perception.runs.files import make_folder
    from lidar_perception.training.ranks import joined, rank
    from lidar_perception.training.sources import training_scenes
    make_folder(out)  # or say that it cannot be, before the data are prepared
    scenes = training_scenes(data, val, split, val_split, params.data, params.seed)
    with joined(chosen_device(device)) as place:
        for name in ABLATIONS if ablation else (params.network,):
            folder = out / name if ablation else out
            if rank() == 0 and ablation:
                console.print(f"{name}:", style="bold")
            _train_pointnet(replace(params, network=name), data, val, scenes, folder, resume,
                            init, place, jobs)
        if ablation and rank() == 0:
            print_ablation(out)


def _train_pointnet(params: PointNetTraining, data: tuple[str, ...], val: tuple[str, ...],
                    scenes: tuple[tuple, tuple], out: Path, resume: bool,
                    init: Path | None, place: Any, jobs: int) -> None:
    from lidar_perception.detectors.pointnet.config import pointnet_config
    from lidar_perception.training.data import Batches, JudgedScenes, Stream
    from lidar_perception.training.loop import may_begin
    from lidar_perception.training.loop import train as run
    from lidar_perception.training.pointnet.cut_scenes import CutScenes
    from lidar_perception.training.pointnet.task import (
        ClusterPreparation,
        judged_clusters,
        make_task,
    )
    from lidar_perception.training.ranks import rank, world
    from lidar_perception.training.sources import about_data
    may_begin(out, resume)
    config = pointnet_config(params.network)
    cache = Path(params.data.cache) / "clusters" if params.data.cache else None
    sources, held_out = (tuple(CutScenes(source, config, params.data.min_points, cache)
                               for source in part) for part in scenes)
    stream = Stream(sources, ClusterPreparation(config, params.augment), params.seed)
    batches = Batches(stream, params.batch, jobs, rank(), world())
    task = make_task(config, params, batches, JudgedScenes(held_out, judged_clusters), out,
                     place, about_data(data, val, stream, held_out, init), commit(), init)
    progress = run(task, params, out, place, resume)
    if rank() == 0:
        tell(progress, batches, out)


def print_ablation(out: Path) -> None:
    """The best of each row beside the paper's mAP on KITTI (Table 5)."""
    from lidar_perception.detectors.checkpoint import read_header
    from lidar_perception.detectors.pointnet.config import ABLATIONS
    from lidar_perception.scoring.tables import narrow_table
    table = narrow_table("Ablation, simulated or KITTI frames validated on", "network", "paper mAP",
                         "AP from above", "accuracy", "of objects")
    for name, paper in zip(ABLATIONS, PAPER_ABLATION):
        metrics = read_header(out / name / "best.safetensors").metrics
        table.add_row(name, f"{paper:.2f}", *(
            "-" if metrics.get(key) is None else f"{metrics[key]:.1f}"
            for key in ("score", "accuracy", "object_accuracy")))
    table.caption = ("AP from above: mean of Car, Pedestrian and Cyclist at the overlaps 0.5 / "
                     "0.25 / 0.25, moderate, R40; best weights of each run.")
    console.print(table)


def tell(progress: Progress, batches: Batches, out: Path) -> None:
    """Say how a run ended; a stopped one ends the process."""
    if batches.skipped:
        console.print(f"{len(batches.skipped)} scenes could not be used, such as: "
                      f"{next(iter(batches.skipped))}", soft_wrap=True)
    if progress.skipped:
        console.print(f"{progress.skipped} of {progress.step} steps were skipped: not finite")
    if progress.best is not None:
        console.print(f"{out / 'best.safetensors'}: score {progress.best:.2f} at step "
                      f"{progress.best_step}", soft_wrap=True)
    if progress.stopped:
        console.print(f"stopped at step {progress.step}; --resume resumes it", soft_wrap=True)
        sys.exit(130)


def commit() -> str:
    """The commit of this checkout, with + if files differ from it; the version if it is none."""
    folder = Path(__file__).resolve().parents[2]
    try:
        head, changes = (subprocess.run(["git", "-C", str(folder), *words], capture_output=True,
                                        text=True, check=True, timeout=20).stdout.strip()
                         for words in (("rev-parse", "HEAD"),
                                       ("status", "--porcelain", "--untracked-files=no")))
    except (OSError, subprocess.SubprocessError):
        return __version__
    return head + ("+" if changes else "")
