"""Measurement of the STM-CPA experiment on one frame: the counts of every table (Section 4)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np

from experiments.framework.experiment import Experiment
from experiments.stm_cpa.frames import LabelledFrame, load_labelled_frame, make_nearest_seed
from experiments.stm_cpa.params import READINGS, StmCpaParams
from experiments.stm_cpa.tables import make_sections
from lidar_perception.candidates.configurations import PAPER
from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.refine import STAGES, Candidates, refine_clusters, select_by_height
from lidar_perception.candidates.seeds import Seed
from lidar_perception.candidates.segmented_cloud import SegmentedCloud, fit_ground_plane, snap_to_ground
from lidar_perception.clustering.cluster import cluster_obstacles
from lidar_perception.clustering.shapes import fit_boxes
from lidar_perception.data.frame import Frame
from lidar_perception.detectors.contract import Detector
from lidar_perception.detectors.open import open_detector
from lidar_perception.detectors.pointpillars.params import PointPillarsParams
from lidar_perception.detectors.weights_file import find_pointpillars_weights
from lidar_perception.geometry import bev_and_3d_iou
from lidar_perception.param_fields import flatten, with_values
from lidar_perception.scoring.centres.matching import RANGE_NAMES, count_by_range, find_range_bins, match_centres
from lidar_perception.types import PEDESTRIAN, InputError

NUMBERS = StmCpaParams()


def measure_frame(frames: Sequence[Frame], number: int) -> dict[str, Any]:
    """Measure frame `number` and return its record. Lists of five values are by RANGE_NAMES.

    - pedestrians: number of labelled pedestrians
    - no_seed: why there was no seed, or None. Without a seed nothing is found, and all pedestrians
      are misses.
    - stages: stage -> see count_stage()
    - cpa: the same for each number of CPA steps
    - readings: name in READINGS -> see count_stage(), of the last stage
    - pointpillars: see count_stage(), of our PointPillars V0 at its default threshold
    - overlap: stage -> see measure_overlaps()
    - search: [true positives, false positives] for each eps and each min_samples
    - clusters: number of clusters before and after the height filter
    - ms: time of each step, and stm_all, the time of STM on all clusters; None without a seed
    """
    frame = frames[number]
    labelled = load_labelled_frame(frame)
    truth = labelled.pedestrians
    segmented = labelled.segment(PAPER)
    seed, no_seed, found, unfiltered = None, None, Candidates.none(), Candidates.none()
    sweep = [found.final.boxes] * (NUMBERS.cpa_steps + 1)
    readings = dict.fromkeys(READINGS, found.final.boxes)
    try:
        seed = make_nearest_seed(segmented, labelled)
        found = _refine(segmented, seed, PAPER)
        unfiltered = _refine(segmented, seed, drop_height_filter())
        sweep = [_refine(segmented, seed, extend_cpa(steps)).final.boxes for steps in range(NUMBERS.cpa_steps + 1)]
        readings = {name: _refine(segmented, seed, params).final.boxes for name, params in READINGS.items()}
    except InputError as error:
        no_seed = str(error)
    boxes = {stage: getattr(found, stage).boxes for stage in STAGES}
    return {
        "frame": frame.name,
        "pedestrians": _count_by_range(truth),
        "no_seed": no_seed,
        "stages": {stage: count_stage(boxes[stage], truth, boxes["stage1"]) for stage in STAGES},
        "cpa": [count_stage(accepted, truth, boxes["stage1"]) for accepted in sweep],
        "readings": {name: count_stage(accepted, truth, boxes["stage1"]) for name, accepted in readings.items()},
        "pointpillars": count_stage(detect_pedestrians(labelled), truth, boxes["stage1"]),
        "overlap": {stage: measure_overlaps(boxes[stage], truth) for stage in STAGES},
        "search": search_clustering(segmented, seed, truth),
        "clusters": [len(unfiltered.stage1), len(found.stage1)],
        "ms": None if no_seed else {**segmented.ms, **found.ms, "stm_all": unfiltered.ms["stm"]},
    }


def detect_pedestrians(labelled: LabelledFrame) -> np.ndarray:
    """Return the pedestrians (K, 7) that PointPillars V0 finds in the camera's view (Table 7)."""
    seen = labelled.camera.in_view(labelled.cloud.xyz)
    cloud = labelled.cloud.take(np.flatnonzero(seen))
    found = open_pointpillars(labelled.height)(cloud).detections
    return found.boxes[found.class_ids == PEDESTRIAN]


