"""evaluate clusters: score the classes that PointNet assigns, without ROS."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import click

from lidar_perception.cli.command import Command
from lidar_perception.cli.data import ScoringOptions, make_no_labels_error, path_option, scoring_options
from lidar_perception.cli.options import Algorithm, Settings, apply_values, settings_options
from lidar_perception.detectors.open import POINTNET, make_default_params, resolve_weights
from lidar_perception.detectors.weights_file import POINTNET_WEIGHTS
from lidar_perception.param_fields import collect_fields
from lidar_perception.runs.terminal import console
from lidar_perception.types import InputError


def _find_checkpoint(weights: Path | None) -> Path:
    """Return the checkpoint of --weights. Raise InputError if it is not a PointNet checkpoint."""
    network, path = (POINTNET, None) if weights is None else resolve_weights(weights)
    if network != POINTNET:
        raise InputError(f"{weights} is a {network} checkpoint; give a {POINTNET} checkpoint")
    return path or POINTNET_WEIGHTS


def _make_algorithm(weights: Path | None) -> Algorithm:
    """Return the ground and clustering parameters that the network was trained with."""
    fields = collect_fields(make_default_params(_find_checkpoint(weights)))
    return Algorithm(
        "ground and clustering",
        {name: f for name, f in fields.items() if name.startswith(("ground.", "clustering."))},
        ("pointnet_detector",),
    )


@click.command(cls=Command)
@scoring_options()
@path_option("--weights", "Checkpoint of PointNet. Default: the shipped one.")
@settings_options(lambda options: [_make_algorithm(options.get("weights"))], "clustering.density=0")
def clusters(options: ScoringOptions, weights: Path | None, settings: Settings) -> None:
    """Score the classes that PointNet assigns to clusters and points.

    Clusters are computed as in training, unless --config or --set change this. A cluster is an
    object if at least half of its points are in the object's box, and background if less than 15
    percent are in any box. Other clusters are ignored, and so are Van, Truck, Tram, Person_sitting
    and DontCare regions. With a camera, only points in the image are scored, because KITTI labels
    only those.

    \b
    Example:
      lidar-perception evaluate clusters /data/kitti/object --json clusters.json
    """
    from lidar_perception.data.frame import BOXES
    from lidar_perception.detectors.checkpoint import read_header
    from lidar_perception.detectors.pointnet.config import PointNetConfig
    from lidar_perception.scoring.points.cluster_tables import print_cluster_scores
    from lidar_perception.scoring.points.clusters import ClusterScores, measure_network

    file = _find_checkpoint(weights)
    (values,) = settings.resolve(_make_algorithm(weights)) if settings else [{}]
    apply_values(make_default_params(file), values)
    scores = ClusterScores(read_header(file, PointNetConfig).config.classes)
    recording = options.open_recording(BOXES)
    options.fill(scores, recording, partial(measure_network, file, values))
    if not scores.frames:
        raise make_no_labels_error(recording, scores.skipped)
    content = {"source": str(weights or "the package's own"), **scores.compute()}
    print_cluster_scores(content, console)
    options.write(content)
