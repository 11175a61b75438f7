"""Fit detectors/fused/fusion.json to simulated scans that no part was trained on: by class, how
much each source counts.

    lidar-perception simulate --format kitti --frames 360 --people 2.5 --seed 700000 --out scans
    python scripts/fit_fusion.py scans
"""

from __future__ import annotations

import json
import sys
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from curves import fit

from lidar_perception.classes import CAR, DETECTED
from lidar_perception.data.frame import Frame
from lidar_perception.data.open import open_recording
from lidar_perception.detectors.fused import model as module
from lidar_perception.detectors.fused.detector import Look, load_fused_detector
from lidar_perception.detectors.fused.model import KNOTS
from lidar_perception.geometry import bev_iou, centre_distances
from lidar_perception.runs.files import write_text
from lidar_perception.types import CLASSES

NEAR = 0.5  # metres from the centre of another, which is one, too
OUT = Path(module.__file__).with_name("fusion.json")


def samples(frame: Frame, look: Look) -> list[tuple[int, bool, dict[str, float]]]:
    """Class, hit and evidence of every proposal in the image; of those that hit one object the one
    with the best score, as only one is kept."""
    truth, camera, rows = frame.truth(), frame.camera(), []
    assert truth is not None and camera is not None  # as of all simulated scans
    found, in_image = look.proposed, camera.in_view(look.proposed.boxes[:, :3].copy())
    for class_id in np.unique(found.class_ids):
        own = np.flatnonzero((found.class_ids == class_id) & in_image)
        own = own[np.argsort(-found.scores[own], kind="stable")]
        boxes = truth.of_class(class_id)
        hits = bev_iou(found.boxes[own], boxes) > DETECTED[CLASSES[class_id]].relaxed
        if class_id != CAR:
            hits |= centre_distances(found.boxes[own], boxes) < NEAR
        taken = np.zeros(len(boxes), bool)
        for i, hit in zip(own, hits):
            if hit.any() and not (hit & ~taken).any():
                continue  # of an object that is found already
            if hit.any():
                taken[np.flatnonzero(hit & ~taken)[0]] = True
            rows.append((int(class_id), bool(hit.any()),
                         {name: odds[i] for name, odds in look.evidence.items()}))
    return rows


def work(job: tuple[str, int, int]) -> list:
    """samples() of every so-manieth frame, in a process of its own."""
    root, first, step = job
    detector, rows = load_fused_detector(device="cpu"), []
    for frame in open_recording(root).frames[first::step]:
        rows += samples(frame, detector.look(frame.load()))
    return rows


def main(roots: list[str], jobs: int = 2) -> None:
    with get_context("spawn").Pool(jobs) as pool:
        parts = pool.map(work, [(root, i, jobs) for root in roots for i in range(jobs)])
        rows = [row for part in parts for row in part]
    classes, counts = {}, {}
    for name in DETECTED:
        own = [row for row in rows if CLASSES[row[0]] == name]
        hit = np.array([row[1] for row in own])
        knots = {source: k for source, k in KNOTS.items()
                 if (source, name) != ("silhouette", CLASSES[CAR])}
        features = {source: np.array([row[2][source] for row in own]) for source in knots}
        classes[name] = fit(features, hit, np.ones(len(own)), knots, dict.fromkeys(knots, 1))
        counts[name] = [len(own), int(hit.sum())]
    write_text(OUT, json.dumps({"fitted_to": {"proposals, hits": counts}, "classes": classes},
                               indent=1))
    print(OUT, counts)


if __name__ == "__main__":
    main(sys.argv[1:])
