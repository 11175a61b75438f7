"""seed: create a template of a seed pedestrian."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import click
import numpy as np

from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.pipeline import segment_cloud
from lidar_perception.candidates.seed_sources import make_click_source, make_truth_source
from lidar_perception.candidates.seeds import save_seed
from lidar_perception.candidates.silhouette import to_pixels
from lidar_perception.cli.command import Command
from lidar_perception.cli.data import data_argument, open_and_describe, out_file_option, with_recorded_height
from lidar_perception.cli.options import parameter_options
from lidar_perception.data.frame import Frame, Recording
from lidar_perception.runs.terminal import console
from lidar_perception.scoring.centres.report import load_pedestrians
from lidar_perception.types import InputError
from lidar_perception.wire.params import ViewParams


@click.command(cls=Command)
@data_argument()
@click.option(
    "--frame",
    "number",
    type=click.IntRange(0),
    metavar="N",
    help="Number of the frame; default: the first with a Pedestrian label.",
)
@click.option(
    "--at",
    "point",
    nargs=3,
    type=float,
    metavar="X Y Z",
    help="A point on the pedestrian, in the LiDAR frame; default: the nearest label.",
)
@out_file_option("--out", "Template to write.", required=True)
@parameter_options(PipelineParams(view=ViewParams(enabled=True)))
def seed(
    data: Path, number: int | None, point: tuple[float, float, float] | None, out: Path, params: PipelineParams
) -> None:
    """Save the silhouette and height of one pedestrian as a template for later runs.

    Use it with --set seed.source=file --set seed.file=OUT, or with these parameters of the nodes.

    \b
    Examples:
      lidar-perception seed /data/kitti/object --out pedestrian.json
      lidar-perception seed drive --frame 40 --at 18.0 8.6 -0.9 --out pedestrian.json
    """
    recording = open_and_describe(data)
    params = with_recorded_height(recording, params)
    frame = _choose_frame(recording, number, params.view, point is None)
    camera = frame.camera()
    if camera is None:
        params = replace(params, view=ViewParams(enabled=False))
    segmented = segment_cloud(frame.load(), camera, params)
    source = (
        make_click_source(np.array(point), params.seed)
        if point is not None
        else make_truth_source(load_pedestrians(frame, params.view.enabled))
    )
    (template,) = source(segmented)
    save_seed(template, out)
    for row in to_pixels(template.draw_silhouette(params))[::2]:
        console.print("".join(".#"[bit] for bit in row.astype(int)))
    console.print(f"{out}: frame {frame.name}, height {template.height:.2f} m")


def _choose_frame(recording: Recording, number: int | None, view: ViewParams, needs_label: bool) -> Frame:
    for i, frame in enumerate(recording):
        if i == number:
            return frame
        with suppress(InputError):
            if number is None and (not needs_label or len(load_pedestrians(frame, view.enabled))):
                return frame
    raise InputError(
        f"{recording.path} has only {len(recording)} frames, so no frame {number}; the first is frame 0"
        if number is not None
        else f"{recording.path} has no Pedestrian label; give --frame and --at"
    )
