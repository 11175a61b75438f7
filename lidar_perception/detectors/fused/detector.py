"""Fused detector: PointPillars proposes boxes; PointNet and cluster silhouettes verify them."""

from __future__ import annotations

import copy
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

import numpy as np

from lidar_perception.classes import CAR
from lidar_perception.clustering.cluster import cluster_obstacles
from lidar_perception.detectors.base import NetworkDetector, make_synthetic_frame
from lidar_perception.detectors.boxes import move_cars_to_points, move_to_ground, move_towards
from lidar_perception.detectors.contract import DetectionResult
from lidar_perception.detectors.fused.evidence import (
    Evidence,
    compute_max_probabilities,
    compute_probabilities,
    compute_source_probabilities,
    find_silhouette_confidence,
    fit_people,
    to_log_odds,
)
from lidar_perception.detectors.fused.fusion import Models, find_fusion, load_shipped_models
from lidar_perception.detectors.fused.params import STEPS, FusedDetectorParams, FusedParams
from lidar_perception.detectors.nms import keep_first, rotated_nms
from lidar_perception.detectors.normalized_view import (
    NormalizedView,
    drop_ego_vehicle,
    restore_detections,
    segment_view_ground,
)
from lidar_perception.detectors.params import ScoreParams
from lidar_perception.detectors.pointnet.classifier import PointNetClassifier
from lidar_perception.detectors.pointnet.detector import load_pointnet_detector
from lidar_perception.detectors.pointnet.params import PointNetDetectorParams, PointNetParams
from lidar_perception.detectors.pointpillars.detector import load_detector
from lidar_perception.detectors.pointpillars.expert import run_experts
from lidar_perception.detectors.pointpillars.params import DetectorParams, PointPillarsParams
from lidar_perception.detectors.pointpillars.proposer import PointPillarsProposer
from lidar_perception.detectors.trained_network import TrainedNetwork
from lidar_perception.geometry import bev_iou, centre_distances
from lidar_perception.ground.surface import GroundSurface, fit_ground_surface
from lidar_perception.types import CLASSES, SENSOR_HEIGHT, Detections, PointCloud

MAX_RELIEF_M = 2.0  # maximum height difference of the ground around the sensor


class Proposals(NamedTuple):
    """Proposed boxes in a flattened NormalizedView and the evidence for them.

    Attributes:
        detections: K proposals; boxes that PointNet classified are moved towards its boxes.
        evidence: log-odds (K,) of each source.
        obstacles: (N, 3) xyz of the points of the view that are not ground.
        surface: ground surface before flattening.
        problem: reason why few or no objects can be detected, or None.
        timings: duration of each step in milliseconds.
        models: curves used for this cloud.
    """

    detections: Detections
    evidence: Evidence
    obstacles: np.ndarray
    surface: GroundSurface
    problem: str | None
    timings: dict[str, float]
    models: Models


