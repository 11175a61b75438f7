"""lidar benchmark: our candidate pipeline beside a plain reading of paper A, and the graph of
nodes over DDS, in one run on one machine."""

from __future__ import annotations

import json
import os
import platform
import tempfile
from pathlib import Path

import click
import numpy as np
from rich.table import Table

from benchmark import plain_stm_cpa
from lidar_perception.candidates.refine import STAGES
from lidar_perception.cli.evaluate import PROTOCOL
from lidar_perception.datasets.bag import Bag
from lidar_perception.datasets.recording import Recorded, open_recording
from lidar_perception.datasets.to_bag import kitti_scan, write_bag
from lidar_perception.evaluation.candidates import pedestrians
from lidar_perception.files import write_text
from lidar_perception.pipeline import (
    Segmented,
    cluster_obstacles,
    find_candidates,
    grounded_boxes,
    refined,
    truth_seed,
    warm_up,
)
from lidar_perception.terminal import console, track
from lidar_perception.topics import POINTS
from lidar_perception.types import InputError

SAME = 0.02  # metres between boxes of the same candidate; planes of two RANSACs differ a little


@click.command(context_settings=dict(help_option_names=["-h", "--help"]))
@click.option("--kitti", type=click.Path(path_type=Path), required=True, metavar="ROOT",
              help="KITTI folder with Pedestrian labels.")
@click.option("--json", "json_file", type=click.Path(path_type=Path), metavar="FILE",
              help="Write the figures to this file.")
@click.option("--repeat", type=click.IntRange(1), default=5, show_default=True,
              help="Runs a frame; its time is the median.")
@click.option("--graph/--no-graph", default=True, show_default=True,
              help="Also replay a bag of the frames through the nodes at 10 Hz.")
def main(kitti: Path, json_file: Path | None, repeat: int, graph: bool) -> None:
    """Time our candidate pipeline beside a plain scikit-learn + OpenCV reading of the paper.

    \b
    Example:
      lidar benchmark --kitti /data/kitti/object --json benchmark.json
    """
    recording = open_recording(kitti=kitti)
    frames = [r for r in recording if isinstance(r, Recorded) and len(pedestrians(r))]
    if not frames:
        raise InputError(f"{kitti} has no frame with a Pedestrian label")
    warm_up()
    content = {"machine": {"cpu": _cpu(), "cores": os.cpu_count(), "python":
                           platform.python_version(), "numpy": np.__version__},
               "candidates": compare(frames, repeat)}
    print_comparison(content["candidates"])
    if graph:
        content["graph"] = {name: measure_graph(kitti, single)
                            for name, single in (("three_nodes", False), ("one_node", True))}
        print_graph(content["graph"])
    if json_file:
        write_text(json_file, json.dumps(content, indent=1))


def compare(frames: list[Recorded], repeat: int) -> dict:
    """Medians over the frames of both, and how far their results agree."""
    ours: dict[str, list[float]] = {}
    plain: dict[str, list[float]] = {}
    agree = {"frames": len(frames), "labels_identical": 0, "candidates_same_given_ground": 0,
             "candidates": 0, "candidates_same": 0}
    for f in track(frames, "timing", len(frames)):
        truth = pedestrians(f)
        arguments = (f.frame.xyz, f.camera.projection, f.camera.width, f.camera.height, truth)
        theirs = [plain_stm_cpa.candidates(*arguments) for _ in range(min(repeat, 3))]
        mine = [find_candidates(f.frame, truth_seed(truth), f.camera, PROTOCOL)
                for _ in range(repeat)]
        _median_of_steps(plain, [r["ms"] for r in theirs])
        _median_of_steps(ours, [found.ms for _, found in mine])
        result = theirs[0]
        # The same ground for both: then clusters must be identical, and so the candidates.
        ids = cluster_obstacles(result["points"], result["ground"], PROTOCOL.clustering)
        agree["labels_identical"] += np.array_equal(ids, result["labels"])
        boxes = grounded_boxes(result["points"], result["ground"], ids, "axis_aligned")
        segmented = Segmented(np.arange(len(ids)), result["points"], result["ground"], ids, boxes)
        found = refined(segmented, truth_seed(truth), PROTOCOL)
        agree["candidates_same_given_ground"] += all(
            len(getattr(found, s)) == len(result[s]) == _shared(getattr(found, s).boxes, result[s])
            for s in STAGES)
        # Each with its own RANSAC.
        agree["candidates"] += max(len(mine[0][1].final), len(result["final"]))
        agree["candidates_same"] += _shared(mine[0][1].final.boxes, result["final"])
    medians = {name: {k: float(np.median(v)) for k, v in steps.items()}
               for name, steps in (("ours_ms", ours), ("plain_ms", plain))}
    ratios = {k: medians["plain_ms"][k] / medians["ours_ms"][k] for k in medians["ours_ms"]}
    return {**medians, "times_faster": ratios, "agreement": agree}


