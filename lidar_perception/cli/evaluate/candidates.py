"""evaluate candidates: score pedestrian candidates by the STM-CPA paper's protocol, without ROS."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import click

from lidar_perception.candidates.configurations import PAPER
from lidar_perception.candidates.params import PipelineParams
from lidar_perception.cli.command import Command
from lidar_perception.cli.data import (
    ScoringOptions,
    no_labels_error,
    out_file_option,
    scoring_options,
    with_recorded_height,
)
from lidar_perception.cli.options import parameter_options
from lidar_perception.param_fields import with_values
from lidar_perception.runs.terminal import console, errors


def with_recorded_setup(recording: Any, params: PipelineParams) -> PipelineParams:
    """Return params with the sensor height of the recording (see with_recorded_height).

    Without a camera calibration, turns off the crop to the camera's view and prints a note.
    """
    from lidar_perception.data.frame import CAMERA

    params = with_recorded_height(recording, params)
    if params.view.enabled and CAMERA not in recording.contents:
        errors.print(f"{recording.path} has no camera calibration: processing the full scan")
        return with_values(params, {"view.enabled": False})
    return params


@click.command(cls=Command)
@scoring_options()
@out_file_option("--png", "Draw a bird's-eye view of the frame with the most pedestrians.")
@parameter_options(PAPER)
def candidates(options: ScoringOptions, png: Path | None, params: PipelineParams) -> None:
    """Score the pedestrian candidates of the STM-CPA paper against Pedestrian labels.

    The paper's protocol unless --config or --set change it: frames with a pedestrian, points in the
    camera's view, the nearest labelled pedestrian as seed, hits within 1.0 m of the 3D centre.

    \b
    Examples:
      lidar-perception evaluate candidates /data/kitti/object --json scores.json
      lidar-perception evaluate candidates drive.bag --config best --set seed.source=file
    """
    from lidar_perception.data.frame import BOXES
    from lidar_perception.scoring.centres.report import CandidateReport, measure_candidates
    from lidar_perception.scoring.centres.tables import print_candidate_report

    recording = options.open_recording(BOXES)
    params = with_recorded_setup(recording, params)
    if params.seed.source == "click":
        raise click.UsageError("seed.source=click requires user input; use --set seed.source=file")
    report = CandidateReport()
    options.fill(report, recording, partial(measure_candidates, params))
    if report.frames == 0:
        raise no_labels_error(recording, report.skipped, "a Pedestrian label")
    content = report.compute()
    print_candidate_report(content, console)
    options.write(content)
    if png is not None:
        _draw_most_crowded(png, recording, report, params)


def _draw_most_crowded(png: Path, recording: Any, report: Any, params: PipelineParams) -> None:
    """Draw the frame with the most pedestrians among those with candidates."""
    from lidar_perception.candidates.pipeline import find_candidates
    from lidar_perception.candidates.seeds import load_seeds
    from lidar_perception.rendering.colors import color_by_cluster
    from lidar_perception.rendering.files import write_png
    from lidar_perception.rendering.picture import Boxes, Stage, draw_frame
    from lidar_perception.scoring.centres.report import load_pedestrians, make_seed_source
    from lidar_perception.types import PointCloud

    _, frame_name = report.most_crowded
    if frame_name is None:
        return
    templates = None if params.seed.source == "ground_truth" else load_seeds(params.seed.file)
    frame = next(frame for frame in recording if frame.name == frame_name)
    truth = load_pedestrians(frame, params.view.enabled)
    scan = frame.load()
    segmented, candidates = find_candidates(scan, make_seed_source(truth, templates, params), frame.camera(), params)
    stage = Stage.of(scan, params.ground.sensor_pose.height, params.view.enabled)
    write_png(
        png,
        draw_frame(
            stage,
            PointCloud(segmented.xyz),
            Boxes(candidates.final.boxes, candidates.final.class_ids),
            truth,
            f"frame {frame.name}",
            colors=color_by_cluster(segmented.ground, segmented.cluster_ids),
        ),
    )
    console.print(f"picture: {png}")
