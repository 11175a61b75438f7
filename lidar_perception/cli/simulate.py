"""simulate: write simulated, labelled scans."""

from __future__ import annotations

import shlex
from contextlib import closing
from pathlib import Path

import click

from lidar_perception import __version__
from lidar_perception.cli.command import Choice, Command
from lidar_perception.cli.data import out_folder_option, simulated_height_option
from lidar_perception.data.to_bag import write_bag
from lidar_perception.labels.names import ALIASES
from lidar_perception.runs.compiling import report_compilation
from lidar_perception.runs.machine import count_cores
from lidar_perception.runs.resumable_folder import is_finished, make_resumable_folder
from lidar_perception.runs.resuming import hash_names
from lidar_perception.runs.terminal import console, show_progress
from lidar_perception.simulation.dataset import FOLDERS, LAYOUTS, DatasetPlan, write_frames
from lidar_perception.simulation.drive import count_drive_scans
from lidar_perception.simulation.recording import simulate_frames
from lidar_perception.simulation.scene import MAX_PEOPLE, SCENE_TYPES, Scenes
from lidar_perception.simulation.sensor import GENERIC_FORMAT, SENSOR_NAMES, find_sensor
from lidar_perception.types import InputError


@click.command(cls=Command)
@out_folder_option("Bag or folder to create.", required=True)
@click.option(
    "--format",
    "--to",
    "layout",
    type=Choice(["mcap", *LAYOUTS], ALIASES),
    default="mcap",
    show_default=True,
    help="A rosbag2 bag, or the folders of one of these data sets.",
)
@click.option(
    "--sensor",
    "sensor_name",
    default="hdl64e",
    show_default=True,
    help=f"One of {', '.join(SENSOR_NAMES)}, in any spelling (hdl64e is hdl-64e), a "
    f".yaml file (`setup` writes one), or {GENERIC_FORMAT}.",
)
@simulated_height_option
@click.option("--frames", type=click.IntRange(1), default=40, show_default=True, help="Number of scans.")
@click.option(
    "--seed",
    type=click.IntRange(0),
    default=1,
    show_default=True,
    help="Seed of the first street; the same seed gives the same bytes.",
)
@click.option(
    "--scene",
    default="street",
    show_default=True,
    metavar="NAME",
    help=f"One of {', '.join(SCENE_TYPES)}, or several that alternate, such as street,campus.",
)
@click.option(
    "--kind",
    "--street",
    "kind",
    metavar="KIND",
    help="Scenes of this kind only: "
    + "; ".join(f"{name} {', '.join(scene_type.kinds)}" for name, scene_type in SCENE_TYPES.items())
    + ". Default: all.",
)
@click.option(
    "--people",
    type=click.FloatRange(0, MAX_PEOPLE),
    default=1.0,
    show_default=True,
    help="Number of pedestrians and cyclists relative to the default, which on streets is as many as in KITTI.",
)
@click.option(
    "--streets-of",
    type=click.IntRange(1),
    metavar="N",
    help="Scans of each street. Default: 1 for kitti, a drive of 20 s for the others.",
)
@click.option(
    "--jobs", type=click.IntRange(1), help="Processes that write the folders of a data set. Default: one per core."
)
@click.option("--resume", is_flag=True, help="Resume an unfinished data set; needs identical settings.")
@click.option("--force", is_flag=True, help="Replace an earlier simulated data set in --out.")
@report_compilation()
def simulate(
    out: Path,
    layout: str,
    sensor_name: str,
    frames: int,
    seed: int,
    scene: str,
    kind: str | None,
    people: float,
    mount_height: float,
    streets_of: int | None,
    jobs: int | None,
    resume: bool,
    force: bool,
) -> None:
    """Write labelled scans of simulated streets, campuses or interiors as a bag or data set.

    A file named INCOMPLETE marks an unfinished data set, which --resume completes.

    \b
    Examples:
      lidar-perception simulate --frames 100 --seed 4 --out drive
      lidar-perception simulate --format kitti --frames 1000 --out training_data
      lidar-perception simulate --scene campus --sensor vlp-16 --mount-height 0.6 --out robot
    """
    scenes = Scenes(kind, people, scene)
    if resume and force:
        raise click.UsageError("--resume and --force cannot be combined; --force starts over")
    sensor = find_sensor(sensor_name, mount_height)
    plan = DatasetPlan(
        layout, sensor, seed, frames, streets_of or (1 if layout == "kitti" else count_drive_scans(sensor)), scenes
    )
    if layout == "mcap":
        if resume:
            raise click.UsageError(
                "a bag cannot be resumed; simulate kitti-tracking instead and convert it to a bag with 'convert'"
            )
        _write_bag(out, plan, force)
    else:
        _write_dataset(out, plan, sensor_name, mount_height, jobs or count_cores(), resume, force)


def _write_bag(out: Path, plan: DatasetPlan, force: bool) -> None:
    scans = simulate_frames(plan.seed, plan.frames, plan.sensor, plan.frames_per_drive, plan.scenes)
    count = write_bag(out, show_progress(scans, "simulating", plan.frames), force=force)
    console.print(f"{out}: {count} scans")


def _write_dataset(
    out: Path, plan: DatasetPlan, sensor_name: str, mount_height: float, jobs: int, resume: bool, force: bool
) -> None:
    scenes = plan.scenes
    settings = {
        "format": plan.layout,
        "sensor": sensor_name,
        "height": plan.sensor.height,
        "sensor_digest": hash_names([repr(plan.sensor)]),
        "seed": plan.seed,
        "frames": plan.frames,
        "scene": scenes.scene,
        "street": scenes.kind,
        "people": scenes.people,
        "streets_of": plan.frames_per_drive,
        "version": __version__,
    }
    options = {
        "format": plan.layout,
        "sensor": sensor_name,
        "mount-height": mount_height or None,
        "seed": plan.seed,
        "frames": plan.frames,
        "scene": scenes.scene,
        "people": scenes.people,
        "streets-of": plan.frames_per_drive,
        "street": scenes.kind,
    }
    settings["command"] = shlex.join(
        [
            "lidar-perception",
            "simulate",
            *(word for name, value in options.items() if value is not None for word in (f"--{name}", str(value))),
        ]
    )
    was_complete, has_started = resume and is_finished(out), False
    try:
        with make_resumable_folder(out, settings, FOLDERS, resume=resume, force=force) as missing_frames:
            has_started = True
            with closing(write_frames(out, plan, missing_frames, jobs)) as written_frames:
                for _ in show_progress(written_frames, "simulating", len(missing_frames)):
                    pass
    except InputError as error:
        if not has_started:
            raise
        raise InputError(f"{error}; finished frames are kept, so continue with --resume") from None
    console.print(
        f"{out} is already complete"
        if was_complete
        else f"{out}: {plan.frames} scans"
        + (f", {plan.frames - len(missing_frames)} of them from the interrupted run" if resume else "")
    )
