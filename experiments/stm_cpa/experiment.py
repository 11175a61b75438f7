"""Measurement of the STM-CPA experiment on one frame: counts for all tables of the paper (Section 4)."""

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
    """Measure frame `number` and return its record. Lists of five values have one value per range in RANGE_NAMES.

    - pedestrians: number of labelled pedestrians
    - no_seed: reason why there is no seed, or None. Without a seed there are no detections, and all
      pedestrians are misses.
    - stages: stage -> result of count_stage()
    - cpa: result of count_stage() for each number of CPA steps
    - readings: name in READINGS -> result of count_stage() for the last stage
    - pointpillars: result of count_stage() for our PointPillars V0 with its default threshold
    - overlap: stage -> result of measure_overlaps()
    - search: [true positives, false positives] for each eps and each min_samples
    - clusters: number of clusters before and after the height filter
    - ms: time of each step, and stm_all, the time of STM on all clusters; None without a seed
    """
    frame = frames[number]
    labelled = load_labelled_frame(frame)
    truth = labelled.pedestrians
    segmented = labelled.segment(PAPER)
    seed, no_seed, candidates, unfiltered_candidates = None, None, Candidates.none(), Candidates.none()
    sweep = [candidates.final.boxes] * (NUMBERS.cpa_steps + 1)
    readings = dict.fromkeys(READINGS, candidates.final.boxes)
    try:
        seed = make_nearest_seed(segmented, labelled)
        candidates = _refine(segmented, seed, PAPER)
        unfiltered_candidates = _refine(segmented, seed, drop_height_filter())
        sweep = [_refine(segmented, seed, extend_cpa(steps)).final.boxes for steps in range(NUMBERS.cpa_steps + 1)]
        readings = {name: _refine(segmented, seed, params).final.boxes for name, params in READINGS.items()}
    except InputError as error:
        no_seed = str(error)
    boxes = {stage: getattr(candidates, stage).boxes for stage in STAGES}
    return {
        "frame": frame.name,
        "pedestrians": _count_by_range(truth),
        "no_seed": no_seed,
        "stages": {stage: count_stage(boxes[stage], truth, boxes["stage1"]) for stage in STAGES},
        "cpa": [count_stage(stage_boxes, truth, boxes["stage1"]) for stage_boxes in sweep],
        "readings": {name: count_stage(stage_boxes, truth, boxes["stage1"]) for name, stage_boxes in readings.items()},
        "pointpillars": count_stage(detect_pedestrians(labelled), truth, boxes["stage1"]),
        "overlap": {stage: measure_overlaps(boxes[stage], truth) for stage in STAGES},
        "search": search_clustering(segmented, seed, truth),
        "clusters": [len(unfiltered_candidates.stage1), len(candidates.stage1)],
        "ms": None if no_seed else {**segmented.ms, **candidates.ms, "stm_all": unfiltered_candidates.ms["stm"]},
    }


def detect_pedestrians(labelled: LabelledFrame) -> np.ndarray:
    """Return the pedestrians (K, 7) that PointPillars V0 detects in the camera's view (Table 7)."""
    in_view = labelled.camera.in_view(labelled.cloud.xyz)
    cloud = labelled.cloud.take(np.flatnonzero(in_view))
    detections = open_pointpillars(labelled.height)(cloud).detections
    return detections.boxes[detections.class_ids == PEDESTRIAN]


@cache
def open_pointpillars(height: float) -> Detector:
    """Open PointPillars V0 with the shipped weights for a sensor `height` metres above the ground."""
    weights = find_pointpillars_weights(PointPillarsParams(version="v0"))
    return open_detector(weights, "cpu", sensor_height=height, settings={"pointpillars.warm_up": False})


def drop_height_filter() -> PipelineParams:
    """Return the paper's parameters without the height filter and without CPA (Table 9)."""
    return with_values(PAPER, {"height.tolerance": 100.0, "cpa.steps": 0})


def extend_cpa(steps: int) -> PipelineParams:
    """Return the paper's parameters with this number of CPA steps at all far ranges (Table 5)."""
    return with_values(
        PAPER, {"cpa.steps": steps, "cpa.min_range": NUMBERS.cpa_min_range, "cpa.max_range": NUMBERS.cpa_max_range}
    )


def search_clustering(segmented: SegmentedCloud, seed: Seed | None, truth: np.ndarray) -> list[list[list[int]]]:
    """Count true and false positives by range for each eps and each min_samples (Section 4.2).

    The same eps is used in all range bands, which are clustered separately as in the paper. Only
    clusters of the seed's height count as detections, and hits are within search_distance. Without
    a seed there are no detections.
    """
    plane = fit_ground_plane(segmented.xyz.compress(segmented.ground, axis=0), PAPER.boxes)
    counts = []
    for eps in NUMBERS.search_eps:
        for min_samples in NUMBERS.search_min_samples:
            boxes = np.zeros((0, 7))
            if seed is not None:
                boxes = _find_clusters(segmented, plane, seed, eps, min_samples)
            pairs = match_centres(boxes, truth, NUMBERS.search_distance)
            tp, fp, *_ = count_by_range(boxes, truth, pairs)
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


def count_stage(detections: np.ndarray, truth: np.ndarray, earlier_detections: np.ndarray) -> dict[str, list]:
    """Count the hits and errors of a stage by range.

    Args:
        detections: (K, 7) boxes after the stage.
        truth: (M, 7) labelled boxes.
        earlier_detections: (L, 7) boxes after the first stage.

    Returns:
        Counts `tp`, `fp` and `fn`; `error`, the sum of centre errors in metres; and `kept`, the
        number of pedestrians matched both by detections and by earlier detections.
    """
    pairs = match_centres(detections, truth)
    tp, fp, fn, error = count_by_range(detections, truth, pairs)
    kept_indices = np.intersect1d(pairs[1], match_centres(earlier_detections, truth)[1])
    return {
        "tp": tp.tolist(),
        "fp": fp.tolist(),
        "fn": fn.tolist(),
        "kept": _count_by_range(truth[kept_indices]),
        "error": np.round(error, 6).tolist(),
    }


def measure_overlaps(detections: np.ndarray, truth: np.ndarray) -> list[float]:
    """Measure the overlap of detections (K, 7) with the labels (M, 7) that they match.

    Returns:
        The number of hits, the number of hits with a 3D IoU of at least each of iou_limits, the
        same in BEV, and the sums of the IoU in 3D and in BEV.
    """
    i, j = match_centres(detections, truth)
    bev_iou, iou_3d = (np.diagonal(iou) for iou in bev_and_3d_iou(detections[i], truth[j]))
    return [
        len(i),
        *(int((iou >= limit).sum()) for iou in (iou_3d, bev_iou) for limit in NUMBERS.iou_limits),
        round(float(iou_3d.sum()), 6),
        round(float(bev_iou.sum()), 6),
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
