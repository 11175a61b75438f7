"""Comparison of the candidate pipeline with a plain implementation of paper A."""

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

MAX_DIFFERENCE_M = 0.02  # boxes that differ by less count as equal; the two RANSAC planes differ slightly


def compare_candidates(frames: list[Frame], repeat: int) -> dict:
    """Compare the STM-CPA pipeline with its plain implementation: median times and agreement of the results."""
    our_ms: dict[str, list[float]] = {}
    plain_ms: dict[str, list[float]] = {}
    best_ms: dict[str, list[float]] = {}
    agreement = {
        "frames": len(frames),
        "labels_identical": 0,
        "candidates_same_given_ground": 0,
        "candidates": 0,
        "candidates_same": 0,
    }
    for frame in show_progress(frames, "timing", len(frames)):
        truth, scan, camera = select_pedestrians(frame.truth()), frame.load(), frame.camera()
        arguments = scan.xyz, camera.projection, camera.width, camera.height, truth
        plain_results = [plain_stm_cpa.find_candidates(*arguments) for _ in range(min(repeat, 3))]
        our_results = [find_candidates(scan, make_truth_source(truth), camera, PAPER) for _ in range(repeat)]
        _append_medians(plain_ms, [r["ms"] for r in plain_results])
        _append_medians(our_ms, [refined_candidates.ms for _, refined_candidates in our_results])
        _append_medians(
            best_ms, [find_candidates(scan, make_truth_source(truth), camera, BEST)[1].ms for _ in range(repeat)]
        )
        result = plain_results[0]
        # With the same ground, the clusters and candidates must be identical.
        ids = cluster_obstacles(result["points"], result["ground"], PAPER.clustering)
        agreement["labels_identical"] += np.array_equal(ids, result["labels"])
        boxes = fit_grounded_boxes(result["points"], result["ground"], ids)
        segmented = SegmentedCloud(np.arange(len(ids)), result["points"], result["ground"], ids, boxes)
        refined_candidates = refine_segmented(segmented, make_truth_source(truth), PAPER)
        agreement["candidates_same_given_ground"] += all(
            len(getattr(refined_candidates, s))
            == len(result[s])
            == _count_equal_boxes(getattr(refined_candidates, s).boxes, result[s])
            for s in STAGES
        )
        # Here each implementation uses its own RANSAC.
        agreement["candidates"] += max(len(our_results[0][1].final), len(result["final"]))
        agreement["candidates_same"] += _count_equal_boxes(our_results[0][1].final.boxes, result["final"])
    medians = {
        name: {k: float(np.median(v)) for k, v in steps.items()}
        for name, steps in (("ours_ms", our_ms), ("plain_ms", plain_ms), ("best_ms", best_ms))
    }
    ratios = {k: medians["plain_ms"][k] / medians["ours_ms"][k] for k in medians["plain_ms"]}
    return {**medians, "times_faster": ratios, "agreement": agreement}


def _append_medians(times: dict[str, list[float]], runs: list[dict[str, float]]) -> None:
    """Append the median time of each step, and of their sum, over several runs on one frame."""
    for run in runs:
        run["total"] = sum(run.values())
    for step in runs[0]:
        times.setdefault(step, []).append(float(np.median([run[step] for run in runs])))


def _count_equal_boxes(a: np.ndarray, b: np.ndarray) -> int:
    """Count the boxes of `a` that differ from a box of `b` by at most MAX_DIFFERENCE_M in every value."""
    if len(a) == 0 or len(b) == 0:
        return 0
    return int((np.abs(a[:, None] - b[None]).max(axis=2) <= MAX_DIFFERENCE_M).any(axis=1).sum())


def print_comparison(content: dict) -> None:
    table = Table(title="Median ms per frame of a plain implementation of the paper, and of ours")
    for name in ("step", "plain", "ours", "times faster", "ours, best"):
        table.add_column(name, justify="left" if name == "step" else "right")
    for step, best in content["best_ms"].items():
        plain_ms = content["plain_ms"].get(step)
        table.add_row(
            step,
            "" if plain_ms is None else f"{plain_ms:.2f}",
            f"{content['ours_ms'][step]:.2f}",
            "" if plain_ms is None else f"{content['times_faster'][step]:.1f}",
            f"{best:.2f}",
            style="bold" if step == "total" else "",
        )
    console.print(table)
    agreement = content["agreement"]
    console.print(
        f"with the same ground, cluster labels are identical in {agreement['labels_identical']} of "
        f"{agreement['frames']} frames (including border points), and candidates of all stages in "
        f"{agreement['candidates_same_given_ground']}; if each implementation uses its own RANSAC, "
        f"{agreement['candidates_same']} of {agreement['candidates']} final candidates are equal"
    )
