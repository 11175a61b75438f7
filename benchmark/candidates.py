"""The candidate pipeline against a plain implementation of paper A."""

from __future__ import annotations

import numpy as np
from rich.table import Table

from benchmark import plain_stm_cpa
from lidar_perception.candidates.configurations import BEST, PAPER
from lidar_perception.candidates.pipeline import find_candidates, refine_segmented
from lidar_perception.candidates.refine import STAGES
from lidar_perception.candidates.seed_sources import make_truth_source
from lidar_perception.candidates.segmented_cloud import SegmentedCloud, fit_grounded_boxes
from lidar_perception.clustering.cluster import cluster_obstacles
from lidar_perception.data.frame import Frame
from lidar_perception.runs.terminal import console, show_progress
from lidar_perception.scoring.centres.report import select_pedestrians

SAME = 0.02  # max distance in metres between equal boxes; two RANSAC planes differ a little


def compare_candidates(frames: list[Frame], repeat: int) -> dict:
    """Return the median times of both, and how well their results agree."""
    ours: dict[str, list[float]] = {}
    plain: dict[str, list[float]] = {}
    best: dict[str, list[float]] = {}
    agree = {
        "frames": len(frames),
        "labels_identical": 0,
        "candidates_same_given_ground": 0,
        "candidates": 0,
        "candidates_same": 0,
    }
    for f in show_progress(frames, "timing", len(frames)):
        truth, scan, camera = select_pedestrians(f.truth()), f.load(), f.camera()
        arguments = scan.xyz, camera.projection, camera.width, camera.height, truth
        theirs = [plain_stm_cpa.candidates(*arguments) for _ in range(min(repeat, 3))]
        mine = [find_candidates(scan, make_truth_source(truth), camera, PAPER) for _ in range(repeat)]
        _median_of_steps(plain, [r["ms"] for r in theirs])
        _median_of_steps(ours, [found.ms for _, found in mine])
        _median_of_steps(
            best, [find_candidates(scan, make_truth_source(truth), camera, BEST)[1].ms for _ in range(repeat)]
        )
        result = theirs[0]
        # Given the same ground, the clusters and candidates must be identical.
        ids = cluster_obstacles(result["points"], result["ground"], PAPER.clustering)
        agree["labels_identical"] += np.array_equal(ids, result["labels"])
        boxes = fit_grounded_boxes(result["points"], result["ground"], ids)
        segmented = SegmentedCloud(np.arange(len(ids)), result["points"], result["ground"], ids, boxes)
        found = refine_segmented(segmented, make_truth_source(truth), PAPER)
        agree["candidates_same_given_ground"] += all(
            len(getattr(found, s)) == len(result[s]) == _count_shared(getattr(found, s).boxes, result[s])
            for s in STAGES
        )
        # Each implementation with its own RANSAC.
        agree["candidates"] += max(len(mine[0][1].final), len(result["final"]))
        agree["candidates_same"] += _count_shared(mine[0][1].final.boxes, result["final"])
    medians = {
        name: {k: float(np.median(v)) for k, v in steps.items()}
        for name, steps in (("ours_ms", ours), ("plain_ms", plain), ("best_ms", best))
    }
    ratios = {k: medians["plain_ms"][k] / medians["ours_ms"][k] for k in medians["plain_ms"]}
    return {**medians, "times_faster": ratios, "agreement": agree}


def _median_of_steps(times: dict[str, list[float]], runs: list[dict[str, float]]) -> None:
    for run in runs:
        run["total"] = sum(run.values())
    for step in runs[0]:
        times.setdefault(step, []).append(float(np.median([run[step] for run in runs])))


def _count_shared(a: np.ndarray, b: np.ndarray) -> int:
    """Count the boxes of a that have one in b within SAME metres in every value."""
    if len(a) == 0 or len(b) == 0:
        return 0
    return int((np.abs(a[:, None] - b[None]).max(axis=2) <= SAME).any(axis=1).sum())


def print_comparison(content: dict) -> None:
    table = Table(title="Median ms per frame: plain implementation of the paper, and ours")
    for name in ("step", "plain", "ours", "times faster", "ours, best"):
        table.add_column(name, justify="left" if name == "step" else "right")
    for step, best in content["best_ms"].items():
        peer = content["plain_ms"].get(step)
        table.add_row(
            step,
            "" if peer is None else f"{peer:.2f}",
            f"{content['ours_ms'][step]:.2f}",
            "" if peer is None else f"{content['times_faster'][step]:.1f}",
            f"{best:.2f}",
            style="bold" if step == "total" else "",
        )
    console.print(table)
    agree = content["agreement"]
    console.print(
        f"cluster labels identical in {agree['labels_identical']} of {agree['frames']} "
        "frames, border points included; candidates of all stages the same in "
        f"{agree['candidates_same_given_ground']} (same ground for both); with each "
        f"its own RANSAC {agree['candidates_same']} of {agree['candidates']} final "
        "candidates are the same"
    )
