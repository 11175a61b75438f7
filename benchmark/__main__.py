"""lidar benchmark: our candidate pipeline beside a plain reading of paper A, each algorithm beside
its peers, every version of EG-PointPillars, and the graph of nodes over DDS, in one run on one
machine."""

from __future__ import annotations

import json
import os
import platform
from pathlib import Path

import click
import numpy as np

from benchmark import clustering, ground, peers
from benchmark.candidates import compare, print_comparison
from benchmark.detection import measure_detection, print_detection
from benchmark.graph import measure_graph, print_graph
from benchmark.pointnet import measure_pointnet, print_pointnet
from benchmark.rows import print_ground, print_measured, print_planes
from benchmark.simulation import measure_simulation
from benchmark.timing import spread
from lidar_perception.candidates.segmented import points_in_view
from lidar_perception.candidates.warm_up import warm_up
from lidar_perception.data.kitti.folder import KittiFrame, open_kitti
from lidar_perception.data.recording import Recorded, open_recording
from lidar_perception.data.semantickitti import open_semantic_kitti
from lidar_perception.ground.cloth import segment_by_cloth
from lidar_perception.ground.threshold import segment_by_threshold
from lidar_perception.runs.files import write_text
from lidar_perception.runs.machine import cpu_name
from lidar_perception.runs.terminal import errors
from lidar_perception.scoring.centres.report import pedestrians
from lidar_perception.types import InputError, LidarFrame
from lidar_perception.wire.params import ViewParams

FULL_SCAN = 60_000   # points; a scan cut to the camera's view has some 20,000
FEW = 3              # frames with a pedestrian, below which those without serve too


@click.command(context_settings=dict(help_option_names=["-h", "--help"]))
@click.option("--kitti", type=click.Path(path_type=Path), required=True, metavar="ROOT",
              help="KITTI folder with Pedestrian labels.")
@click.option("--semantic-kitti", type=click.Path(path_type=Path), metavar="ROOT",
              help="SemanticKITTI folder; without it the ground methods are timed but not scored.")
@click.option("--json", "json_file", type=click.Path(path_type=Path), metavar="FILE",
              help="Write the figures to this file.")
@click.option("--repeat", type=click.IntRange(1), default=5, show_default=True,
              help="Runs a frame; its time is the median. Fewer beside peers that take seconds.")
@click.option("--frames", "count", type=click.IntRange(1), default=8, show_default=True,
              help="Frames for the single algorithms, evenly spread over the folder.")
@click.option("--graph/--no-graph", default=True, show_default=True,
              help="Also replay a bag of the frames through the nodes at 10 Hz.")
def main(kitti: Path, semantic_kitti: Path | None, json_file: Path | None, repeat: int,
         count: int, graph: bool) -> None:
    """Time our candidate pipeline beside a plain scikit-learn + OpenCV reading of the paper, and
    each algorithm beside its peers, and the steps of every version of EG-PointPillars and of the
    PointNet detector. Peers that are not installed are left out.

    \b
    Example:
      lidar benchmark --kitti /data/kitti/object --json benchmark.json
    """
    recording = open_recording(kitti=kitti)
    frames = [r for r in recording if isinstance(r, Recorded) and len(pedestrians(r))]
    if not frames:
        raise InputError(f"{kitti} has no frame with a Pedestrian label")
    labelled = spread(open_semantic_kitti(semantic_kitti), count) if semantic_kitti else []
    warm_up()
    content = {"machine": {"cpu": cpu_name(), "cores": os.cpu_count(), "python":
                           platform.python_version(), "numpy": np.__version__},
               "peers": {p.package: p.version() for p in peers.ALL},
               "candidates": compare(frames, repeat)}
    print_comparison(content["candidates"])
    in_view = [points_in_view(f, camera, ViewParams(enabled=True))[1].xyz
               for f, camera in _with_camera(kitti, frames, count)]
    scans = _full_scans(open_kitti(kitti), count)
    content |= _measure(in_view, scans, repeat)
    if scans:
        content["detection"] = measure_detection(scans, repeat)
        print_detection(content["detection"])
        content["pointnet"] = measure_pointnet(scans, repeat)
        print_pointnet(content["pointnet"])
    if labelled:
        content["ground_scores"] = ground.measure_labelled(labelled, repeat)
        print_ground(content["ground_scores"])
    content["simulation"] = measure_simulation(count, repeat)
    print_measured(content["simulation"])
    if graph:
        content["graph"] = {name: measure_graph(kitti, single)
                            for name, single in (("three_nodes", False), ("one_node", True))}
        print_graph(content["graph"])
    if json_file:
        write_text(json_file, json.dumps(content, indent=1))


def _with_camera(kitti: Path, pedestrian: list[Recorded], count: int) -> list[tuple]:
    """(frame, camera) of the frames with a pedestrian; of any frames where these are few."""
    if len(pedestrian) >= FEW:
        return [(r.frame, r.camera) for r in spread(pedestrian, count)]
    return [(f.load(), f.calibration().camera()) for f in spread(open_kitti(kitti), count)]


def _full_scans(every: list[KittiFrame], count: int) -> list[LidarFrame]:
    whole = [f for f in every if f.points.stat().st_size > 16 * FULL_SCAN]
    return [f.load() for f in spread(whole, count)]


def _measure(in_view: list[np.ndarray], scans: list[LidarFrame], repeat: int) -> dict:
    """Each algorithm beside its peers, printed one after the other."""
    whole = [f.xyz for f in scans]
    near, far, rest = ([xyz.compress(~segment(xyz), axis=0) for xyz in clouds]
                       for clouds, segment in ((in_view, segment_by_threshold),
                                               (whole, segment_by_threshold),
                                               (whole, segment_by_cloth)))
    content = {}

    def show(name: str, result: dict) -> None:
        content[name] = result
        print_measured(result)

    show("dbscan_in_view", clustering.measure_dbscan("DBSCAN, in view", near, repeat, 12))
    show("threshold_in_view", ground.measure_threshold("Threshold, in view", in_view, repeat))
    print_planes(content["threshold_in_view"])
    if not scans:
        errors.print(f"no scan has more than {FULL_SCAN} points: whole scans are not measured")
        return content
    dbscan = clustering.measure_dbscan("DBSCAN, whole scan", far, repeat, 20)
    clustering.whole_scan_limits(dbscan, far)
    show("dbscan_whole_scan", dbscan)
    for threshold in ("global", "local"):
        show(f"euclidean_{threshold}", clustering.measure_euclidean(rest, threshold, repeat))
    show("paper_c", clustering.measure_paper_c(whole, repeat))
    show("threshold", ground.measure_threshold("Threshold, whole scan", whole, repeat))
    print_planes(content["threshold"])
    show("patchwork", ground.measure_patchwork(scans, repeat))
    show("cloth", ground.measure_cloth(whole, repeat))
    return content


if __name__ == "__main__":
    try:
        main(prog_name="lidar benchmark")
    except InputError as error:
        raise SystemExit(f"Error: {error}") from None
