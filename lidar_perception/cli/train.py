"""train: networks from labelled or simulated scenes."""

from __future__ import annotations

import functools
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import click

from lidar_perception import __version__
from lidar_perception.cli.data import a_path, device_option
from lidar_perception.cli.options import parameter_options
from lidar_perception.runs.terminal import console
from lidar_perception.training.params import PointNetTraining, PointPillarsTraining

PAPER_ABLATION = (75.52, 80.15, 81.33, 83.44, 85.10, 86.33, 86.89, 88.96)  # paper C, Table 5

OPTIONS = (
    click.option("--data", multiple=True, required=True, metavar="PATH|sim",
                 help="What to train on: a data set or bag, or `sim` for simulated streets; may be "
                 "repeated to mix them."),
    click.option("--val", multiple=True, metavar="PATH|sim",
                 help="What to validate on. Default: frames held out of --data, and other "
                 "simulated streets."),
    a_path("--split", "Train on the frames of --data, or whole sequences, that are named in this "
           "file, one a line."),
    a_path("--val-split", "Likewise the frames to validate on."),
    a_path("--out", "Folder for best.safetensors, last.safetensors, logs and the state.", "DIR",
           required=True),
    click.option("--resume", is_flag=True, help="Resume the run in --out, if there is one."),
    a_path("--init", "Start from the weights of this checkpoint, as far as they fit."),
    device_option,
    click.option("--jobs", type=click.IntRange(0), default=2, show_default=True,
                 help="Processes that prepare scenes; 0: only this one. The result is the same."),
)


@dataclass(frozen=True)
class Asked:
    """What every network is told: what to train and to validate on, and where the run goes."""

    data: tuple[str, ...]
    val: tuple[str, ...]
    split: Path | None
    val_split: Path | None
    out: Path
    resume: bool
    init: Path | None
    device: str
    jobs: int

    def scenes(self, params: Any) -> tuple[tuple, tuple]:
        """Sources to train on and to validate on."""
        from lidar_perception.training.sources import training_scenes
        return training_scenes(self.data, self.val, self.split, self.val_split, params.data,
                               params.seed)

    def train(self, make_task: Callable, config: Any, params: Any, stream: Any, held_out: Any,
              out: Path, device: Any) -> None:
        """Train a network on a stream of samples and say how it ended. make_task: the one of its
        room; held_out: ReadScenes."""
        from lidar_perception.training.data import Batches
        from lidar_perception.training.loop import train
        from lidar_perception.training.ranks import rank, world
        from lidar_perception.training.sources import about_data
        batches = Batches(stream, params.batch, self.jobs, rank(), world())
        about = about_data(self.data, self.val, stream, held_out.sources, self.init)
        task = make_task(config, params, batches, held_out, out, device, about, commit(), self.init)
        progress = train(task, params, out, device, self.resume)
        if rank() == 0:
            tell(progress, batches, out)


def shared_options(function: Callable) -> Callable:
    """Decorator: the options that all networks share, which the function gets as asked=Asked()."""
    @functools.wraps(function)
    def wrapper(*args: Any, **kwargs: Any) -> Any:
        asked = Asked(**{f.name: kwargs.pop(f.name) for f in fields(Asked)})
        return function(*args, asked=asked, **kwargs)

    for option in reversed(OPTIONS):
        wrapper = option(wrapper)
    return wrapper


@click.group()
def train() -> None:
    """Train a network."""


@train.command()
@shared_options
@parameter_options(PointPillarsTraining())
def pointpillars(asked: Asked, params: PointPillarsTraining) -> None:
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
    from lidar_perception.training.data import ReadScenes, Stream, some_scenes
    from lidar_perception.training.loop import may_begin
    from lidar_perception.training.pointpillars.task import (
        Preparation,
        frame_to_validate,
        make_task,
        narrowed,
    )
    from lidar_perception.training.ranks import joined, rank, wait
    may_begin(asked.out, asked.resume)
    config, wanted, database = network_config(params.version, params.size), params.augment, None
    sources, held_out = asked.scenes(params)
    with joined(chosen_device(asked.device)) as device:
        if wanted.database_scans and wanted.crowded and (
                wanted.cars or wanted.pedestrians or wanted.cyclists or wanted.things):
            database = asked.out / "objects.npz"
            if rank() == 0 and not (asked.resume and database.is_file()):
                scenes = some_scenes(sources, wanted.database_scans, params.seed, asked.jobs)
                cut_objects(scenes, config.classes, params.data.min_points).save(database)
            wait()
        prepare = Preparation(narrowed(config, params.ahead, params.aside), wanted,
                              params.data.min_points, database)
        asked.train(make_task, config, params, Stream(sources, prepare, params.seed),
                    ReadScenes(held_out, frame_to_validate), asked.out, device)


@train.command()
@shared_options
@click.option("--ablation", is_flag=True, help="Train every row of the paper's ablation, each into "
              "a folder in --out, and compare them.")
@parameter_options(PointNetTraining())
def pointnet(asked: Asked, ablation: bool, params: PointNetTraining) -> None:
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
    from lidar_perception.detectors.pointnet.config import ABLATIONS, pointnet_config
    from lidar_perception.runs.files import make_folder
    from lidar_perception.training.data import ReadScenes, Stream
    from lidar_perception.training.loop import may_begin
    from lidar_perception.training.pointnet.cut_scenes import CutScenes
    from lidar_perception.training.pointnet.task import (
        ClusterPreparation,
        clusters_to_validate,
        make_task,
    )
    from lidar_perception.training.ranks import joined, rank
    make_folder(asked.out)  # or say that it cannot be, before the data are prepared
    scenes = asked.scenes(params)
    cache = Path(params.data.cache) / "clusters" if params.data.cache else None
    with joined(chosen_device(asked.device)) as device:
        for name in ABLATIONS if ablation else (params.network,):
            out = asked.out / name if ablation else asked.out
            if rank() == 0 and ablation:
                console.print(f"{name}:", style="bold")
            may_begin(out, asked.resume)
            config = pointnet_config(name)
            sources, held_out = (tuple(CutScenes(source, config, params.data.min_points, cache)
                                       for source in part) for part in scenes)
            prepare = ClusterPreparation(config, params.augment)
            asked.train(make_task, config, replace(params, network=name),
                        Stream(sources, prepare, params.seed),
                        ReadScenes(held_out, clusters_to_validate), out, device)
        if ablation and rank() == 0:
            print_ablation(asked.out)


def print_ablation(out: Path) -> None:
    """The best of each row beside the paper's mAP on KITTI (Table 5)."""
    from lidar_perception.detectors.checkpoint import read_header
    from lidar_perception.detectors.pointnet.config import ABLATIONS
    from lidar_perception.scoring.tables import narrow_table, number
    table = narrow_table("Ablation, simulated or KITTI frames validated on", "network", "paper mAP",
                         "AP from above", "accuracy", "of objects")
    for name, paper in zip(ABLATIONS, PAPER_ABLATION):
        metrics = read_header(out / name / "best.safetensors").metrics
        table.add_row(name, f"{paper:.2f}", *(number(metrics.get(key), digits=1) for key in
                                              ("score", "accuracy", "object_accuracy")))
    table.caption = ("AP from above: mean of Car, Pedestrian and Cyclist at the overlaps 0.5 / "
                     "0.25 / 0.25, moderate, R40; best weights of each run.")
    console.print(table)


def tell(progress: Any, batches: Any, out: Path) -> None:
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
