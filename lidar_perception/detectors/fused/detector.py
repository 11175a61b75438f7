"""A cloud in, boxes out: PointPillars, the cluster network and silhouettes in one detector."""

from __future__ import annotations

import copy
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

import numpy as np
import torch

from lidar_perception.classes import CAR
from lidar_perception.clustering.cluster import cluster_obstacles
from lidar_perception.detectors.base import NetworkDetector
from lidar_perception.detectors.boxes import cars_on_points, moved_towards, on_ground
from lidar_perception.detectors.contract import Found
from lidar_perception.detectors.fused.evidence import Evidence, clipped_logit, judged, silhouette_at
from lidar_perception.detectors.fused.fusion import Models, fusion_of, package_models
from lidar_perception.detectors.fused.model import at_most, probabilities, sources
from lidar_perception.detectors.fused.params import STEPS, FusedDetectorParams, FusedParams
from lidar_perception.detectors.nms import first_of_each, suppressed
from lidar_perception.detectors.params import ScoreParams
from lidar_perception.detectors.pointnet.detector import PointNetDetector, load_pointnet_detector
from lidar_perception.detectors.pointnet.params import PointNetDetectorParams, PointNetParams
from lidar_perception.detectors.pointpillars.detector import PointPillarsDetector, load_detector
from lidar_perception.detectors.pointpillars.params import DetectorParams, PointPillarsParams
from lidar_perception.detectors.view import (
    as_found,
    levelled_ground,
    made_up_frame,
    visible,
    with_intensity_scaled,
    without_carrier,
)
from lidar_perception.geometry import bev_iou, centre_distances
from lidar_perception.ground.params import SensorPoseParams
from lidar_perception.ground.surface import fit_ground_heights
from lidar_perception.types import CLASSES, SENSOR_HEIGHT, Detections, LidarFrame


class Look(NamedTuple):
    """What is proposed in the network's range, in boxes that the classifier has put right where it
    was asked, and what speaks for it; xyz (N, 3) of obstacles and ground (G, 3) there; why little
    can be detected, or None; ms of each step."""

    proposed: Detections
    evidence: Evidence
    xyz: np.ndarray
    ground: np.ndarray
    problem: str | None
    ms: dict[str, float]