def _median_of_steps(times: dict[str, list[float]], runs: list[dict[str, float]]) -> None:
    for run in runs:
        run["total"] = sum(run.values())
    for step in runs[0]:
        times.setdefault(step, []).append(float(np.median([run[step] for run in runs])))


def _shared(a: np.ndarray, b: np.ndarray) -> int:
    """How many boxes of a have one in b within SAME metres in every number."""
    if len(a) == 0 or len(b) == 0:
        return 0
    return int((np.abs(a[:, None] - b[None]).max(axis=2) <= SAME).any(axis=1).sum())


def measure_graph(kitti: Path, single: bool) -> dict:
    """Latency, losses and memory of the nodes at 10 Hz, without recording."""
    from lidar_perception.datasets.kitti import open_kitti
    from lidar_perception.nodes.replay import replay
    with tempfile.TemporaryDirectory() as folder:
        drive, out = Path(folder) / "drive", Path(folder)
        found = open_kitti(kitti)
        write_bag(drive, track(map(kitti_scan, found), "writing a bag", len(found)))
        with Bag(drive) as bag:
            clouds = bag.counts[POINTS]
        content = replay(drive, clouds, out, PROTOCOL, single=single, record=False)
    return {k: content[k] for k in ("clouds", "results", "latency_ms", "memory_mb", "ms")}


def print_comparison(content: dict) -> None:
    table = Table(title="Median ms a frame: plain reading of the paper, and ours")
    for name in ("step", "plain", "ours", "times faster"):
        table.add_column(name, justify="left" if name == "step" else "right")
    for step, ratio in content["times_faster"].items():
        table.add_row(step, f"{content['plain_ms'][step]:.2f}", f"{content['ours_ms'][step]:.2f}",
                      f"{ratio:.1f}", style="bold" if step == "total" else "")
    console.print(table)
    agree = content["agreement"]
    console.print(f"cluster labels identical in {agree['labels_identical']} of {agree['frames']} "
                  "frames, border points included; candidates of all stages the same in "
                  f"{agree['candidates_same_given_ground']} (same ground for both); with each "
                  f"its own RANSAC {agree['candidates_same']} of {agree['candidates']} final "
                  "candidates are the same")


def print_graph(content: dict) -> None:
    table = Table(title="Nodes over DDS at 10 Hz, no recording")
    for name in ("graph", "clouds", "lost", "median ms", "95 % under ms", "memory MB"):
        table.add_column(name, justify="left" if name == "graph" else "right")
    for name, run in content.items():
        table.add_row(name.replace("_", " "), str(run["clouds"]),
                      str(run["clouds"] - run["results"]), f"{run['latency_ms']['median']:.0f}",
                      f"{run['latency_ms']['p95']:.0f}", f"{run['memory_mb']:.0f}")
    console.print(table)


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(x.split(":")[1].strip() for x in lines if x.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor()


if __name__ == "__main__":
    try:
        main(prog_name="lidar benchmark")
    except InputError as error:
        raise SystemExit(f"Error: {error}") from None
