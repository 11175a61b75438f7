"""evaluate segmentation: scores of ground and clusters, without ROS."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from time import perf_counter
from typing import Any

import click
import numpy as np
from rich.markup import escape

from lidar_perception.candidates.segmented import points_in_view
from lidar_perception.cli.options import parameter_options
from lidar_perception.clustering.cluster import cluster_obstacles
from lidar_perception.clustering.params import CLUSTERING_METHODS, ClusteringParams
from lidar_perception.data.recording import Recording, open_recording
from lidar_perception.data.semantickitti import SemanticFrame, open_semantic_kitti
from lidar_perception.ground.params import GROUND_METHODS, GroundParams
from lidar_perception.ground.segment import segment_ground
from lidar_perception.runs.files import write_text
from lidar_perception.runs.terminal import console, errors, track
from lidar_perception.scoring.points.segmentation import (
    ClusterReport,
    GroundReport,
    Objects,
    objects_in_boxes,
    objects_of_instances,
)
from lidar_perception.scoring.points.tables import draw_ground, print_scores
from lidar_perception.types import InputError, LidarFrame
from lidar_perception.wire.params import ViewParams


@dataclass(frozen=True)
class SegmentationParams:
    """The groups that matter here."""

    view: ViewParams
    ground: GroundParams
    clustering: ClusteringParams


# The camera's view is on: KITTI has labels there only.
DEFAULTS = SegmentationParams(ViewParams(enabled=True), GroundParams(), ClusteringParams())


@dataclass
class Scores:
    """What was measured: ground by method, clusters by source and method, frames left out; the
    first scan with its ground, for the picture."""

    ground: dict[str, GroundReport] = field(default_factory=dict)
    clusters: dict[str, dict[str, ClusterReport]] = field(default_factory=dict)
    skipped: list[str] = field(default_factory=list)
    scan: tuple[str, LidarFrame, np.ndarray, dict[str, np.ndarray]] | None = None

    def content(self) -> dict:
        """What the JSON file holds."""
        return {"ground": {name: report.content() for name, report in self.ground.items()},
                "clusters": {source: {name: report.content() for name, report in reports.items()}
                             for source, reports in self.clusters.items()},
                "skipped": self.skipped}


class MethodList(click.ParamType):
    """Comma-separated names of methods."""

    name = "names"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple:
        names = value if isinstance(value, tuple) else tuple(str(value).split(","))
        known = GROUND_METHODS + CLUSTERING_METHODS
        if unknown := [name for name in names if name not in known]:
            self.fail(f"{unknown[0]!r} is no method; known are {', '.join(known)}", param, ctx)
        return names


@click.command()
@click.option("--semantic-kitti", type=click.Path(path_type=Path), metavar="ROOT",
              help="SemanticKITTI folder, with sequences/: ground and clusters.")
@click.option("--kitti", type=click.Path(path_type=Path), metavar="ROOT",
              help="KITTI folder, 3D object, tracking or raw: clusters.")
@click.option("--bag", type=click.Path(path_type=Path), help="Bag with ground truth: clusters.")
@click.option("--methods", type=MethodList(), default=GROUND_METHODS + CLUSTERING_METHODS,
              help="Methods to score, of ground and of clustering, separated by commas. "
              "Default: all.")
@click.option("--limit", type=click.IntRange(min=1), metavar="N",
              help="Only the first N frames of each source.")
@click.option("--json", "json_file", type=click.Path(path_type=Path), metavar="FILE",
              help="Write the scores to this file.")
@click.option("--png", type=click.Path(path_type=Path), metavar="FILE",
              help="Draw the ground of the first SemanticKITTI scan from above.")
@parameter_options(DEFAULTS)
def segmentation(semantic_kitti: Path | None, kitti: Path | None, bag: Path | None, methods: tuple,
                 limit: int | None, json_file: Path | None, png: Path | None,
                 params: SegmentationParams) -> None:
    """Ground and clusters against labels.

    Ground: each method against the classes of SemanticKITTI's points. Clusters: each method, on
    what --ground-method leaves, against SemanticKITTI's instances or labelled boxes; with boxes,
    only the points in the camera's view where there is a calibration.

    \b
    Examples:
      lidar-perception evaluate segmentation --semantic-kitti /data/semantickitti --png ground.png
      lidar-perception evaluate segmentation --kitti /data/kitti/object --ground-method patchwork
      lidar-perception evaluate segmentation --bag drive.bag --methods dbscan --json scores.json
    """
    if semantic_kitti is None and kitti is None and bag is None:
        raise click.UsageError("give at least one of --semantic-kitti ROOT, --kitti ROOT and "
                               "--bag FILE")
    grounds = [name for name in GROUND_METHODS if name in methods]
    clusterings = [name for name in CLUSTERING_METHODS if name in methods]
    if png is not None and not (semantic_kitti and grounds):
        raise click.UsageError("--png draws the ground of a SemanticKITTI scan: give "
                               "--semantic-kitti ROOT and a method of ground")
    if not (semantic_kitti or clusterings):
        raise click.UsageError("ground is scored on SemanticKITTI only: give --semantic-kitti ROOT "
                               "or a method of clustering")
    # Everything is opened first: a typing error in the last path should not cost an hour.
    scans = open_semantic_kitti(semantic_kitti)[:limit] if semantic_kitti else []
    recordings = {name: open_recording(**{name: path})
                  for name, path in (("kitti", kitti), ("bag", bag)) if path and clusterings}
    scores = Scores()
    if scans:
        for _ in track(score_scans(scans, params, grounds, clusterings, scores),
                       "SemanticKITTI", len(scans)):
            pass
    for source, recording in recordings.items():
        count = min(recording.count, limit or recording.count)
        for _ in track(score_boxes(source, recording, limit, params, clusterings, scores),
                       str(recording.path), count):
            pass
    content = scores.content()
    if json_file:
        write_text(json_file, json.dumps(content, indent=1))
    if not (scores.ground or scores.clusters):
        path = next(str(p) for p in (semantic_kitti, kitti, bag) if p)
        reason = f" ({scores.skipped[0]})" if scores.skipped else ""
        raise InputError(f"{path}: no frame with labels{reason}")
    print_scores(content, params.ground.method, console)
    if png is not None and scores.scan is not None:
        draw_ground(png, *scores.scan)
        console.print(f"picture: {png}")


def score_scans(scans: Iterable[SemanticFrame], params: SegmentationParams, grounds: list[str],
                clusterings: list[str], scores: Scores) -> Iterator[None]:
    """Score ground and clusters of SemanticKITTI scans; yields after every scan."""
    for scan in scans:
        try:
            frame, semantic, instance = scan.load()
        except InputError as error:
            scores.skipped.append(str(error))
            yield
            continue
        found = {}
        for name in grounds:
            report = scores.ground.setdefault(name, GroundReport())
            found[name], ms = _timed(segment_ground, frame, replace(params.ground, method=name),
                                     first=not report.ms)
            report.add(found[name], semantic, frame.xyz[:, 2], ms)
        scores.scan = scores.scan or (scan.name, frame, semantic, found)
        if clusterings:
            ground = found.get(params.ground.method)
            if ground is None:
                ground = segment_ground(frame, params.ground)
            _score_clusters("semantic_kitti", frame.xyz, ground, params, clusterings,
                            objects_of_instances(frame.xyz, semantic, instance), scores)
        yield


def score_boxes(source: str, recording: Recording, limit: int | None, params: SegmentationParams,
                clusterings: list[str], scores: Scores) -> Iterator[None]:
    """Score clusters of frames with labelled boxes; yields after every frame. A frame without a
    camera is taken as a whole."""
    whole = 0
    for recorded in islice(recording, limit):
        if isinstance(recorded, InputError):
            scores.skipped.append(str(recorded))
        elif recorded.truth is not None:
            frame = recorded.frame
            if recorded.camera is not None:
                _, frame = points_in_view(frame, recorded.camera, params.view)
            whole += recorded.camera is None
            _score_clusters(source, frame.xyz, segment_ground(frame, params.ground), params,
                            clusterings, objects_in_boxes(frame.xyz, recorded.truth), scores)
        yield
    if whole and params.view.enabled:
        errors.print(f"{escape(str(recording.path))}: {whole} frames without a camera calibration "
                     "were taken as a whole")


def _score_clusters(source: str, xyz: np.ndarray, ground: np.ndarray, params: SegmentationParams,
                    clusterings: list[str], objects: Objects, scores: Scores) -> None:
    for name in clusterings:
        report = scores.clusters.setdefault(source, {}).setdefault(name, ClusterReport())
        cluster_ids, ms = _timed(cluster_obstacles, xyz, ground,
                                 replace(params.clustering, method=name), first=not report.ms)
        report.add(cluster_ids, objects, ms)


def _timed(function: Callable, *arguments: Any, first: bool) -> tuple[Any, float]:
    """The result and the milliseconds; the first time after a run that loads compiled code."""
    if first:
        function(*arguments)
    start = perf_counter()
    result = function(*arguments)
    return result, (perf_counter() - start) * 1e3