class FusedDetector(NetworkDetector):
    """Detector that combines two networks, see contract.Detector.

    Range and classes are those of the proposer. If a call passes no ground or no clusters for
    PointPillars, they are computed.

    Args:
        proposer, classifier: the networks.
        models: curves that map the evidence, including raw proposer scores, to probabilities; None:
            the shipped ones.
        models_without_intensity: curves for clouds without usable intensity; None: `models`.
    """

    group = "fused"
    params: FusedDetectorParams

    def __init__(
        self,
        proposer: PointPillarsProposer,
        classifier: PointNetClassifier,
        params: FusedDetectorParams = FusedDetectorParams(),
        models: Models | None = None,
        warning: str | None = None,
        models_without_intensity: Models | None = None,
    ):
        super().__init__(params, warning)
        self.proposer, self.classifier = proposer.with_raw_scores(), classifier
        self.models = load_shipped_models() if models is None else models
        self.models_without_intensity = self.models if models_without_intensity is None else models_without_intensity

    @property
    def networks(self) -> tuple[TrainedNetwork, ...]:
        return self.proposer, self.classifier

    @property
    def settings(self) -> FusedParams:
        return self.params.fused

    def with_range(self, range: str) -> FusedDetector:
        other = copy.copy(self)
        other.proposer = self.proposer.with_range(range)
        return other

    def with_raw_scores(self) -> FusedDetector:
        """Return this detector unchanged: its curves already give calibrated probabilities."""
        return self

    def detect(self, frame: PointCloud, ground: np.ndarray | None, cluster_ids: np.ndarray | None) -> DetectionResult:
        begin = perf_counter()
        extended_view = self._make_view(frame)
        preprocess_s = perf_counter() - begin
        proposals = self._propose(extended_view, ground, cluster_ids, self.settings.scores)
        begin = perf_counter()
        detections, best_scores = self.decide(proposals)
        detections = restore_detections(detections, self.params.ground.sensor_pose)
        timings = {STEPS[0]: preprocess_s * 1e3, **proposals.timings, STEPS[-1]: (perf_counter() - begin) * 1e3}
        return DetectionResult(detections, timings, proposals.problem or self.fallback, best_scores)

    def _make_view(self, frame: PointCloud) -> NormalizedView:
        """Make a view of the proposer's range, extended by MAX_RELIEF_M upwards and downwards."""
        config, relief = self.proposer.config, np.array([0, 0, MAX_RELIEF_M])
        return NormalizedView.of(
            frame,
            self.params.ground.sensor_pose,
            tuple(config.low - relief),
            tuple(config.high + relief),
            self.settings.use_intensity,
        )

    def propose(self, frame: PointCloud) -> Proposals:
        """Return all proposals for a cropped frame with the evidence of all sources."""
        return self._propose(self._make_view(frame))

    def _propose(
        self,
        extended_view: NormalizedView,
        ground: np.ndarray | None = None,
        cluster_ids: np.ndarray | None = None,
        min_scores: ScoreParams = ScoreParams.for_all_classes(0.0),
    ) -> Proposals:
        """Return the proposals for the result of _make_view() with the evidence of all sources.

        Args:
            min_scores: proposals that cannot reach these scores are not classified by PointNet, the
                slowest step.
        """
        times = [perf_counter()]
        settings, params, config = self.settings, self.params, self.proposer.config
        models = self.models_without_intensity if extended_view.frame.intensity is None else self.models
        view = extended_view.crop(config.low, config.high)
        is_ground = segment_view_ground(view.frame, params.ground) if ground is None else ground.take(view.indices)
        surface = fit_ground_surface(view.frame.xyz.compress(is_ground, axis=0), -SENSOR_HEIGHT)
        flat_view = extended_view.flatten(surface).crop(config.low, config.high)
        is_flat_ground = view.transfer(is_ground, flat_view)
        assert is_flat_ground is not None
        obstacles = flat_view.frame.take(np.flatnonzero(~is_flat_ground))
        ground_points = flat_view.frame.xyz.compress(is_flat_ground, axis=0)
        times.append(perf_counter())

        def find_people() -> tuple[np.ndarray, np.ndarray]:
            xyz, sensor_xyz = flat_view.frame.xyz, extended_view.source.xyz
            ids = cluster_obstacles(xyz, is_flat_ground, params.people, sensor_xyz)[~is_flat_ground]
            return ids, fit_people(obstacles.xyz, ground_points, ids)

        # Clustering runs in parallel: it releases the GIL, and much of PointPillars is single-threaded.
        with ThreadPoolExecutor(1) as pool:
            people = pool.submit(find_people)
            _, cluster_ids = run_experts(
                view.frame, config, is_ground, view.take(cluster_ids), params.ground, params.clustering
            )
            proposal_result = self.proposer.propose(
                flat_view,
                is_flat_ground,
                view.transfer(cluster_ids, flat_view),
                ScoreParams.for_all_classes(settings.proposals),
                replace(settings.nms, max_boxes=settings.max_proposals),
                settings.cpu_fallback,
            )
            people_ids, people_boxes = people.result()
        times.append(perf_counter())
        proposals = drop_ego_vehicle(proposal_result.detections, view.pose.height)
        evidence = {
            "network": to_log_odds(proposals.scores),
            "silhouette": to_log_odds(
                find_silhouette_confidence(proposals.boxes, obstacles.xyz, people_ids, people_boxes)
            ),
        }
        max_scores = compute_max_probabilities(models, proposals.class_ids, evidence, "classifier")
        probabilities, classifier_boxes = self.classifier.classify(
            proposals,
            obstacles,
            ground_points,
            min_scores.passes(replace(proposals, scores=max_scores)),
            settings.cpu_fallback,
        )
        evidence["classifier"] = to_log_odds(probabilities)
        boxes = move_towards(proposals.boxes, classifier_boxes, settings.classifier_box).astype(np.float32)
        times.append(perf_counter())
        return Proposals(
            replace(proposals, boxes=boxes),
            evidence,
            obstacles.xyz,
            surface,
            proposal_result.problem,
            dict(zip(STEPS[1:], (np.diff(times) * 1e3).tolist())),
            models,
        )

    def decide(self, proposals: Proposals) -> tuple[Detections, dict[str, float]]:
        """Convert proposals to detections.

        Returns:
            Detections in the coordinates of the view, highest score first; and the highest score of
            each class if there are no detections, otherwise empty.
        """
        settings, class_ids = self.settings, proposals.detections.class_ids
        candidates = replace(
            proposals.detections,
            scores=compute_probabilities(proposals.models, class_ids, proposals.evidence),
            sources=compute_source_probabilities(proposals.models, class_ids, proposals.evidence),
        )
        detections = candidates[settings.scores.passes(candidates)]
        if len(detections) == 0:
            return detections, {
                name: float(candidates.scores[class_ids == CLASSES.index(name)].max(initial=0.0))
                for name in self.classes
            }
        boxes = move_cars_to_points(detections.boxes, detections.class_ids, proposals.obstacles, settings.on_points)
        ground_heights = proposals.surface.height_at(boxes)
        boxes[:, 2] += ground_heights + SENSOR_HEIGHT
        boxes = move_to_ground(boxes, ground_heights, settings.on_ground).astype(np.float32)
        detections = replace(detections, boxes=boxes)
        return detections[remove_duplicates(detections, settings)], {}

    def warm_up(self) -> None:
        """Run every step once on synthetic points to trigger JIT compilation."""
        self.with_min_score(0.0)(make_synthetic_frame(self.params.ground.sensor_pose))


