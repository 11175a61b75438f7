"""The experiment of paper A on one frame: the counts of every table (Section 4)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lidar_perception.candidates.boxes import select_by_height, snap_to_ground
from lidar_perception.candidates.configurations import PAPER
from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.refine import STAGES, Candidates, refine_clusters
from lidar_perception.candidates.seeds import Seed
from lidar_perception.candidates.segmented_cloud import SegmentedCloud, fit_ground_plane
from lidar_perception.clustering.cluster import cluster_obstacles
from lidar_perception.clustering.shapes import fit_boxes
from lidar_perception.data.frame import Frame
from lidar_perception.geometry import bev_and_3d_iou
from lidar_perception.param_fields import flatten, with_values
from lidar_perception.reproduction.experiment import Experiment
from lidar_perception.reproduction.labelled import load_labelled, nearest_seed
from lidar_perception.reproduction.params import StmCpaParams
from lidar_perception.reproduction.stm_cpa_tables import sections
from lidar_perception.scoring.centres.matching import (
    RANGE_NAMES,
    count_by_range,
    find_range_bins,
    match_centres,
)
from lidar_perception.types import InputError

NUMBERS = StmCpaParams()


def measure(frames: Sequence[Frame], number: int) -> dict[str, Any]:
    """The record of one frame. Lists of five go by RANGE_NAMES.

    pedestrians: true ones. no_seed: why there was no seed, or None; then nothing is found, and the
    pedestrians are misses. stages: stage -> counts, see stage_counts(). cpa: the same after each
    number of steps. overlap: stage -> see overlaps(). search: [true, false positives] for each
    eps and each min_samples. clusters: how many before and after the height filter. ms: time of
    each step, and stm_all, that of STM on all clusters; None without a seed.
    """
    frame = frames[number]
    labelled = load_labelled(frame)
    truth = labelled.pedestrians
    segmented = labelled.segmented(PAPER)
    seed, no_seed, found, everything = None, None, Candidates.none(), Candidates.none()
    sweep = [found.final.boxes] * (NUMBERS.cpa_steps + 1)
    try:
        seed = nearest_seed(segmented, labelled)
        found = _refined(segmented, seed, PAPER)
        everything = _refined(segmented, seed, without_height_filter())
        sweep = [_refined(segmented, seed, cpa_everywhere(steps)).final.boxes
                 for steps in range(NUMBERS.cpa_steps + 1)]
    except InputError as error:
        no_seed = str(error)
    boxes = {stage: getattr(found, stage).boxes for stage in STAGES}
    return {
        "frame": frame.name,
        "pedestrians": _by_range(truth),
        "no_seed": no_seed,
        "stages": {stage: stage_counts(boxes[stage], truth, boxes["stage1"]) for stage in STAGES},
        "cpa": [stage_counts(accepted, truth, boxes["stage1"]) for accepted in sweep],
        "overlap": {stage: overlaps(boxes[stage], truth) for stage in STAGES},
        "search": search(segmented, seed, truth),
        "clusters": [len(everything.stage1), len(found.stage1)],
        "ms": None if no_seed else {**segmented.ms, **found.ms, "stm_all": everything.ms["stm"]},
    }


def without_height_filter() -> PipelineParams:
    """The paper's setting with STM on clusters of any height, and no CPA (Table 9)."""
    return with_values(PAPER, {"height.tolerance": 100.0, "cpa.steps": 0})


def cpa_everywhere(steps: int) -> PipelineParams:
    """The paper's setting with CPA over the whole far part (Table 5)."""
    return with_values(PAPER, {"cpa.steps": steps, "cpa.min_range": NUMBERS.cpa_min_range,
                                  "cpa.max_range": NUMBERS.cpa_max_range})


def search(segmented: SegmentedCloud, seed: Seed | None,
           truth: np.ndarray) -> list[list[list[int]]]:
    """True and false positives by range of the clusters of the seed's height, for each eps and
    each min_samples: eps in all bands of range, which are clustered one by one as in the paper.

    Hits lie within search_distance (Section 4.2)."""
    plane = fit_ground_plane(segmented.xyz.compress(segmented.ground, axis=0), PAPER.boxes)
    counts = []
    for eps in NUMBERS.search_eps:
        for min_samples in NUMBERS.search_min_samples:
            found = np.zeros((0, 7))
            if seed is not None:
                found = _clusters(segmented, plane, seed, eps, min_samples)
            pairs = match_centres(found, truth, NUMBERS.search_distance)
            tp, fp, *_ = count_by_range(found, truth, pairs)
            counts.append([tp.tolist(), fp.tolist()])
    return counts


def _clusters(segmented: SegmentedCloud, plane: np.ndarray | None, seed: Seed, eps: float,
              min_samples: int) -> np.ndarray:
    bands = len(PAPER.clustering.dbscan.eps)
    params = with_values(PAPER, {"clustering.dbscan.eps": (eps,) * bands,
                                    "clustering.dbscan.min_samples": min_samples})
    ids = cluster_obstacles(segmented.xyz, segmented.ground, params.clustering)
    boxes = snap_to_ground(fit_boxes(segmented.xyz, ids, params.boxes.shape), plane)
    return boxes[select_by_height(boxes, seed.height, params.height)]


def stage_counts(found: np.ndarray, truth: np.ndarray, before: np.ndarray) -> dict[str, list]:
    """tp, fp, fn, error (sum of centre errors, m) and kept by range: kept are the pedestrians that
    are hit by one of the boxes found (K, 7) and by one of those `before` (L, 7)."""
    pairs = match_centres(found, truth)
    tp, fp, fn, error = count_by_range(found, truth, pairs)
    kept = np.intersect1d(pairs[1], match_centres(before, truth)[1])
    return {"tp": tp.tolist(), "fp": fp.tolist(), "fn": fn.tolist(),
            "kept": _by_range(truth[kept]), "error": np.round(error, 6).tolist()}


def overlaps(found: np.ndarray, truth: np.ndarray) -> list[float]:
    """Of the hits of boxes found (K, 7), one by one with their true boxes: how many there are,
    how many have a 3D IoU from each of iou_limits on, the same from above, and the sums of 3D IoU
    and of IoU from above."""
    i, j = match_centres(found, truth)
    bev, space = (np.diagonal(iou) for iou in bev_and_3d_iou(found[i], truth[j]))
    return [len(i), *(int((iou >= limit).sum()) for iou in (space, bev)
                      for limit in NUMBERS.iou_limits),
            round(float(space.sum()), 6), round(float(bev.sum()), 6)]


def _refined(segmented: SegmentedCloud, seed: Seed, params: PipelineParams) -> Candidates:
    return refine_clusters(segmented.xyz, segmented.cluster_ids, segmented.boxes, seed, params)


def _by_range(boxes: np.ndarray) -> list[int]:
    return np.bincount(find_range_bins(boxes), minlength=len(RANGE_NAMES)).tolist()


STM_CPA = Experiment(
    "stm-cpa", "STM-CPA: the tables of the paper",
    "Do the paper's figures come out where its method is read plainly?",
    measure, sections,
    {"protocol": flatten(PAPER), "numbers": flatten(NUMBERS)})
