"""lidar benchmark: time all algorithms and other implementations of them, in one run on one machine.

Compares the candidate pipeline with a plain implementation of paper A and each algorithm with its
peers, and times every version of EG-PointPillars and the graph of nodes over DDS.
"""

from __future__ import annotations

import json
import os
import platform
from pathlib import Path
from typing import Any

import click
import numpy as np

from benchmark import clustering, ground, peers
from benchmark.candidates import compare_candidates, print_comparison
from benchmark.detection import measure_detection, measure_engines, print_detection
from benchmark.graph import measure_graph, print_graph
from benchmark.pointnet import measure_pointnet, print_pointnet
from benchmark.rows import print_ground, print_measured
from benchmark.startup import measure_startup
from benchmark.timing import choose_evenly
from benchmark.tracking import measure_recording, print_tracking
from lidar_perception.candidates.segmented_cloud import crop_to_view
from lidar_perception.candidates.warm_up import warm_up
from lidar_perception.data.frame import BOXES, CAMERA, POINT_LABELS, Frame, Recording
from lidar_perception.data.open import open_recording
from lidar_perception.ground.cloth import segment_by_cloth
from lidar_perception.ground.threshold import segment_by_threshold
from lidar_perception.runs.files import write_text
from lidar_perception.runs.machine import read_cpu_name
from lidar_perception.runs.memory import keep_freed_memory
from lidar_perception.runs.terminal import errors
from lidar_perception.scoring.centres.report import select_pedestrians
from lidar_perception.types import InputError, PointCloud
from lidar_perception.wire.params import ViewParams

MIN_FULL_SCAN_POINTS = 60_000  # a scan that is cropped to the camera's view has only about 20,000
MIN_PEDESTRIAN_FRAMES = 3  # if there are fewer, other frames are used too


@click.command(context_settings=dict(help_option_names=["-h", "--help"]))
@click.option(
    "--data",
    type=click.Path(path_type=Path),
    required=True,
    metavar="PATH",
    multiple=True,
    help="A recording with Pedestrian labels and a camera, such as KITTI. Repeat with labelled points "
    "(SemanticKITTI) to score the ground methods too, and with track ids (KITTI tracking) to score the trackers.",
)
@click.option(
    "--json", "json_file", type=click.Path(path_type=Path), metavar="FILE", help="Write the results to this file."
)
@click.option(
    "--repeat",
    type=click.IntRange(1),
    default=5,
    show_default=True,
    help="Runs per frame, of which the median is used. Slow peers run less often.",
)
@click.option(
    "--frames",
    "count",
    type=click.IntRange(1),
    default=8,
    show_default=True,
    help="Number of frames for each algorithm, evenly spread over the recording.",
)
@click.option(
    "--graph/--no-graph",
    default=True,
    show_default=True,
    help="Also replay a bag of the frames through the nodes at 10 Hz.",
)
def main(data: tuple[Path, ...], json_file: Path | None, repeat: int, count: int, graph: bool) -> None:
    """Time our candidate pipeline and a plain scikit-learn + OpenCV implementation of the paper,
    each algorithm and its peers, and the steps of every version of EG-PointPillars and of the
    PointNet detector. Peers that are not installed are skipped.

    \b
    Example:
      lidar benchmark --data /data/kitti/object --json benchmark.json
    """
    keep_freed_memory()
    recordings = [open_recording(path) for path in data]
    recording = next((candidate for candidate in recordings if {BOXES, CAMERA} <= candidate.contents), recordings[0])
    recording.require(BOXES, "benchmark")
    recording.require(CAMERA, "benchmark")
    frames = [f for f in recording if len(select_pedestrians(f.truth()))]
    if not frames:
        raise InputError(f"{recording.path} has no frame with a Pedestrian label")
    labelled_frames = [
        f
        for candidate in recordings
        if POINT_LABELS in candidate.contents
        for f in choose_evenly(candidate.frames, count)
    ]
    warm_up()
    content: dict[str, Any] = {
        "machine": {
            "cpu": read_cpu_name(),
            "cores": os.cpu_count(),
            "python": platform.python_version(),
            "numpy": np.__version__,
        },
        "peers": {p.package: p.read_version() for p in peers.ALL},
        "candidates": compare_candidates(frames, repeat),
    }
    print_comparison(content["candidates"])
    clouds_in_view = [
        crop_to_view(scan, camera, ViewParams(enabled=True))[1].xyz
        for scan, camera in _load_scans_with_camera(recording, frames, count)
    ]
    scans = _load_full_scans(recording, count)
    content |= _measure_algorithms(clouds_in_view, scans, repeat)
    if scans:
        content["detection"] = measure_detection(scans, repeat)
        print_detection(content["detection"])
        content["engines"] = measure_engines(scans, repeat)
        print_measured(content["engines"])
        content["pointnet"] = measure_pointnet(scans, repeat)
        print_pointnet(content["pointnet"])
    if labelled_frames:
        content["ground_scores"] = ground.measure_labelled(labelled_frames, repeat)
        print_ground(content["ground_scores"])
    for candidate in recordings:
        if drives := measure_recording(candidate):
            content["tracking"] = drives
            print_tracking(drives)
    content["startup"] = measure_startup(repeat)
    print_measured(content["startup"])
    if graph:
        content["graph"] = measure_graph(recording)
        print_graph(content["graph"])
    if json_file:
        write_text(json_file, json.dumps(content, indent=1))