class FusedDetector(NetworkDetector):
    """A detector, see contract.py, of what PointPillars detects, where its range is.

    proposer, classifier: loaded; their thresholds and mounting are this detector's. models: the
    curves of what they say.
    """

    group = "fused"  # of its params
    params: FusedDetectorParams

    def __init__(self, proposer: PointPillarsDetector, classifier: PointNetDetector,
                 params: FusedDetectorParams = FusedDetectorParams(),
                 models: Models | None = None):
        super().__init__(proposer.header, proposer.device, params)
        self.proposer, self.classifier = proposer.raw(), classifier  # the curves know raw scores
        self.place = proposer.place
        self.models = package_models() if models is None else models

    @property
    def settings(self) -> FusedParams:
        """Its own group of params."""
        return self.params.fused

    def with_range(self, range: str) -> FusedDetector:
        """See base; the range is that of PointPillars."""
        other = FusedDetector(self.proposer.with_range(range), self.classifier, self.params,
                              self.models)
        other.doubt = self.doubt
        return other

    def detect(self, frame: LidarFrame, ground: np.ndarray | None,
               cluster_ids: np.ndarray | None) -> Found:
        """Ground and PointPillars' clusters are computed where they are None."""
        look = self.look(frame, ground, cluster_ids, self.settings.scores)
        begin = perf_counter()
        detections, best = self.weighed(look)
        detections = as_found(detections, self.params.ground.sensor_pose)
        ms = {**look.ms, STEPS[-1]: (perf_counter() - begin) * 1e3}
        return Found(detections, ms, look.problem or self.fallback or self.classifier.fallback,
                     best)

    def look(self, frame: LidarFrame, ground: np.ndarray | None = None,
             cluster_ids: np.ndarray | None = None,
             scores: ScoreParams = ScoreParams.all_alike(0.0)) -> Look:
        """What all sources say of a frame, before it is weighed. The classifier, which takes the
        time, is asked only about proposals that can reach these scores with its help."""
        times = [perf_counter()]
        settings = self.settings
        indices, seen = visible(frame, self.config, self.params.ground.sensor_pose)
        seen = with_intensity_scaled(seen, settings.intensity_scale)
        times.append(perf_counter())
        ground = (levelled_ground(seen, self.params.ground) if ground is None
                  else ground.take(indices).astype(bool))
        cluster_ids = None if cluster_ids is None else cluster_ids.take(indices)
        obstacles = seen.take(np.flatnonzero(~ground))
        floor = seen.xyz.compress(ground, axis=0)
        times.append(perf_counter())
        # Compiled code lets go of the GIL, and much of what PointPillars does is of one thread.
        with ThreadPoolExecutor(1) as beside:
            clustered = beside.submit(cluster_obstacles, seen.xyz, ground, self.params.people,
                                      frame.xyz)
            proposed = self._proposer().propose(seen, ground, cluster_ids)
            people = clustered.result()[~ground]
        times.append(perf_counter())
        found = without_carrier(proposed.detections, self.params.ground.sensor_pose.height)
        evidence = {"network": clipped_logit(found.scores), "silhouette": clipped_logit(
            silhouette_at(found.boxes, obstacles.xyz, floor, people))}
        open_ = scores.passed(replace(found, scores=at_most(self.models, found.class_ids,
                                                            evidence,
                                                            "classifier")))
        said, boxes = judged(found, obstacles, floor, self._classifier(), open_)
        evidence["classifier"] = clipped_logit(said)
        found = replace(found, boxes=moved_towards(found.boxes, boxes,
                                                   settings.classifier_box).astype(np.float32))
        times.append(perf_counter())
        return Look(found, evidence, obstacles.xyz, floor,
                    self.proposer.out_of_sight(frame, seen) or proposed.problem,
                    dict(zip(STEPS, (np.diff(times) * 1e3).tolist())))

    def _proposer(self) -> PointPillarsDetector:
        """The proposer, told what this detector is told; what it sees is level, and its intensity
        scaled, already."""
        settings, other = self.settings, copy.copy(self.proposer)
        other.params = DetectorParams(
            ground=replace(self.params.ground, sensor_pose=SensorPoseParams(height=SENSOR_HEIGHT)),
            clustering=self.params.clustering,
            pointpillars=PointPillarsParams(scores=ScoreParams.all_alike(settings.proposals),
                                            nms=replace(settings.nms,
                                                        max_boxes=settings.max_proposals),
                                            intensity_scale=float(settings.intensity_scale > 0),
                                            cpu_fallback=settings.cpu_fallback))
        return other

    def _classifier(self) -> PointNetDetector:
        """Likewise."""
        other = copy.copy(self.classifier)
        own = replace(other.settings, cpu_fallback=self.settings.cpu_fallback)
        other.params = replace(other.params, pointnet=own)
        return other

    def weighed(self, look: Look) -> tuple[Detections, dict[str, float]]:
        """The detections, best first, as from a level sensor at SENSOR_HEIGHT, and where there are
        none the highest score of each class."""
        settings, class_ids = self.settings, look.proposed.class_ids
        every = replace(look.proposed, scores=probabilities(self.models, class_ids, look.evidence),
                        sources=sources(self.models, class_ids, look.evidence))
        found = every[settings.scores.passed(every)]
        if len(found) == 0:
            return found, {
                name: float(every.scores[every.class_ids == CLASSES.index(name)].max(initial=0.0))
                for name in self.classes}
        boxes = cars_on_points(found.boxes, found.class_ids, look.xyz, settings.on_points)
        floors = fit_ground_heights(look.ground, boxes[:, :2])
        moved = replace(found, boxes=on_ground(boxes, floors, settings.on_ground).astype(
            np.float32))
        return moved[one_of_each(moved, settings)], {}

    def bring_to(self, device: torch.device) -> None:
        """Bring both networks to a device."""
        self.proposer.bring_to(device)
        self.classifier.move(device)

    def warm_up(self) -> None:
        """Run every part once on made-up points, so that what is compiled is compiled."""
        self.with_min_score(0.0)(made_up_frame(self.params.ground.sensor_pose))


def one_of_each(found: Detections, params: FusedParams) -> np.ndarray:
    """(M,) int64 indices, best score first, of the detections that are not a better one of their
    class once more: by their overlap, of which cars may have hardly any, while people walk side by
    side; but for cars by the distance of their centres, too."""
    order = suppressed(found.boxes, found.scores, found.class_ids, params.nms.iou,
                       params.nms.across_classes)
    boxes, class_ids = found.boxes[order], found.class_ids[order]
    again = (centre_distances(boxes, boxes) < params.same_place) & (class_ids[:, None] == class_ids)
    cars = np.flatnonzero(class_ids == CAR)
    again[cars] = False
    again[np.ix_(cars, cars)] = bev_iou(boxes[cars], boxes[cars]) > params.same_car
    return order[first_of_each(again)][:params.nms.max_boxes]


def load_fused_detector(path: str | Path = "", device: str = "auto",
                        params: FusedDetectorParams = FusedDetectorParams()) -> FusedDetector:
    """The detector of a file of `train fused`, or with the weights of PointPillars at path; with an
    empty one what params name, or else what comes with the package. InputError as of fusion_of,
    load_detector and load_pointnet_detector."""
    settings = params.fused
    fusion = fusion_of(path, settings)
    proposer = load_detector(fusion.proposer, device, DetectorParams(
        pointpillars=PointPillarsParams(range=settings.range, amp=settings.amp, warm_up=False,
                                        threads=settings.threads, engine=settings.engine,
                                        cpu_fallback=settings.cpu_fallback)))
    classifier = load_pointnet_detector(fusion.classifier, device, PointNetDetectorParams(
        pointnet=PointNetParams(warm_up=False, cpu_fallback=settings.cpu_fallback,
                                engine="torch" if settings.engine == "torch" else "auto")))
    detector = FusedDetector(proposer, classifier, params, fusion.models)
    detector.doubt = "; ".join(fusion.doubts(detector.classes)) or None
    if settings.warm_up:
        detector.warm_up()
    return detector
