"""Fit of the confidence curves of the fused detector to simulated scans.

The curves combine the evidence of PointPillars, silhouettes and PointNet into one probability,
see detectors/fused/evidence.py.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lidar_perception.classes import CAR, DETECTED
from lidar_perception.data.frame import Frame
from lidar_perception.detectors.checkpoint import NETWORKS, Header
from lidar_perception.detectors.fused.detector import FusedDetector, Proposals, load_fused_detector
from lidar_perception.detectors.fused.evidence import Evidence, compute_probabilities
from lidar_perception.detectors.fused.fusion import KNOTS, Models, find_fusion, write_fusion
from lidar_perception.detectors.fused.params import FusedDetectorParams, FusedParams
from lidar_perception.detectors.params import ScoreParams
from lidar_perception.geometry import bev_iou, centre_distances
from lidar_perception.runs.processes import run_in_processes
from lidar_perception.runs.terminal import errors, show_progress
from lidar_perception.scoring.kitti.protocol import NEIGHBOURS
from lidar_perception.simulation.scene import Scenes
from lidar_perception.simulation.sensor import find_sensor
from lidar_perception.training.curves import fit_curves
from lidar_perception.training.params import FusedTraining
from lidar_perception.training.scenes import SimulatedScenes
from lidar_perception.training.sources import FIRST_FIT_SEED
from lidar_perception.types import CLASSES, SENSOR_HEIGHT, InputError

MAX_CENTRE_DISTANCE_M = 0.5  # maximum centre distance of a match with a pedestrian or cyclist
MIN_SAMPLES = 20  # minimum number of correct and of wrong proposals of a class to fit its curves
MIN_PROBABILITY = 1e-6  # probabilities are clipped at this value in the log loss
DEFAULT_SENSOR, DEFAULT_SCENE = "hdl64e", "street"  # for weights whose header names none
WITH_INTENSITY, WITHOUT_INTENSITY = CLOUD_KINDS = "with intensity", "without intensity"  # they have separate curves


@dataclass(frozen=True)
class Samples:
    """K proposals with their evidence.

    Attributes:
        class_ids: (K,) int into CLASSES.
        correct: (K,) bool, True for correct proposals.
        scans: (K,) int, number of the scan.
        evidence: (K,) log-odds by name of the source.
    """

    class_ids: np.ndarray
    correct: np.ndarray
    scans: np.ndarray
    evidence: Evidence

    def take(self, indices: np.ndarray) -> Samples:
        """Select proposals by a mask or by indices."""
        return Samples(
            self.class_ids[indices],
            self.correct[indices],
            self.scans[indices],
            {name: odds[indices] for name, odds in self.evidence.items()},
        )

    @staticmethod
    def concatenate(parts: Sequence[Samples]) -> Samples:
        """Concatenate one or more sets of proposals."""
        join = np.concatenate
        return Samples(
            join([part.class_ids for part in parts]),
            join([part.correct for part in parts]),
            join([part.scans for part in parts]),
            {name: join([part.evidence[name] for part in parts]) for name in parts[0].evidence},
        )


class CurveScore(NamedTuple):
    """Mean log loss of curves, and numbers of correct and wrong proposals above the default threshold."""

    loss: float
    correct: int
    wrong: int


class ClassFit(NamedTuple):
    """Result of the fit of one class.

    Attributes:
        proposals, correct: Number of proposals, and of correct ones.
        old_score: Loss and counts with the shipped curves.
        new_score: Loss and counts with the new curves, by cross-validation; None with too few
            proposals.
    """

    proposals: int
    correct: int
    old_score: CurveScore
    new_score: CurveScore | None


def fit_fusion(
    weights: Path | None, classifier: Path | None, out: Path, params: FusedTraining, jobs: int = 1
) -> dict[str, dict[str, ClassFit]]:
    """Fit the curves of two networks to simulated scans, and write a fusion file.

    Clouds with and without intensity have separate curves, fitted to the same scans.

    Args:
        weights: Checkpoint of PointPillars; None for the packaged one.
        classifier: Checkpoint of PointNet; None for the packaged one.
        out: Fusion file to write, see detectors/fused/fusion.py.
        params: Simulated scans.
        jobs: Number of processes.

    Returns:
        The fit of each class, by kind of cloud, see CLOUD_KINDS.

    Raises:
        InputError: An input cannot be used. Raised before any scan is simulated.
    """
    fused = FusedParams(
        weights=str(weights or ""), classifier=str(classifier or ""), range=params.range, threads=1, warm_up=False
    )
    detector = load_fused_detector("", "cpu", FusedDetectorParams(fused=fused))
    header, classifier_header = detector.proposer.header, detector.classifier.header
    params = fill_from_header(params, header)
    sensor = find_sensor(params.sensor, params.mount_height or _find_trained_height(header))
    scenes = Scenes(None, params.people, params.scene)
    scenes.scene_types()  # raises InputError for an unknown scene
    all_around = detector.range == "around"
    errors.print(
        f"{params.scans} {params.scene} scans of {params.sensor} at {sensor.height:g} m, "
        f"{'all around' if all_around else 'ahead'}"
    )
    for network_header in header, classifier_header:
        if warning := network_header.find_height_mismatch(sensor.height):
            errors.print(f"{NETWORKS[network_header.network][0]}: {warning}")
    source = SimulatedScenes(FIRST_FIT_SEED, params.scans, sensor, scenes, all_around=all_around)
    samples, old_fusion = simulate_samples(FusedDetectorParams(fused=fused), source, jobs), find_fusion()
    old_models = {
        WITH_INTENSITY: old_fusion.models,
        WITHOUT_INTENSITY: old_fusion.models_without_intensity or old_fusion.models,
    }
    models, fits = {}, {}
    for kind in CLOUD_KINDS:
        models[kind], fits[kind] = fit_classes(samples[kind], old_models[kind])
    counts = {
        kind: {name: [fit.proposals, fit.correct] for name, fit in class_fits.items()}
        for kind, class_fits in fits.items()
    }
    write_fusion(
        out,
        (weights, classifier),
        models[WITH_INTENSITY],
        {
            "sensor": params.sensor,
            "height": sensor.height,
            "scene": params.scene,
            "scans": params.scans,
            "range": "around" if all_around else "ahead",
            "proposals, hits": counts[WITH_INTENSITY],
            "proposals, hits without intensity": counts[WITHOUT_INTENSITY],
        },
        models[WITHOUT_INTENSITY],
    )
    return fits


def fill_from_header(params: FusedTraining, header: Header) -> FusedTraining:
    """Fill in an empty sensor or scene from the header. Raise InputError if the file of the sensor is missing."""
    sensor, training_params = _read_sensor(header), header.training.get("params")
    name = sensor.get("name") or DEFAULT_SENSOR
    if not params.sensor and Path(name).suffix in (".yaml", ".yml") and not Path(name).is_file():
        raise InputError(
            f"the weights were trained for the sensor {name}, whose file is missing; give its path with --sensor"
        )
    return replace(
        params,
        sensor=params.sensor or name,
        scene=params.scene
        or (training_params.get("scene") if isinstance(training_params, dict) else "")
        or DEFAULT_SCENE,
    )


def _find_trained_height(header: Header) -> float:
    """Return the sensor height in metres for which the weights were trained, 0 if unknown."""
    height = _read_sensor(header).get("height")
    return height if isinstance(height, float) else 0.0


def _read_sensor(header: Header) -> dict[str, Any]:
    sensor = header.training.get("sensor")
    return sensor if isinstance(sensor, dict) else {}


def collect_samples(frame: Frame, proposals: Proposals, scan: int) -> Samples:
    """Match the proposals of a simulated frame with its labels.

    Ignored as in KITTI's protocol: proposals outside the image, if there is a camera; duplicates on
    an object that a better proposal has already matched; and proposals on objects of a similar
    class, such as a van for Car.
    """
    truth, camera, detections = frame.truth(), frame.camera(), proposals.detections
    assert truth is not None  # simulated frames always have labels
    centres = detections.boxes[:, :3] - np.array([0, 0, frame.sensor_height - SENSOR_HEIGHT], np.float32)
    in_view = np.ones(len(detections), bool) if camera is None else camera.in_view(centres)
    indices, is_correct = [], []
    for class_id in np.unique(detections.class_ids):
        order = np.flatnonzero((detections.class_ids == class_id) & in_view)
        order = order[np.argsort(-detections.scores[order], kind="stable")]
        name, boxes = CLASSES[class_id], detections.boxes[order]
        hits = _match_boxes(boxes, truth.select_class(class_id), name)
        similar = truth.select_class(CLASSES.index(NEIGHBOURS.get(name, name)))
        is_matched = np.zeros(hits.shape[1], bool)
        for i, hit, similar_hit in zip(order, hits, _match_boxes(boxes, similar, name)):
            new_matches = np.flatnonzero(hit & ~is_matched)
            if not len(new_matches) and (hit.any() or similar_hit.any()):
                continue
            is_matched[new_matches[:1]] = True
            indices.append(i)
            is_correct.append(len(new_matches) > 0)
    rows = np.array(indices, np.int64)
    return Samples(
        detections.class_ids[rows],
        np.array(is_correct, bool),
        np.full(len(rows), scan),
        {name: odds[rows] for name, odds in proposals.evidence.items()},
    )


def _match_boxes(boxes: np.ndarray, objects: np.ndarray, name: str) -> np.ndarray:
    """Return (K, M) bool, True where a proposed box (K, 7) of a class matches an object (M, 7)."""
    hits = bev_iou(boxes, objects) > DETECTED[name].relaxed
    if name != CLASSES[CAR]:
        hits |= centre_distances(boxes, objects) < MAX_CENTRE_DISTANCE_M
    return hits


def simulate_samples(params: FusedDetectorParams, scenes: SimulatedScenes, jobs: int) -> dict[str, Samples]:
    """Simulate all scans and collect the proposals in them. The result does not depend on `jobs`.

    Returns:
        The proposals by kind of cloud, see CLOUD_KINDS. The same scans are used with and without
        their intensity.
    """
    make_sampler = partial(_make_sampler, params, scenes)
    results = run_in_processes(make_sampler, range(len(scenes)), jobs, "detected in simulated scans")
    parts = dict(show_progress(results, "simulating and detecting", len(scenes)))
    return {kind: Samples.concatenate([parts[i][kind] for i in sorted(parts)]) for kind in CLOUD_KINDS}


def _make_sampler(
    params: FusedDetectorParams, scenes: SimulatedScenes
) -> Callable[[int], tuple[int, dict[str, Samples]]]:
    detector: FusedDetector = load_fused_detector("", "cpu", params)

    def sample_scan(i: int) -> tuple[int, dict[str, Samples]]:
        frame = scenes.load_frame(i)
        frame_detector, cloud = detector.with_sensor_height(frame.sensor_height), frame.load()
        clouds = {WITH_INTENSITY: cloud, WITHOUT_INTENSITY: replace(cloud, intensity=None)}
        return i, {kind: collect_samples(frame, frame_detector.propose(c), i) for kind, c in clouds.items()}

    return sample_scan


def fit_classes(samples: Samples, old_models: Models) -> tuple[Models, dict[str, ClassFit]]:
    """Fit the curves of each class, and score the old and the new curves.

    Classes with too few samples keep their old curves, if there are any.

    Returns:
        The curves, and the fit by class.
    """
    models, fits = dict(old_models), {}
    for name in DETECTED:
        class_samples = samples.take(samples.class_ids == CLASSES.index(name))
        new_score = None
        if has_enough_samples(class_samples):
            models[name] = fit_class(name, class_samples)
            new_score = _cross_validate(name, class_samples)
        fits[name] = ClassFit(
            len(class_samples.correct),
            int(class_samples.correct.sum()),
            _score(class_samples, compute_probabilities(old_models, class_samples.class_ids, class_samples.evidence)),
            new_score,
        )
    return models, fits


def has_enough_samples(samples: Samples) -> bool:
    """Return True if both halves of the scans have enough correct and wrong proposals."""
    halves = [samples.correct[samples.scans % 2 == half] for half in range(2)]
    return all(min(is_correct.sum(), (~is_correct).sum()) >= MIN_SAMPLES / 2 for is_correct in halves)


def fit_class(name: str, samples: Samples) -> dict:
    """Fit the curves of a class to its proposals, see curves.fit_curves."""
    knots = {source: k for source, k in KNOTS.items() if (source, name) != ("silhouette", CLASSES[CAR])}
    features = {source: samples.evidence[source] for source in knots}
    return fit_curves(features, samples.correct, np.ones(len(samples.correct)), knots, dict.fromkeys(knots, 1))


def _cross_validate(name: str, samples: Samples) -> CurveScore:
    scores = np.zeros(len(samples.correct), np.float32)
    for half in range(2):
        in_half = samples.scans % 2 == half
        model = {name: fit_class(name, samples.take(~in_half))}
        test_samples = samples.take(in_half)
        scores[in_half] = compute_probabilities(model, test_samples.class_ids, test_samples.evidence)
    return _score(samples, scores)


def _score(samples: Samples, scores: np.ndarray) -> CurveScore:
    if not len(scores):
        return CurveScore(0.0, 0, 0)
    likelihood = np.where(samples.correct, scores, 1 - scores)
    is_detection = scores >= ScoreParams().get(CLASSES[samples.class_ids[0]])
    return CurveScore(
        float(-np.log(np.maximum(likelihood, MIN_PROBABILITY)).mean()),
        int((is_detection & samples.correct).sum()),
        int((is_detection & ~samples.correct).sum()),
    )