@cache
def open_pointpillars(height: float) -> Detector:
    """Open PointPillars V0 with the shipped weights for a sensor `height` metres above the ground."""
    weights = find_pointpillars_weights(PointPillarsParams(version="v0"))
    return open_detector(weights, "cpu", sensor_height=height, settings={"pointpillars.warm_up": False})


def drop_height_filter() -> PipelineParams:
    """Return the paper's parameters with STM on clusters of any height, and no CPA (Table 9)."""
    return with_values(PAPER, {"height.tolerance": 100.0, "cpa.steps": 0})


def extend_cpa(steps: int) -> PipelineParams:
    """Return the paper's parameters with CPA at all far ranges (Table 5)."""
    return with_values(
        PAPER, {"cpa.steps": steps, "cpa.min_range": NUMBERS.cpa_min_range, "cpa.max_range": NUMBERS.cpa_max_range}
    )


def search_clustering(segmented: SegmentedCloud, seed: Seed | None, truth: np.ndarray) -> list[list[list[int]]]:
    """Count true and false positives by range for each eps and each min_samples (Section 4.2).

    The same eps applies in all bands of range, which are clustered one by one as in the paper.
    Clusters of the seed's height count, and hits are within search_distance. Without a seed
    nothing is found.
    """
    plane = fit_ground_plane(segmented.xyz.compress(segmented.ground, axis=0), PAPER.boxes)
    counts = []
    for eps in NUMBERS.search_eps:
        for min_samples in NUMBERS.search_min_samples:
            found = np.zeros((0, 7))
            if seed is not None:
                found = _find_clusters(segmented, plane, seed, eps, min_samples)
            pairs = match_centres(found, truth, NUMBERS.search_distance)
            tp, fp, *_ = count_by_range(found, truth, pairs)
            counts.append([tp.tolist(), fp.tolist()])
    return counts


def _find_clusters(
    segmented: SegmentedCloud, plane: np.ndarray | None, seed: Seed, eps: float, min_samples: int
) -> np.ndarray:
    bands = len(PAPER.clustering.dbscan.eps)
    params = with_values(PAPER, {"clustering.dbscan.eps": (eps,) * bands, "clustering.dbscan.min_samples": min_samples})
    ids = cluster_obstacles(segmented.xyz, segmented.ground, params.clustering)
    boxes = snap_to_ground(fit_boxes(segmented.xyz, ids, params.boxes.shape), plane)
    return boxes[select_by_height(boxes, seed.height, params.height)]


def count_stage(found: np.ndarray, truth: np.ndarray, before: np.ndarray) -> dict[str, list]:
    """Return tp, fp, fn, error (sum of centre errors, metres) and kept, by range.

    kept counts the pedestrians hit both by the boxes found (K, 7) and by those `before` (L, 7).
    """
    pairs = match_centres(found, truth)
    tp, fp, fn, error = count_by_range(found, truth, pairs)
    kept = np.intersect1d(pairs[1], match_centres(before, truth)[1])
    return {
        "tp": tp.tolist(),
        "fp": fp.tolist(),
        "fn": fn.tolist(),
        "kept": _count_by_range(truth[kept]),
        "error": np.round(error, 6).tolist(),
    }


def measure_overlaps(found: np.ndarray, truth: np.ndarray) -> list[float]:
    """Compare the hits among boxes found (K, 7) with their true boxes, of truth (M, 7).

    Returns:
        The number of hits, the numbers with a 3D IoU of at least each of iou_limits, the same in
        BEV, and the sums of the IoU in 3D and in BEV.
    """
    i, j = match_centres(found, truth)
    bev, space = (np.diagonal(iou) for iou in bev_and_3d_iou(found[i], truth[j]))
    return [
        len(i),
        *(int((iou >= limit).sum()) for iou in (space, bev) for limit in NUMBERS.iou_limits),
        round(float(space.sum()), 6),
        round(float(bev.sum()), 6),
    ]


def _refine(segmented: SegmentedCloud, seed: Seed, params: PipelineParams) -> Candidates:
    return refine_clusters(segmented.xyz, segmented.cluster_ids, segmented.boxes, [seed], params)


def _count_by_range(boxes: np.ndarray) -> list[int]:
    return np.bincount(find_range_bins(boxes), minlength=len(RANGE_NAMES)).tolist()


STM_CPA = Experiment(
    "stm-cpa",
    "STM-CPA: the tables of the paper",
    "Does a plain reading of the paper's method give the paper's values?",
    measure_frame,
    make_sections,
    {
        "protocol": flatten(PAPER),
        "numbers": flatten(NUMBERS),
        "readings": {name: flatten(params) for name, params in READINGS.items()},
    },
)
