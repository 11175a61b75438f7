"""Our tracker and AB3DMOT on simulated drives that were not used to tune parameters, with intervals.

    python -m benchmark.drives --drives 20 --seconds 20 --cache folder --json tracks.json

Detections are computed once and kept in --cache: simulation and networks take a second per frame,
the trackers milliseconds.
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
from lidar_perception.candidates.seed_sources import make_automatic_source
from lidar_perception.candidates.seeds import load_seeds
from lidar_perception.classes import DETECTED
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
    """Detect in the first scans of a street with each detector, weak detections included."""
    params = with_values(BEST, {"seed.source": "automatic"})
    detectors: dict[str, Detector] = {
        "candidates": CandidateDetector(make_automatic_source(load_seeds(), params), FORWARD_CAMERA.camera(), params),
        **{name: open_detector(name, "cpu") for name in NETWORKS},
    }
    detectors = {name: detector.with_min_score(MIN_DETECTION_SCORE) for name, detector in detectors.items()}
    drive = []
    for i in range(frames):
        scan = simulate_scan(street, i, HDL64E, Scenes(None, people))
        detections = {name: _detect_street(detector, scan.frame) for name, detector in detectors.items()}
        drive.append(
            (TrackedFrame(Detections.none(), make_kitti_labels(scan.truth), scan.frame.stamp_ns, scan.pose), detections)
        )
    return drive


def _detect_street(detector: Detector, frame) -> Detections:
    try:
        return detector(frame).detections
    except InputError:  # the frame has no seed
        return Detections.none()


def load_detections(folder: Path, street: int, frames: int, people: float) -> Drive:
    """Load the result of detect() from a folder; compute and save it there if it is missing."""
    file = folder / f"{street}_{frames}_{people:g}.pkl"
    if not file.exists():
        folder.mkdir(parents=True, exist_ok=True)
        part = file.with_suffix(".part")
        part.write_bytes(pickle.dumps(detect(street, frames, people)))
        part.rename(file)
    return pickle.loads(file.read_bytes())


def count_tracks(drive: list[TrackedFrame], step: Step, classes: tuple[str, ...]) -> Counts:
    """Count the tracks of a drive by class."""
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
    selected = [[replace(seen, found=found[detector]) for seen, found in drive] for drive in drives]
    peers = [count_tracks(drive, make_peer_step(PlainAb3dmot(), min_score), classes) for drive in selected]
    ours = [count_tracks(drive, make_tracker_step(params), classes) for drive in selected]
    return {name: _compare_scores([p[name] for p in peers], [o[name] for o in ours]) for name in classes}


def _compare_scores(peers: list[tuple], ours: list[tuple]) -> dict:
    labels = [clear.tp + clear.fn for _, clear in ours]
    scores = {}
    for name, drive_counts in ("peer", peers), ("ours", ours):
        clear = sum((c for _, c in drive_counts), ClearCounts())
        hota = resample(drive_counts, lambda drawn: sum((h for h, _ in drawn), HotaCounts()).compute_scores()["HOTA"])
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
        "labels": sum(labels),
        **scores,
        "gain": scores["ours"]["HOTA"] - scores["peer"]["HOTA"],
        "gain_interval": _compute_interval(difference),
    }


def resample(drives: list, value: Callable[[list], float]) -> np.ndarray:
    """Return values (RESAMPLE_COUNT,) over drives drawn with replacement.

    The draws are the same for the same number of drives, so differences are paired.
    """
    draws = np.random.default_rng(0).integers(0, len(drives), (RESAMPLE_COUNT, len(drives)))
    return np.array([value([drives[i] for i in draw]) for draw in draws])


def _compute_interval(values: np.ndarray) -> list[float]:
    return [float(v) for v in np.percentile(values, INTERVAL_PERCENTILES)]


def print_drives(content: dict) -> None:
    """Print a row per detector and class: the peer, then ours, in percent."""
    table = Table(title=f"{content['drives']} drives of {content['seconds']:g} s")
    for name in "detector", "class", "boxes", "HOTA", "gain", "switches", "precision", "recall":
        table.add_column(name)
    for detector, classes in content["detectors"].items():
        for name, scores in classes.items():
            pair = [
                f"{100 * scores['peer'][k]:.1f}, {100 * scores['ours'][k]:.1f}" for k in ("HOTA", "precision", "recall")
            ]
            table.add_row(
                detector,
                name,
                str(scores["labels"]),
                pair[0],
                f"{100 * scores['gain']:+.1f} [{_format_interval(scores['gain_interval'])}]",
                f"{scores['peer']['switches']}, {scores['ours']['switches']}",
                *pair[1:],
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
