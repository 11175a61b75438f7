"""evaluate: scores without ROS."""

from __future__ import annotations

import json
from pathlib import Path

import click

from lidar_perception.candidates.configurations import PAPER
from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.warm_up import warm_up
from lidar_perception.cli.clusters import clusters
from lidar_perception.cli.detection import detection
from lidar_perception.cli.nuscenes import nuscenes
from lidar_perception.cli.options import parameter_options
from lidar_perception.cli.segmentation import segmentation
from lidar_perception.data.bag import Bag
from lidar_perception.data.recording import open_recording
from lidar_perception.param_fields import with_values
from lidar_perception.runs.files import write_text
from lidar_perception.runs.terminal import console, errors, track
from lidar_perception.scoring.centres.report import CandidateReport, pedestrians
from lidar_perception.scoring.centres.report import evaluate as evaluate_frames
from lidar_perception.scoring.centres.tables import print_candidate_report
from lidar_perception.types import InputError
from lidar_perception.wire.topics import CAMERA_INFO, EXTRINSICS


def view_as_recorded(bag: Path, params: PipelineParams) -> PipelineParams:
    """params with the crop to the camera off, and a note, if the bag has no camera calibration."""
    with Bag(bag) as opened:
        if params.view.enabled and not {CAMERA_INFO, EXTRINSICS} <= set(opened.topics):
            errors.print(f"{bag} has no camera calibration: the whole scan is processed")
            return with_values(params, {"view.enabled": False})
    return params


@click.group()
def evaluate() -> None:
    """Score the algorithms without ROS."""


@evaluate.command()
@click.option("--kitti", type=click.Path(path_type=Path), metavar="ROOT",
              help="KITTI folder: 3D object, tracking or raw.")
@click.option("--bag", type=click.Path(path_type=Path), help="Bag with ground truth.")
@click.option("--json", "json_file", type=click.Path(path_type=Path), metavar="FILE",
              help="Write the scores to this file.")
@click.option("--png", type=click.Path(path_type=Path), metavar="FILE",
              help="Draw the frame with the most pedestrians from above.")
@parameter_options(PAPER)
def candidates(kitti: Path | None, bag: Path | None, json_file: Path | None, png: Path | None,
               params: PipelineParams) -> None:
    """Pedestrian candidates of paper A (STM-CPA) against the Pedestrian labels.

    The paper's protocol unless flags say otherwise: frames with a pedestrian, points in the
    camera's view, the nearest labelled pedestrian as seed, hits within 1.0 m of the 3D centre.

    \b
    Examples:
      lidar-perception evaluate candidates --kitti /data/kitti/object --json scores.json
      lidar-perception evaluate candidates --bag drive.bag --seed-source file
    """
    if (kitti is None) == (bag is None):
        raise click.UsageError("give either --kitti ROOT or --bag FILE")
    recording = open_recording(kitti=kitti, bag=bag)
    if bag is not None:
        params = view_as_recorded(bag, params)
    if params.seed.source == "click":
        raise click.UsageError("there is nobody to click here; use --seed-source file")
    warm_up()
    report, best = CandidateReport(), None
    for item in track(evaluate_frames(recording, params, report), "evaluating", recording.count):
        if item is not None and png is not None:
            count = len(report.truth[-1])
            best = (count, *item) if best is None or count > best[0] else best
    content = report.content()
    if json_file:
        write_text(json_file, json.dumps(content, indent=1))
    if report.frames == 0:
        reasons = f" ({report.skipped[0]})" if report.skipped else ""
        raise InputError(f"{recording.path}: no frame with a Pedestrian label{reasons}")
    print_candidate_report(content, console)
    if best is not None:
        from lidar_perception.scoring.pictures import draw_frame
        _, recorded, segmented, found = best
        draw_frame(png, segmented.xyz, segmented.ground, segmented.cluster_ids,
                   pedestrians(recorded), found.final.boxes, title=f"frame {recorded.name}")
        console.print(f"picture: {png}")


evaluate.add_command(clusters)
evaluate.add_command(detection)
evaluate.add_command(nuscenes)
evaluate.add_command(segmentation)
