"""The curves of the fused detector, fitted to simulated scans of a sensor: how sure PointPillars,
silhouettes and the cluster network are together. See detectors/fused/model.py."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lidar_perception.classes import CAR, DETECTED
from lidar_perception.data.frame import Frame
from lidar_perception.detectors.checkpoint import NETWORKS
from lidar_perception.detectors.fused.detector import FusedDetector, Look, load_fused_detector
from lidar_perception.detectors.fused.evidence import Evidence
from lidar_perception.detectors.fused.fusion import KNOTS, Models, package_models, write_fusion
from lidar_perception.detectors.fused.model import probabilities
from lidar_perception.detectors.fused.params import FusedDetectorParams, FusedParams
from lidar_perception.detectors.params import ScoreParams
from lidar_perception.geometry import bev_iou, centre_distances
from lidar_perception.runs.processes import in_processes
from lidar_perception.runs.terminal import errors, track
from lidar_perception.scoring.kitti.protocol import NEIGHBOURS
from lidar_perception.simulation.scene import Scenes
from lidar_perception.simulation.sensor import sensor_named
from lidar_perception.training.curves import fit
from lidar_perception.training.params import FusedTraining
from lidar_perception.training.scenes import SimulatedScenes
from lidar_perception.training.sources import FIRST_FITTED_SCENE
from lidar_perception.training.trained_for import as_trained, trained_height
from lidar_perception.types import CLASSES, SENSOR_HEIGHT

NEAR = 0.5   # metres from the centre of a person, or of a cyclist: is one, too
FEWEST = 20  # proposals of a class that are right, and as many that are wrong, to fit curves to
LEAST = 1e-6  # probability, for the log loss


@dataclass(frozen=True)
class Samples:
    """K proposals: of which class (K,) int, right or not (K,) bool, in which scan (K,) int, and
    what each source says of them."""

    class_ids: np.ndarray
    right: np.ndarray
    scans: np.ndarray
    evidence: Evidence

    def take(self, chosen: np.ndarray) -> Samples:
        """Those of a mask or indices."""
        return Samples(self.class_ids[chosen], self.right[chosen], self.scans[chosen],
                       {name: odds[chosen] for name, odds in self.evidence.items()})

    @staticmethod
    def together(parts: Sequence[Samples]) -> Samples:
        """All of one or more."""
        joined = np.concatenate
        return Samples(joined([part.class_ids for part in parts]),
                       joined([part.right for part in parts]),
                       joined([part.scans for part in parts]),
                       {name: joined([part.evidence[name] for part in parts])
                        for name in parts[0].evidence})


class Judged(NamedTuple):
    """How curves do on proposals: their mean log loss, and of those that reach the threshold how
    many are right, and how many wrong."""

    loss: float
    right: int
    wrong: int


class Fitted(NamedTuple):
    """Of a class: its proposals, how many are right, and how the curves before, and curves fitted
    to the other half of the scans, do on each half; after is None where there are too few."""

    proposals: int
    right: int
    before: Judged
    after: Judged | None


def fuse(weights: Path | None, classifier: Path | None, out: Path, params: FusedTraining,
         jobs: int = 1) -> dict[str, Fitted]:
    """Fit the curves of both networks, those that come with the package where they are None, and
    write them to out, see fusion.py; how they do, by class. InputError for what cannot be used,
    before a scan is made."""
    own = FusedParams(weights=str(weights or ""), classifier=str(classifier or ""),
                      range=params.range, threads=1, warm_up=False)
    detector = load_fused_detector("", "cpu", FusedDetectorParams(fused=own))
    header, other = detector.header, detector.classifier.header
    params = as_trained(params, header)
    sensor = sensor_named(params.sensor, params.mount_height or trained_height(header))
    scenes = Scenes(None, params.people, params.scene)
    scenes.sorts()  # InputError for what is none
    around = bool(detector.config.low[0] < 0)
    errors.print(f"{params.scans} {params.scene} scans of {params.sensor} at {sensor.height:g} m, "
                 f"{'all around' if around else 'ahead'}")
    for network in header, other:
        if said := network.unlike(sensor.height):
            errors.print(f"{NETWORKS[network.network][0]}: {said}")
    source = SimulatedScenes(FIRST_FITTED_SCENE, params.scans, sensor, scenes, around=around)
    models, judged = fitted(looked_at(FusedDetectorParams(fused=own), source, jobs),
                            package_models())
    write_fusion(out, (weights, classifier), models, {
        "sensor": params.sensor, "height": sensor.height, "scene": params.scene,
        "scans": params.scans, "range": "around" if around else "ahead",
        "proposals, hits": {name: [own.proposals, own.right] for name, own in judged.items()}})
    return judged


def samples_of(frame: Frame, look: Look, scan: int) -> Samples:
    """The proposals in the image, or all where there is no camera; of those that are right about
    one object the one with the best score, as only one is kept. Those of what only looks like the
    class, a van for a car, are left out, as they count neither way where detections are scored."""
    truth, camera, found = frame.truth(), frame.camera(), look.proposed
    assert truth is not None  # as of all simulated scans
    centres = found.boxes[:, :3] - np.array([0, 0, frame.sensor_height - SENSOR_HEIGHT], np.float32)
    seen = np.ones(len(found), bool) if camera is None else camera.in_view(centres)
    kept, right = [], []
    for class_id in np.unique(found.class_ids):
        own = np.flatnonzero((found.class_ids == class_id) & seen)
        own = own[np.argsort(-found.scores[own], kind="stable")]
        name, boxes = CLASSES[class_id], found.boxes[own]
        hits = _right_about(boxes, truth.of_class(class_id), name)
        alike = truth.of_class(CLASSES.index(NEIGHBOURS.get(name, name)))
        taken = np.zeros(hits.shape[1], bool)
        for i, hit, other in zip(own, hits, _right_about(boxes, alike, name)):
            free = np.flatnonzero(hit & ~taken)
            if not len(free) and (hit.any() or other.any()):
                continue  # of an object that is found already, or of what looks like one
            taken[free[:1]] = True
            kept.append(i)
            right.append(len(free) > 0)
    chosen = np.array(kept, np.int64)
    return Samples(found.class_ids[chosen], np.array(right, bool), np.full(len(chosen), scan),
                   {name: odds[chosen] for name, odds in look.evidence.items()})


def _right_about(boxes: np.ndarray, objects: np.ndarray, name: str) -> np.ndarray:
    """(K, M) bool: which of boxes (K, 7) proposed as a class are right about which of its objects
    (M, 7)."""
    hits = bev_iou(boxes, objects) > DETECTED[name].relaxed
    if name != CLASSES[CAR]:
        hits |= centre_distances(boxes, objects) < NEAR
    return hits


def looked_at(params: FusedDetectorParams, scenes: SimulatedScenes, jobs: int) -> Samples:
    """The proposals in all scans; the same with any number of processes."""
    parts = sorted(track(in_processes(partial(_looker, params, scenes), range(len(scenes)), jobs,
                                      "looked at simulated scans"),
                         "simulating and looking", len(scenes)), key=lambda part: part[0])
    return Samples.together([part for _, part in parts])


def _looker(params: FusedDetectorParams,
            scenes: SimulatedScenes) -> Callable[[int], tuple[int, Samples]]:
    detector: FusedDetector = load_fused_detector("", "cpu", params)

    def look(i: int) -> tuple[int, Samples]:
        frame = scenes.frame(i)
        seen = detector.mounted_at(frame.sensor_height).look(frame.load())
        return i, samples_of(frame, seen, i)
    return look


def fitted(samples: Samples, before: Models) -> tuple[Models, dict[str, Fitted]]:
    """By class, the curves; those of before, if it has any, where there is too little to fit them
    to. And how both do on scans that they were not fitted to."""
    models, judged = dict(before), {}
    for name in DETECTED:
        own = samples.take(samples.class_ids == CLASSES.index(name))
        after = None
        if enough(own):
            models[name] = curves(name, own)
            after = _on_other_scans(name, own)
        judged[name] = Fitted(len(own.right), int(own.right.sum()),
                              _judged(own, probabilities(before, own.class_ids, own.evidence)),
                              after)
    return models, judged


def enough(own: Samples) -> bool:
    """Whether there are enough proposals of both kinds in either half of the scans."""
    halves = [own.right[own.scans % 2 == half] for half in range(2)]
    return all(min(right.sum(), (~right).sum()) >= FEWEST / 2 for right in halves)


def curves(name: str, own: Samples) -> dict:
    """The model of a class, fitted to its proposals."""
    knots = {source: k for source, k in KNOTS.items()
             if (source, name) != ("silhouette", CLASSES[CAR])}
    features = {source: own.evidence[source] for source in knots}
    return fit(features, own.right, np.ones(len(own.right)), knots, dict.fromkeys(knots, 1))


def _on_other_scans(name: str, own: Samples) -> Judged:
    scores = np.zeros(len(own.right), np.float32)
    for half in range(2):
        other = own.scans % 2 == half
        model = {name: curves(name, own.take(~other))}
        left_out = own.take(other)
        scores[other] = probabilities(model, left_out.class_ids, left_out.evidence)
    return _judged(own, scores)


def _judged(own: Samples, scores: np.ndarray) -> Judged:
    if not len(scores):
        return Judged(0.0, 0, 0)
    of_truth = np.where(own.right, scores, 1 - scores)
    passed = scores >= ScoreParams().of_class(CLASSES[own.class_ids[0]])
    return Judged(float(-np.log(np.maximum(of_truth, LEAST)).mean()),
                  int((passed & own.right).sum()), int((passed & ~own.right).sum()))
