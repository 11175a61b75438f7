"""Timing of paper C's network against PointNet++, and of the steps of the complete detector."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
import torch
from rich.table import Table

from benchmark.plain_pointnet2 import PlainPointNet2
from benchmark.timing import Calls, time_interleaved
from lidar_perception.clustering.cluster import cluster_obstacles
from lidar_perception.detectors.checkpoint import Header
from lidar_perception.detectors.pointnet.classifier import PointNetClassifier
from lidar_perception.detectors.pointnet.clusters import Clusters, make_clusters, make_network_input
from lidar_perception.detectors.pointnet.config import make_pointnet_config
from lidar_perception.detectors.pointnet.detector import PointNetDetector
from lidar_perception.detectors.pointnet.network import PointNet, fuse_norms
from lidar_perception.detectors.pointnet.params import STEPS
from lidar_perception.detectors.pointnet.predict import predict
from lidar_perception.detectors.pointnet.torch_network import TorchPointNet
from lidar_perception.ground.segment import segment_ground
from lidar_perception.runs.terminal import console
from lidar_perception.runs.threads import get_thread_count
from lidar_perception.types import PointCloud

MAX_CLUSTERS = 100  # maximum number of clusters of a scan for the networks
MAX_NETWORK_MS, MAX_DETECTOR_MS = 40.0, 120.0  # targets for the network and for the complete detector


def measure_pointnet(scans: Sequence[PointCloud], repeat: int) -> dict:
    """Measure median times over full scans.

    The networks have random weights, which do not affect the time, and process at most MAX_CLUSTERS
    clusters of each scan. The detector processes all clusters.
    """
    torch.manual_seed(0)
    config = make_pointnet_config()
    networks = {
        name: TorchPointNet(fuse_norms(PointNet(make_pointnet_config(name))))
        for name in ("improved", "pointnet2", "pointnet")
    }
    plain = PlainPointNet2(config).eval()
    detector = PointNetDetector(PointNetClassifier(TorchPointNet(fuse_norms(PointNet(config)), "auto"), Header(config)))
    detector.warm_up()
    rows, steps, counts = [], [], []
    for scan in scans:
        ground = segment_ground(scan, config.ground)
        cluster_ids = cluster_obstacles(scan.xyz, ground, config.clustering)
        all_clusters = make_clusters(scan, cluster_ids, 5, ground)
        clusters = all_clusters.take(np.arange(min(MAX_CLUSTERS, len(all_clusters))))
        calls: Calls = {name: partial(predict, network, clusters) for name, network in networks.items()}
        calls["plain PointNet++ (SSG)"] = partial(_predict_plain, plain, clusters, config.points)
        calls["detector"] = partial(detector, scan)
        time_interleaved(calls, 1)
        ms, results = time_interleaved(calls, repeat)
        rows.append(ms)
        steps.append([results["detector"].timings[step] for step in STEPS])
        counts.append((len(clusters), len(all_clusters), len(scan)))
    medians = np.median(counts, axis=0)
    return {
        "clusters": float(medians[0]),
        "all_clusters": float(medians[1]),
        "points": float(medians[2]),
        "threads": get_thread_count(),
        "scans": len(rows),
        "ms": {name: float(np.median([row[name] for row in rows])) for name in rows[0]},
        "steps": dict(zip(STEPS, np.median(steps, axis=0).tolist())),
    }


@torch.inference_mode()
def _predict_plain(network: PlainPointNet2, clusters: Clusters, count: int) -> torch.Tensor:
    return network(torch.from_numpy(make_network_input(clusters, count).points))


def print_pointnet(content: dict) -> None:
    """Print a table of the networks, and the times of the network and the detector with their targets."""
    ms = content["ms"]
    table = Table(
        title=f"Paper C's network, ms for {content['clusters']:.0f} clusters, "
        f"{content['threads']} CPU threads, random weights"
    )
    for name in ("network", "ms", "to ours"):
        table.add_column(name, justify="left" if name == "network" else "right")
    titles = {
        "improved": "improved PointNet (ours)",
        "pointnet2": "PointNet++ (SSG), ours",
        "pointnet": "PointNet, ours",
    }
    for name in (*titles, "plain PointNet++ (SSG)"):
        table.add_row(titles.get(name, name), f"{ms[name]:.1f}", f"{ms[name] / ms['improved']:.2f}")
    console.print(table)
    console.print(
        f"network {ms['improved']:.1f} ms, target < {MAX_NETWORK_MS:.0f}: "
        f"{'met' if ms['improved'] < MAX_NETWORK_MS else 'not met'}"
    )
    steps = ", ".join(f"{step} {value:.1f}" for step, value in content["steps"].items())
    console.print(
        f"complete detector {ms['detector']:.1f} ms ({steps}) for {content['points']:.0f} "
        f"points, {content['all_clusters']:.0f} clusters, target < {MAX_DETECTOR_MS:.0f}: "
        f"{'met' if ms['detector'] < MAX_DETECTOR_MS else 'not met'}"
    )
