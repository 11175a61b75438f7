"""Comparison of our tracker with AB3DMOT on simulated drives that were not used for tuning, with intervals.

    python -m benchmark.drives --drives 20 --seconds 20 --cache folder --json tracks.json

Detections are computed once and stored in --cache, because simulation and networks take a second per
frame, but the trackers only milliseconds.
"""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import click
import numpy as np
from rich.table import Table

from benchmark.plain_ab3dmot import PlainAb3dmot
from benchmark.tracking import Step, TrackedFrame, make_peer_step, make_tracker_step
from lidar_perception.candidates.configurations import BEST
from lidar_perception.classes import DETECTED
from lidar_perception.detectors.automatic_seed import make_automatic_source
from lidar_perception.detectors.candidates import CandidateDetector
from lidar_perception.detectors.contract import Detector
from lidar_perception.detectors.open import open_detector
from lidar_perception.detectors.params import ScoreParams
from lidar_perception.param_fields import with_values
from lidar_perception.runs.files import write_text
from lidar_perception.runs.terminal import console, show_progress
from lidar_perception.scoring.tracking.clear import ClearCounts, count_clear
from lidar_perception.scoring.tracking.hota import HotaCounts, count_hota
from lidar_perception.scoring.tracking.pairs import drop_ignored, make_pairs, to_tracked_labels
from lidar_perception.simulation.camera import FORWARD_CAMERA, make_kitti_labels
from lidar_perception.simulation.drive import simulate_scan
from lidar_perception.simulation.scene import Scenes
from lidar_perception.simulation.sensor import HDL64E
from lidar_perception.tracking.params import TrackingParams
from lidar_perception.types import Detections, InputError

# Detector -> (classes, minimum score of the detections passed to the peer).
NETWORKS = ("fused", "pointpillars", "pointnet")
DETECTORS = {
    **dict.fromkeys(NETWORKS, (tuple(DETECTED), ScoreParams().car)),
    "candidates": (("Pedestrian",), BEST.confidence.threshold),
}
RESAMPLE_COUNT, MIN_DETECTION_SCORE, INTERVAL_PERCENTILES = 2000, 0.001, (2.5, 97.5)
Drive = list[tuple[TrackedFrame, dict[str, Detections]]]
Counts = dict[str, tuple[HotaCounts, ClearCounts]]


def detect(street: int, frames: int, people: float) -> Drive:
    """Run each detector on the first scans of a street. The result includes detections with low scores."""
    params = with_values(BEST, {"seed.source": "automatic"})
    detectors: dict[str, Detector] = {
        "candidates": CandidateDetector(make_automatic_source(params.seed), FORWARD_CAMERA.camera(), params),
        **{name: open_detector(name, "cpu") for name in NETWORKS},
    }
    detectors = {name: detector.with_min_score(MIN_DETECTION_SCORE) for name, detector in detectors.items()}
    drive = []
    for i in range(frames):
        scan = simulate_scan(street, i, HDL64E, Scenes(None, people))
        detections = {name: _detect_in_scan(detector, scan.frame) for name, detector in detectors.items()}
        drive.append(
            (TrackedFrame(Detections.none(), make_kitti_labels(scan.truth), scan.frame.stamp_ns, scan.pose), detections)
        )
    return drive


def _detect_in_scan(detector: Detector, cloud) -> Detections:
    try:
        return detector(cloud).detections
    except InputError:  # STM-CPA found no seed
        return Detections.none()


def load_detections(folder: Path, street: int, frames: int, people: float) -> Drive:
    """Load the result of detect() from a folder. If it is missing, compute it and save it there."""
    file = folder / f"{street}_{frames}_{people:g}.pkl"
    if not file.exists():
        folder.mkdir(parents=True, exist_ok=True)
        temporary_file = file.with_suffix(".part")
        temporary_file.write_bytes(pickle.dumps(detect(street, frames, people)))
        temporary_file.rename(file)
    return pickle.loads(file.read_bytes())


def count_tracks(drive: list[TrackedFrame], step: Step, classes: tuple[str, ...]) -> Counts:
    """Compute the HOTA and CLEAR counts of a tracker on a drive by class."""
    frames = []
    for frame in drive:
        ids, detections = step(frame)
        frames.append(make_pairs(frame.truth, to_tracked_labels(ids, detections), FORWARD_CAMERA))
    return {
        name: (count_hota(pairs := [drop_ignored(f[name]) for f in frames]), count_clear(pairs)) for name in classes
    }