def remove_duplicates(detections: Detections, params: FusedParams) -> np.ndarray:
    """Return the indices (M,) int64 of one detection per object, highest score first.

    Two detections of the same class are duplicates if their IoU is above nms.iou. Cars are also
    duplicates if their IoU is above same_car, and pedestrians and cyclists if the distance between
    their centres is less than same_place.
    """
    order = rotated_nms(
        detections.boxes, detections.scores, detections.class_ids, params.nms.iou, params.nms.across_classes
    )
    boxes, class_ids = detections.boxes[order], detections.class_ids[order]
    is_duplicate = (centre_distances(boxes, boxes) < params.same_place) & (class_ids[:, None] == class_ids)
    cars = np.flatnonzero(class_ids == CAR)
    is_duplicate[cars] = False
    is_duplicate[np.ix_(cars, cars)] = bev_iou(boxes[cars], boxes[cars]) > params.same_car
    return order[keep_first(is_duplicate)][: params.nms.max_boxes]


def load_fused_detector(
    path: str | Path = "", device: str = "auto", params: FusedDetectorParams = FusedDetectorParams()
) -> FusedDetector:
    """Load the fused detector.

    Args:
        path: output of `train fused`, or weights of PointPillars; empty: the files named in
            `params`, by default the shipped ones.

    Raises:
        InputError: see find_fusion, load_detector and load_pointnet_detector.
    """
    settings, fusion = params.fused, find_fusion(path, params.fused)
    proposer = load_detector(
        fusion.proposer,
        device,
        DetectorParams(
            pointpillars=PointPillarsParams(
                range=settings.range,
                amp=settings.amp,
                warm_up=False,
                threads=settings.threads,
                engine=settings.engine,
                cpu_fallback=settings.cpu_fallback,
            )
        ),
    ).proposer
    classifier = load_pointnet_detector(
        fusion.classifier,
        device,
        PointNetDetectorParams(
            pointnet=PointNetParams(
                warm_up=False,
                cpu_fallback=settings.cpu_fallback,
                engine="torch" if settings.engine == "torch" else "auto",
            )
        ),
    ).classifier
    detector = FusedDetector(
        proposer,
        classifier,
        params,
        fusion.models,
        "; ".join(fusion.find_warnings(proposer.classes)) or None,
        fusion.models_without_intensity,
    )
    if settings.warm_up:
        detector.warm_up()
    return detector
