"""Comparison of our clustering with its peers.

Clouds are points (N, 3) float32 without ground, unless a function says otherwise.
"""

from __future__ import annotations

from collections import Counter
from functools import partial

import numpy as np
from scipy.spatial import cKDTree

from benchmark import peers, plain_euclidean
from benchmark.rows import add_target, compute_speedup, make_measurement, make_row
from benchmark.timing import SLOW_REPEAT, Clock, choose_evenly, run_in_child, thin_cloud
from lidar_perception.clustering.dbscan import distance_aware_dbscan
from lidar_perception.clustering.euclidean import cluster_euclidean
from lidar_perception.clustering.params import DbscanParams, EuclideanParams
from lidar_perception.ground.cloth import segment_by_cloth
from lidar_perception.runs.terminal import show_progress

PLAIN = "SciPy and NumPy"


def measure_dbscan(title: str, clouds: list[np.ndarray], repeat: int, target: float) -> dict:
    """Measure our DBSCAN and those of peers.py, with paper A's range bands.

    The target is for the faster of the two scikit-learn variants. Labels, including those of border
    points, must be equal to scikit-learn's. For other peers, the noise and the partition of the core
    points must be equal.
    """
    installed_peers = [p for p in peers.DBSCANS if not p.find_problem()]
    rows = {p.name: make_row(p.name, note=p.find_problem()) for p in peers.DBSCANS}
    ms: dict[str, float] = {}
    for group, run in (
        ([p for p in installed_peers if p != peers.WHEEL], measure_dbscans),
        ([p for p in installed_peers if p == peers.WHEEL], partial(run_in_child, measure_dbscans)),
    ):
        if group:
            times, same_counts, differ_counts = run([peers.DBSCANS.index(p) for p in group], clouds, repeat, title)
            ms |= times
            rows |= {
                p.name: compute_speedup(p.name, times, None, same_counts[p.name], differ_counts[p.name]) for p in group
            }
    faster_peer = min((p.name for p in peers.SKLEARN), key=lambda name: ms[name])
    rows[faster_peer] = add_target(rows[faster_peer], target)
    return make_measurement(title, len(clouds), np.median([len(c) for c in clouds]), list(rows.values()))


def measure_dbscans(
    indices: list[int], clouds: list[np.ndarray], repeat: int, title: str
) -> tuple[dict, Counter, Counter]:
    """Measure our DBSCAN and some peers.

    Args:
        indices: Indices into peers.DBSCANS. Unlike peers, they can be sent to a child process.
        clouds: Clouds to cluster.
        repeat: Runs per cloud.
        title: Title of the progress bar.

    Returns:
        Median times, the number of clouds with equal results, and the number of points that are
        noise only for the peer or only for us.
    """
    group = [peers.DBSCANS[i] for i in indices]

    def make_calls(xyz):
        return {
            **{p.name: partial(peers.cluster_by_bands, p.run, xyz) for p in group},
            "ours": partial(distance_aware_dbscan, xyz),
        }

    clock = Clock(repeat, make_calls(thin_cloud(clouds[0])))
    same_counts: Counter[str] = Counter()
    differ_counts: Counter[str] = Counter()
    for xyz in show_progress(clouds, title, len(clouds)):
        results = clock.time(make_calls(xyz))
        our_labels, is_core = results["ours"], find_core_points(xyz)
        for p in group:
            peer_labels = results[p.name]
            same_counts[p.name] += (
                np.array_equal(peer_labels, our_labels)
                if p in peers.SKLEARN
                else have_same_clusters(peer_labels, our_labels, is_core)
            )
            differ_counts[p.name] += int(((peer_labels == 0) != (our_labels == 0)).sum())
    return clock.compute_medians(), same_counts, differ_counts


def measure_euclidean(clouds: list[np.ndarray], threshold: str, repeat: int) -> dict:
    """Measure our Euclidean clustering and plain_euclidean.

    With the local threshold plain_euclidean takes seconds, so only half of the clouds are used.
    """
    params = EuclideanParams(threshold=threshold)
    if threshold == "local":
        clouds, repeat = choose_evenly(clouds, (len(clouds) + 1) // 2), min(repeat, SLOW_REPEAT)

    def make_calls(xyz):
        return {
            PLAIN: partial(plain_euclidean.cluster_euclidean, xyz, params),
            "ours": partial(cluster_euclidean, xyz, params),
        }

    title = f"Adaptive Euclidean, {threshold} threshold, full scan"
    clock, same_count = Clock(repeat, make_calls(thin_cloud(clouds[0]))), 0
    for xyz in show_progress(clouds, title, len(clouds)):
        results = clock.time(make_calls(xyz))
        same_count += have_same_clusters(results[PLAIN], results["ours"], results["ours"] > 0)
    rows = [compute_speedup(PLAIN, clock.compute_medians(), 3, same_count)]
    return make_measurement(title, len(clouds), np.median([len(c) for c in clouds]), rows)


def measure_paper_c(scans: list[np.ndarray], repeat: int) -> dict:
    """Measure paper C's segmentation of full scans: cloth, then Euclidean clustering."""

    def segment(xyz, threshold):
        obstacles = xyz.compress(~segment_by_cloth(xyz), axis=0)
        return cluster_euclidean(obstacles, EuclideanParams(threshold=threshold))

    def make_calls(xyz):
        return {"cloth": partial(segment_by_cloth, xyz), **{t: partial(segment, xyz, t) for t in ("global", "local")}}

    title = "Paper C: cloth and Euclidean, full scan"
    clock = Clock(repeat, make_calls(thin_cloud(scans[0])))
    for xyz in show_progress(scans, title, len(scans)):
        clock.time(make_calls(xyz))
    ms = clock.compute_medians()
    rows = [make_row(f"({t} threshold)", ours_ms=ms[t], value=ms[t], unit="ms", target=60) for t in ("global", "local")]
    return make_measurement(title, len(scans), np.median([len(s) for s in scans]), rows, cloth_ms=ms["cloth"])


def find_core_points(xyz: np.ndarray, params: DbscanParams = DbscanParams()) -> np.ndarray:
    """Return the mask (N,) of points that have at least min_samples points of their range band within eps."""

    def label_core_points(band, eps, min_samples):
        tree = cKDTree(band.astype(np.float64))
        counts = tree.query_ball_point(tree.data, eps, return_length=True)
        return np.where(counts >= min_samples, 0, -1)

    return peers.cluster_by_bands(label_core_points, xyz, params) > 0


def have_same_clusters(a: np.ndarray, b: np.ndarray, is_core: np.ndarray) -> bool:
    """Return True if labels a and b (N,) have the same noise points (0) and partition the core points equally."""
    if not np.array_equal(a == 0, b == 0):
        return False
    pairs = np.unique(np.stack([a[is_core], b[is_core]]), axis=1)
    return all(len(np.unique(side)) == pairs.shape[1] for side in pairs)