def measure_drives(drives: list[Drive], detector: str, params: TrackingParams) -> dict:
    """Return the scores of both trackers with intervals, by class."""
    classes, min_score = DETECTORS[detector]
    tracked_drives = [
        [replace(frame, detections=detections[detector]) for frame, detections in drive] for drive in drives
    ]
    peer_counts = [count_tracks(drive, make_peer_step(PlainAb3dmot(), min_score), classes) for drive in tracked_drives]
    our_counts = [count_tracks(drive, make_tracker_step(params), classes) for drive in tracked_drives]
    return {
        name: _compare_scores([counts[name] for counts in peer_counts], [counts[name] for counts in our_counts])
        for name in classes
    }


def _compare_scores(peer_counts: list[tuple], our_counts: list[tuple]) -> dict:
    label_counts = [clear.tp + clear.fn for _, clear in our_counts]
    scores = {}
    for name, drive_counts in ("peer", peer_counts), ("ours", our_counts):
        clear = sum((c for _, c in drive_counts), ClearCounts())
        hota = resample(drive_counts, lambda sample: sum((h for h, _ in sample), HotaCounts()).compute_scores()["HOTA"])
        scores[name] = {
            **sum((h for h, _ in drive_counts), HotaCounts()).compute_scores(),
            **clear.compute_scores(),
            "interval": _compute_interval(hota),
            "switches": clear.switches,
            "fragments": clear.fragments,
            "hits": clear.tp,
            "false": clear.fp,
        }
        scores[name]["values"] = hota
    difference = np.subtract(scores["ours"].pop("values"), scores["peer"].pop("values"))
    return {
        "labels": sum(label_counts),
        **scores,
        "gain": scores["ours"]["HOTA"] - scores["peer"]["HOTA"],
        "gain_interval": _compute_interval(difference),
    }


def resample(drives: list, compute: Callable[[list], float]) -> np.ndarray:
    """Compute a value (RESAMPLE_COUNT,) for each of many samples of the drives, drawn with replacement.

    Equal numbers of drives are sampled in the same way, so that differences are paired.
    """
    samples = np.random.default_rng(0).integers(0, len(drives), (RESAMPLE_COUNT, len(drives)))
    return np.array([compute([drives[i] for i in sample]) for sample in samples])


def _compute_interval(values: np.ndarray) -> list[float]:
    return [float(v) for v in np.percentile(values, INTERVAL_PERCENTILES)]


def print_drives(content: dict) -> None:
    """Print a row per detector and class, with the peer's value followed by ours, in percent."""
    table = Table(title=f"{content['drives']} drives of {content['seconds']:g} s")
    for name in "detector", "class", "boxes", "HOTA", "gain", "switches", "precision", "recall":
        table.add_column(name)
    for detector, classes in content["detectors"].items():
        for name, scores in classes.items():
            hota, precision, recall = (
                f"{100 * scores['peer'][k]:.1f}, {100 * scores['ours'][k]:.1f}" for k in ("HOTA", "precision", "recall")
            )
            table.add_row(
                detector,
                name,
                str(scores["labels"]),
                hota,
                f"{100 * scores['gain']:+.1f} [{_format_interval(scores['gain_interval'])}]",
                f"{scores['peer']['switches']}, {scores['ours']['switches']}",
                precision,
                recall,
            )
    console.print(table)


def _format_interval(interval: list[float]) -> str:
    return " .. ".join(f"{100 * v:+.1f}" for v in interval)


@click.command()
@click.option("--first", default=8301, show_default=True, help="Seed of the first street.")
@click.option("--drives", "count", type=click.IntRange(1), default=20, show_default=True)
@click.option("--seconds", type=click.FloatRange(0.1, 20.0), default=20.0, show_default=True)
@click.option(
    "--people",
    type=click.FloatRange(0),
    default=4.0,
    show_default=True,
    help="Number of pedestrians and cyclists relative to KITTI.",
)
@click.option("--cache", type=click.Path(path_type=Path), required=True, help="Folder for the detections.")
@click.option("--json", "json_file", type=click.Path(path_type=Path))
def main(first: int, count: int, seconds: float, people: float, cache: Path, json_file: Path | None) -> None:
    """Compare our tracker with a plain AB3DMOT on simulated drives."""
    frames = round(seconds * HDL64E.rate)
    drives = [
        load_detections(cache, street, frames, people)
        for street in show_progress(range(first, first + count), "detecting", count)
    ]
    content = {
        "drives": count,
        "seconds": seconds,
        "people": people,
        "first": first,
        "detectors": {name: measure_drives(drives, name, TrackingParams()) for name in DETECTORS},
    }
    print_drives(content)
    if json_file:
        write_text(json_file, json.dumps(content, indent=1))


if __name__ == "__main__":
    main(prog_name="python -m benchmark.drives")
