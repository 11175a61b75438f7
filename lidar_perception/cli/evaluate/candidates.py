"""evaluate candidates: score pedestrian candidates by the STM-CPA paper's protocol, without ROS."""

from __future__ import annotations

from functools import partial
from typing import Any

import click

from lidar_perception.candidates.configurations import PAPER
from lidar_perception.candidates.params import PipelineParams
from lidar_perception.cli.command import Command
from lidar_perception.cli.data import ScoringOptions, make_no_labels_error, scoring_options, with_recorded_height
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
@parameter_options(PAPER)
def candidates(options: ScoringOptions, params: PipelineParams) -> None:
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
        raise make_no_labels_error(recording, report.skipped, "a Pedestrian label")
    content = report.compute()
    print_candidate_report(content, console)
    options.write(content)
