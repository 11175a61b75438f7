"""Timing of each step of every version and size of EG-PointPillars, and of the sparse engine against torch."""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import partial
from time import process_time
from typing import Any

import numpy as np
import torch
from rich.table import Table
from scipy.special import expit

from benchmark.rows import compute_speedup, make_measurement
from benchmark.timing import Clock, choose_evenly
from lidar_perception.detectors.checkpoint import Header
from lidar_perception.detectors.contract import FUSED, DetectionResult
from lidar_perception.detectors.devices import CPU, find_device
from lidar_perception.detectors.open import POINTPILLARS, open_detector
from lidar_perception.detectors.pointpillars.config import SIZES, VERSIONS, make_config
from lidar_perception.detectors.pointpillars.detector import PointPillarsDetector
from lidar_perception.detectors.pointpillars.network import make_network
from lidar_perception.detectors.pointpillars.params import STEPS
from lidar_perception.detectors.pointpillars.proposer import PointPillarsProposer
from lidar_perception.detectors.pointpillars.torch_network import TorchNetwork
from lidar_perception.runs.machine import read_cpu_name
from lidar_perception.runs.terminal import console, show_progress
from lidar_perception.runs.threads import get_thread_count, set_thread_count
from lidar_perception.types import PointCloud

PAPER_TO_V0 = {"v0": 1.0, "v1": 1.06, "v2": 1.86, "v3": 2.48, "v4": 3.54}  # time relative to V0 in paper B, RTX 4090
MAX_V4_TO_V0 = 1.6  # target: maximum ratio of the times of V4 and V0
ANCHORS_ABOVE_THRESHOLD = 200  # typical of a street
MAX_SLOW_SCANS = 3  # number of scans for the full network on a CPU, which takes half a second per scan


def measure_detection(scans: list[PointCloud], repeat: int, sizes: Sequence[str] = tuple(SIZES)) -> dict:
    """Measure the median time of each step over full scans, for all versions alternately, with torch.

    The weights are random. They affect the time only through the number of anchors above the
    threshold, so the threshold is set to have ANCHORS_ABOVE_THRESHOLD of them.
    """
    device = find_device()
    device_name = torch.cuda.get_device_name(device) if device != CPU else read_cpu_name()
    content: dict[str, Any] = {"device": device_name, "threads": get_thread_count(), "sizes": {}}
    for size in sizes:
        selected_scans = choose_evenly(scans, MAX_SLOW_SCANS) if (size, device) == ("full", CPU) else scans
        detectors = {version: _make_detector(version, size, device, selected_scans[0]) for version in VERSIONS}
        content["sizes"][size] = {
            "frames": len(selected_scans),
            "points": float(np.median([len(s) for s in selected_scans])),
            "versions": _compute_medians(detectors, selected_scans, repeat, f"PointPillars {size}"),
        }
    return content


def _compute_medians(
    detectors: dict[str, PointPillarsDetector], scans: list[PointCloud], repeat: int, title: str
) -> dict[str, dict]:
    ms = {version: np.zeros((len(scans), repeat, len(STEPS))) for version in detectors}
    for i, scan in enumerate(show_progress(scans, title, len(scans))):
        for j in range(repeat):
            for version, detector in detectors.items():
                timings = detector(scan).timings
                ms[version][i, j] = [timings[step] for step in STEPS]
    results_by_version: dict[str, dict] = {}
    for version, runs in ms.items():
        steps = np.median(np.median(runs, axis=1), axis=0)
        total = float(np.median(np.median(runs.sum(axis=2), axis=1)))
        results_by_version[version] = {
            "ms": dict(zip(STEPS, steps.tolist())),
            "total_ms": total,
            "share": dict(zip(STEPS, (steps / steps.sum()).tolist())),
            "to_v0": total / results_by_version["v0"]["total_ms"] if results_by_version else 1.0,
            "paper_to_v0": PAPER_TO_V0[version],
        }
    return results_by_version


