"""Fit candidates/confidence.json to simulated scans: two additive log-odds models.

One model uses the shape of a cluster, the other also its similarity to a seed.

    lidar-perception simulate --format kitti --frames 400 --people 2 --seed 6000 --out scans
    python scripts/fit_confidence.py scans

Pedestrians are weighted so that their ranges are distributed as in KITTI's training set (paper A, Table 1).
"""

from __future__ import annotations

import json
import sys
from multiprocessing import Pool
from pathlib import Path

import numpy as np

from lidar_perception.candidates import confidence as module
from lidar_perception.candidates.confidence import SEED_KNOTS, SHAPE_KNOTS, compute_shape_features
from lidar_perception.candidates.configurations import BEST
from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.pipeline import segment_cloud
from lidar_perception.candidates.seed_sources import make_truth_source
from lidar_perception.candidates.seeds import Seed
from lidar_perception.candidates.silhouette import compute_similarity, draw_silhouettes
from lidar_perception.data.frame import Frame
from lidar_perception.data.open import open_recording
from lidar_perception.groups import group_points
from lidar_perception.runs.files import write_text
from lidar_perception.scoring.centres.matching import find_range_bins, match_centres
from lidar_perception.training.curves import fit_curves
from lidar_perception.types import PEDESTRIAN, InputError

KITTI_PEDESTRIANS = np.array([2093, 1771, 468, 118, 37])  # number of pedestrians by range, from paper A, Table 1
DIRECTIONS = {"similarity": 1, "height_difference_m": -1}  # more similarity must not lower the confidence
OUT = Path(module.__file__).with_name("confidence.json")


def select_pedestrians(frame: Frame) -> np.ndarray:
    """Return the labelled boxes (P, 7) of a simulated scan."""
    truth = frame.truth()
    assert truth is not None
    return truth.select_class(PEDESTRIAN)


def collect_samples(frame: Frame, seed: Seed, params: PipelineParams) -> dict | None:
    """Return the features of the K clusters of a frame, compared with the seed of another frame.

    The result also has `hit` (K,) bool, and the range bins of the clusters and of the pedestrians.
    None if there are no clusters.
    """
    truth = select_pedestrians(frame)
    segmented = segment_cloud(frame.load(), frame.camera(), params)
    boxes, ids = segmented.boxes, np.arange(1, len(segmented.boxes) + 1)
    if len(boxes) == 0:
        return None
    points, start = group_points(segmented.xyz, segmented.cluster_ids, ids)
    features = compute_shape_features(points, start, boxes, params)
    images = draw_silhouettes(points, start, np.ones((len(boxes), 1)), boxes[:, 2] - boxes[:, 5] / 2, params)
    features["similarity"] = compute_similarity(images, seed.draw_silhouette(params), params.stm)
    features["height_difference_m"] = np.abs(features["height_m"] - seed.height)
    hit_indices, _ = match_centres(boxes, truth)
    return {
        "features": features,
        "hit": np.isin(np.arange(len(boxes)), hit_indices),
        "bins": find_range_bins(boxes),
        "truth": find_range_bins(truth),
    }


def find_seed(job: tuple[str, int]) -> Seed | None:
    """Return the nearest pedestrian of a frame as a seed, as in the paper's protocol; None if there is none."""
    frame = open_recording(job[0]).frames[job[1]]
    try:
        segmented = segment_cloud(frame.load(), frame.camera(), BEST)
        (seed,) = make_truth_source(select_pedestrians(frame))(segmented)
        return seed
    except InputError:
        return None


def run_job(job: tuple[tuple[str, int], Seed]) -> dict | None:
    """Collect the samples of one frame in a worker process."""
    (root, number), seed = job
    return collect_samples(open_recording(root).frames[number], seed, BEST)


def main(roots: list[str]) -> None:
    """Fit and write both models."""
    jobs = [(root, i) for root in roots for i in range(len(open_recording(root).frames))]
    with Pool() as pool:
        seeds = pool.map(find_seed, jobs, chunksize=8)
        # Each frame is compared with the seed of the next frame that has one.
        next_seeds = [next(s for s in seeds[i + 1 :] + seeds[: i + 1] if s is not None) for i in range(len(seeds))]
        results = pool.map(run_job, list(zip(jobs, next_seeds)), chunksize=8)
        frames = [result for result in results if result is not None]
    features = {name: np.concatenate([f["features"][name] for f in frames]) for name in (*SHAPE_KNOTS, *SEED_KNOTS)}
    is_hit, bins = (np.concatenate([f[name] for f in frames]) for name in ("hit", "bins"))
    pedestrians = np.bincount(np.concatenate([f["truth"] for f in frames]), minlength=5)
    kitti_fractions = KITTI_PEDESTRIANS / KITTI_PEDESTRIANS.sum()
    range_weights = kitti_fractions / np.maximum(pedestrians / pedestrians.sum(), 1e-9)
    weights = np.where(is_hit, range_weights[bins], 1.0)
    models = {
        "trained_on": {
            "frames": len(frames),
            "clusters": len(is_hit),
            "pedestrians": int(is_hit.sum()),
            "of": int(pedestrians.sum()),
            "weights_by_range": range_weights.round(2).tolist(),
        },
        "shape": fit_curves(features, is_hit, weights, SHAPE_KNOTS),
        "seed": fit_curves(features, is_hit, weights, {**SHAPE_KNOTS, **SEED_KNOTS}, DIRECTIONS),
    }
    write_text(OUT, json.dumps(models, indent=1))
    print(OUT, models["trained_on"])


if __name__ == "__main__":
    main(sys.argv[1:])