def _load_scans_with_camera(recording: Recording, pedestrian_frames: list[Frame], count: int) -> list[tuple]:
    """Return (scan, camera) of frames with a pedestrian, or of any frames if there are few of them."""
    frames = pedestrian_frames if len(pedestrian_frames) >= MIN_PEDESTRIAN_FRAMES else recording.frames
    return [(f.load(), f.camera()) for f in choose_evenly(frames, count)]


def _load_full_scans(recording: Recording, count: int) -> list[PointCloud]:
    full_scans = [f for f in recording if len(f.load()) > MIN_FULL_SCAN_POINTS]
    return [f.load() for f in choose_evenly(full_scans, count)]


def _measure_algorithms(clouds_in_view: list[np.ndarray], scans: list[PointCloud], repeat: int) -> dict:
    """Measure and print each algorithm and its peers."""
    full_scans = [f.xyz for f in scans]
    obstacles_in_view, obstacles, cloth_obstacles = (
        [xyz.compress(~segment(xyz), axis=0) for xyz in clouds]
        for clouds, segment in (
            (clouds_in_view, segment_by_threshold),
            (full_scans, segment_by_threshold),
            (full_scans, segment_by_cloth),
        )
    )
    content = {}

    def add_result(name: str, result: dict) -> None:
        content[name] = result
        print_measured(result)

    add_result("dbscan_in_view", clustering.measure_dbscan("DBSCAN, in view", obstacles_in_view, repeat, 12))
    add_result("threshold_in_view", ground.measure_threshold("Threshold, in view", clouds_in_view, repeat))
    if not scans:
        errors.print(f"no scan has more than {MIN_FULL_SCAN_POINTS} points: skipping the full-scan benchmark")
        return content
    add_result("dbscan_whole_scan", clustering.measure_dbscan("DBSCAN, full scan", obstacles, repeat, 20))
    for threshold in ("global", "local"):
        add_result(f"euclidean_{threshold}", clustering.measure_euclidean(cloth_obstacles, threshold, repeat))
    add_result("paper_c", clustering.measure_paper_c(full_scans, repeat))
    add_result("threshold", ground.measure_threshold("Threshold, full scan", full_scans, repeat))
    add_result("patchwork", ground.measure_patchwork(scans, repeat))
    add_result("cloth", ground.measure_cloth(full_scans, repeat))
    return content


if __name__ == "__main__":
    try:
        main(prog_name="lidar benchmark")
    except InputError as error:
        click.echo(f"Error: {error}", err=True)
        raise SystemExit(2) from None
