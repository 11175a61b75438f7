"""evaluate clusters: a cluster network's classes against labels, without ROS."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import numpy as np
from rich.console import Console

from lidar_perception.clustering.cluster import cluster_obstacles
from lidar_perception.data.kitti.folder import KittiFrame, open_kitti
from lidar_perception.ground.segment import segment_ground
from lidar_perception.runs.files import write_text
from lidar_perception.runs.terminal import console, track
from lidar_perception.scoring.points.clusters import (
    UNKNOWN,
    ClusterScores,
    labelled,
    point_labels,
    uncared,
    unknown_where,
)
from lidar_perception.scoring.tables import narrow_table, print_skipped
from lidar_perception.types import InputError

# Paper C: segmentation on KITTI, in percent
PAPER = {"accuracy": 94.96, "precision": 94.3, "recall": 93.5, "f1": 93.9, "iou": 92.12}


@click.command()
@click.option("--kitti", type=click.Path(path_type=Path), metavar="ROOT", required=True,
              help="KITTI folder: 3D object, tracking or raw.")
@click.option("--weights", type=click.Path(path_type=Path), metavar="FILE",
              help="Checkpoint of a cluster network. Default: the one that comes with the package.")
@click.option("--json", "json_file", type=click.Path(path_type=Path), metavar="FILE",
              help="Write the scores to this file.")
def clusters(kitti: Path, weights: Path | None, json_file: Path | None) -> None:
    """Classes that a cluster network (paper C) gives to clusters, and so to points.

    Clusters are made as the network asks for. One is an object if half of its points or more lie
    in the object's box, and background if less than 15 percent lie in any; the others, and Van,
    Truck, Tram, Person_sitting and what lies in a DontCare region, do not count. Only points in
    the image count, as labels end there.

    \b
    Example:
      lidar-perception evaluate clusters --kitti /data/kitti/object --json clusters.json
    """
    from lidar_perception.detectors.pointnet.checkpoint import load_pointnet
    from lidar_perception.detectors.pointnet.network import fused
    from lidar_perception.detectors.pointnet.weights_file import WEIGHTS
    _, network = load_pointnet(weights or WEIGHTS)
    frames = open_kitti(kitti)
    scores = ClusterScores(network.config.classes)
    for _ in track(_scored(frames, fused(network), scores), "evaluating", len(frames)):
        pass
    content = {"source": str(weights or "the package's own"), **scores.content()}
    if json_file:
        write_text(json_file, json.dumps(content, indent=1))
    if not scores.frames:
        reason = f" ({scores.skipped[0]})" if scores.skipped else ""
        raise InputError(f"{kitti}: no frame with labels{reason}")
    print_cluster_scores(content, console)


def _scored(frames: list[KittiFrame], network: Any, scores: ClusterScores) -> Iterator[None]:
    from lidar_perception.detectors.pointnet.clusters import clusters_of
    from lidar_perception.detectors.pointnet.predict import predict
    config = network.config
    for frame in frames:
        try:
            truth = frame.truth()
            scan = None if truth is None else frame.load()
        except InputError as error:
            scores.skipped.append(str(error))
            scan = None
        if scan is not None:
            ground = segment_ground(scan, config.ground)
            ids = cluster_obstacles(scan.xyz, ground, config.clustering)
            camera, background = frame.calibration().camera(), len(config.classes)
            places = np.flatnonzero(camera.in_view(scan.xyz))
            seen, ids = scan.take(places), ids[places]
            made = clusters_of(seen, ids, ground=ground[places])
            labels, _ = labelled(made, truth.boxes, truth.class_ids, config.classes)
            labels = unknown_where(labels, made, uncared(truth, camera, made.points[:, :3]),
                                   background)
            points = point_labels(seen.xyz, truth.boxes, truth.class_ids, config.classes)
            points[(points == background) & uncared(truth, camera, seen.xyz)] = UNKNOWN
            scores.add(made, labels, predict(network, made), points, ids)
        yield


def print_cluster_scores(content: dict[str, Any], out: Console) -> None:
    """The confusion of clusters, and the paper's figures."""
    names = content["classes"]
    rows = content["clusters"]
    table = narrow_table(f"Clusters of {content['least_points']} points or more, "
                         f"{content['frames']} frames", "is \\ found", *names, "recall", "prec.")
    for name, counts in zip(names, rows["confusion"]):
        row = rows["by_class"].get(name, {})
        table.add_row(name, *map(str, counts), _number(row.get("recall")),
                      _number(row.get("precision")))
    table.caption = (f"{_number(rows['accuracy'])} % of the clusters are of the class that the "
                     f"network says, {_number(rows['object_accuracy'])} % of the objects among "
                     "them.")
    out.print(table)
    table = narrow_table("Points in the image, in percent", "", "accuracy", "precision", "recall",
                         "F1", "IoU")
    points = content["points"]
    table.add_row("mean of the classes", _number(points["accuracy"]),
                  *(_number(points["mean"][key]) for key in ("precision", "recall", "f1", "iou")))
    for name, row in points["by_class"].items():
        table.add_row(f"  {name}", "", *(_number(row[key]) for key in
                                         ("precision", "recall", "f1", "iou")))
    table.add_row("paper C, KITTI", *(_number(value) for value in PAPER.values()), style="dim")
    table.caption = "The paper does not say how it counts points."
    out.print(table)
    print_skipped(content["skipped"], out)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"