class RecordingNetwork:
    """A network that stores its last logits (A, K)."""

    has_fixed_range = True

    def __init__(self, network: TorchNetwork):
        self.network = network
        self.logits: np.ndarray | None = None

    def to(self, device: str) -> None:
        """See Network.to."""
        self.network.to(device)

    def __call__(self, pillars, maps):
        prediction = self.network(pillars, maps)
        self.logits = prediction[0]
        return prediction


def _make_detector(version: str, size: str, device: str, scan: PointCloud) -> PointPillarsDetector:
    """Return a warmed-up detector whose threshold is exceeded by ANCHORS_ABOVE_THRESHOLD anchors in this scan."""
    config = make_config(version, size)
    torch.manual_seed(0)
    recording = RecordingNetwork(TorchNetwork(make_network(config).eval(), device))
    detector = PointPillarsDetector(PointPillarsProposer(recording, Header(config), device))
    detector.warm_up()
    detector(scan)
    assert recording.logits is not None
    scores = np.sort(expit(recording.logits.max(axis=1)))
    threshold = float(scores[-min(ANCHORS_ABOVE_THRESHOLD, len(scores))])
    detector = detector.with_min_score(threshold)
    detector.proposer.network = recording.network
    detector(scan)
    return detector


def print_detection(content: dict) -> None:
    """Print a table for each size, with the time of each step and its fraction of the total."""
    for size, results in content["sizes"].items():
        table = Table(
            title=f"EG-PointPillars {size}, ms per frame ({results['frames']} scans, "
            f"{results['points']:.0f} points) on {content['device']}, "
            f"{content['threads']} CPU threads, random weights"
        )
        for name in ("version", *STEPS, "total", "to v0", "paper's"):
            table.add_column(name, justify="left" if name == "version" else "right")
        for version, version_results in results["versions"].items():
            table.add_row(
                version,
                *(
                    f"{version_results['ms'][step]:.1f} ({100 * version_results['share'][step]:.0f} %)"
                    for step in STEPS
                ),
                f"{version_results['total_ms']:.1f}",
                f"{version_results['to_v0']:.2f}",
                f"{version_results['paper_to_v0']:.2f}",
            )
        console.print(table)
        ratio = results["versions"]["v4"]["to_v0"]
        console.print(
            f"v4 takes {ratio:.2f} times as long as v0, target < {MAX_V4_TO_V0}: "
            + ("met" if ratio < MAX_V4_TO_V0 else "not met")
        )


def measure_engines(scans: list[PointCloud], repeat: int, detectors: Sequence[str] = (POINTPILLARS, FUSED)) -> dict:
    """Compare PointPillars' engines torch and sparse with the shipped weights.

    Measures the median CPU time with one thread. `same` is the number of scans with equal
    detections.
    """
    threads = get_thread_count()
    set_thread_count(1)
    rows = []
    for weights in detectors:
        for range_name in "ahead", "around":
            engines = {
                name: open_detector(
                    weights, "cpu", range=range_name, settings={f"{weights}.threads": 1, f"{weights}.engine": engine}
                )
                for name, engine in (("torch", "torch"), ("ours", "sparse"))
            }
            name, same_count = f"{weights} {range_name}, engine torch", 0
            clock = Clock(repeat, {}, process_time)
            for scan in show_progress(scans, name, len(scans)):
                results = clock.time({engine: partial(detector, scan) for engine, detector in engines.items()})
                same_count += _have_same_detections(results["torch"], results["ours"])
            ms = clock.compute_medians()
            rows.append(compute_speedup(name, {name: ms["torch"], "ours": ms["ours"]}, same=same_count))
    set_thread_count(threads)
    title = f"Sparse engine, CPU ms of one thread at a load of {os.getloadavg()[0]:.1f}"
    return make_measurement(title, len(scans), np.median([len(scan) for scan in scans]), rows)


def _have_same_detections(first: DetectionResult, second: DetectionResult) -> bool:
    a, b = first.detections, second.detections
    return bool(
        np.array_equal(a.class_ids, b.class_ids)
        and np.allclose(a.boxes, b.boxes, rtol=0, atol=1e-4)
        and np.allclose(a.scores, b.scores, rtol=0, atol=1e-5)
    )
