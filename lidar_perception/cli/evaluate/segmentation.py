"""evaluate segmentation: score ground segmentation and clustering, without ROS."""

from __future__ import annotations

from functools import partial
from typing import Any

import click

from lidar_perception.cli.command import Command
from lidar_perception.cli.data import (
    DATA_HELP,
    ScoringOptions,
    data_argument,
    make_no_labels_error,
    scoring_options,
    with_recorded_height,
)
from lidar_perception.cli.options import parameter_options
from lidar_perception.clustering.params import CLUSTERING_METHODS
from lidar_perception.ground.params import GROUND_METHODS
from lidar_perception.runs.terminal import console, errors
from lidar_perception.scoring.points.report import SegmentationParams
from lidar_perception.types import list_valid_names


class MethodList(click.ParamType):
    """Comma-separated names of methods."""

    name = "names"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple:
        names = value if isinstance(value, tuple) else tuple(str(value).split(","))
        methods = GROUND_METHODS + CLUSTERING_METHODS
        if unknown_names := [name for name in names if name not in methods]:
            self.fail(f"unknown method {unknown_names[0]!r}{list_valid_names(unknown_names[0], methods)}", param, ctx)
        return names


@click.command(cls=Command)
@scoring_options(data_argument(f"{DATA_HELP} May be repeated.", several=True))
@click.option(
    "--methods",
    type=MethodList(),
    default=GROUND_METHODS + CLUSTERING_METHODS,
    help="Comma-separated ground and clustering methods to score. Default: all.",
)
@parameter_options(
    SegmentationParams(), "segmentation", ("perception", "ground_segmentation", "clustering"), "ground.method=patchwork"
)
def segmentation(options: ScoringOptions, methods: tuple, params: SegmentationParams) -> None:
    """Score ground segmentation and clustering against labels.

    Ground methods are scored against the point classes of SemanticKITTI. Clustering methods run on
    the points that ground.method does not remove, and are scored against SemanticKITTI's instances
    or labelled boxes; with boxes and a camera calibration, only in the camera's view.

    \b
    Examples:
      lidar-perception evaluate segmentation /data/semantickitti
      lidar-perception evaluate segmentation /data/kitti/object \\
          --set ground.method=patchwork
      lidar-perception evaluate segmentation drive.bag --methods dbscan --json scores.json
    """
    from lidar_perception.data.frame import BOXES, POINT_LABELS
    from lidar_perception.scoring.points.report import SegmentationReport, measure_methods
    from lidar_perception.scoring.points.tables import print_scores

    ground_methods = tuple(name for name in GROUND_METHODS if name in methods)
    clustering_methods = tuple(name for name in CLUSTERING_METHODS if name in methods)
    # Open everything first, so that a typo in the last path does not cost an hour.
    recordings = [options.open_recording(None, path) for path in options.data]
    with_point_labels = [recording for recording in recordings if POINT_LABELS in recording.contents]
    for recording in recordings:
        if recording not in with_point_labels:
            recording.require(BOXES, "evaluate segmentation")
    if not (with_point_labels or clustering_methods):
        raise click.UsageError(
            "ground methods require labelled points: give SemanticKITTI, or choose a clustering method"
        )
    report = SegmentationReport()
    for recording in recordings:
        report.source = recording.layout
        recording_params = with_recorded_height(recording, params)
        options.fill(
            report,
            recording,
            partial(measure_methods, recording_params, ground_methods, clustering_methods),
            recording.layout,
        )
    if not (report.ground or report.clusters):
        raise make_no_labels_error(recordings[0], report.skipped)
    content = report.compute()
    if report.without_camera:
        errors.print(
            f"{', '.join(map(str, options.data))}: {report.without_camera} frames have no camera calibration; scored "
            "all around instead of in the camera's view"
        )
    print_scores(content, params.ground.method, console)
    options.write(content)
