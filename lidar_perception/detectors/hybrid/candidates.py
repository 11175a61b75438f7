"""STM-CPA candidates (paper A) scored again by the cluster network (paper C)."""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter

import numpy as np

from lidar_perception.camera import Camera
from lidar_perception.candidates.configurations import BEST
from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.pipeline import find_candidates
from lidar_perception.candidates.seed_sources import SeedSource
from lidar_perception.candidates.segmented import explain_nothing
from lidar_perception.detectors.contract import Cloud, Found, accept, joined
from lidar_perception.detectors.fused.evidence import clipped_logit
from lidar_perception.detectors.fused.fusion import package_models
from lidar_perception.detectors.fused.model import probabilities, sources
from lidar_perception.detectors.hybrid.params import RescoringParams
from lidar_perception.detectors.nms import suppressed
from lidar_perception.detectors.pointnet.clusters import clusters_of
from lidar_perception.detectors.pointnet.detector import PointNetDetector
from lidar_perception.detectors.pointnet.rescoring import rescored_by, seen_by
from lidar_perception.ground.params import mounted
from lidar_perception.param_fields import with_values
from lidar_perception.types import CLASSES, PEDESTRIAN, Detections, InputError

PERSON = CLASSES[PEDESTRIAN]


class RescoredCandidates:
    """A detector of pedestrians, see contract.py.

    classifier: a network that knows Pedestrian, else InputError. seed, camera: as of
    CandidateDetector.
    pipeline: how candidates are looked for; their score must be a confidence (confidence.enabled).
    """

    def __init__(self, classifier: PointNetDetector, seed: SeedSource, camera: Camera | None = None,
                 params: RescoringParams = RescoringParams(), pipeline: PipelineParams = BEST):
        if PERSON not in classifier.classes:
            raise InputError(f"the network does not know the class {PERSON}, only "
                             f"{', '.join(classifier.classes)}; give one that does")
        self.classifier, self.seed, self.camera, self.params = classifier, seed, camera, params
        self.pipeline = with_values(pipeline, {"confidence.enabled": True,
                                               "confidence.threshold": params.min_confidence})

    @property
    def classes(self) -> tuple[str, ...]:
        """Pedestrian."""
        return (PERSON,)

    @property
    def min_scores(self) -> dict[str, float]:
        """By class, the least score of a detection."""
        return {PERSON: self.params.threshold}

    def with_min_score(self, min_score: float) -> RescoredCandidates:
        """The same detector with this least score."""
        return RescoredCandidates(self.classifier, self.seed, self.camera,
                                  replace(self.params, threshold=min_score), self.pipeline)

    def mounted_at(self, height: float) -> RescoredCandidates:
        """The same detector for a sensor so many metres above the ground."""
        return RescoredCandidates(self.classifier, self.seed, self.camera, self.params,
                                  mounted(self.pipeline, height))

    def __call__(self, cloud: Cloud, *, ground: np.ndarray | None = None,
                 cluster_ids: np.ndarray | None = None) -> Found:
        """See contract.Detector: the candidates by their probability, best first. InputError
        where there is no seed, and without a camera where the pipeline crops to its view."""
        frame, ground, cluster_ids, problem = accept(cloud, ground, cluster_ids,
                                                     self.classifier.settings.intensity_scale)
        params, pose = self.params, self.pipeline.ground.sensor_pose
        segmented, candidates = find_candidates(frame, self.seed, self.camera, self.pipeline,
                                                ground=ground, cluster_ids=cluster_ids)
        t0 = perf_counter()
        ids = segmented.cloud_ids  # of which candidates.clusters are some
        chosen = np.flatnonzero(np.isin(ids, candidates.clusters))
        seen = seen_by(self.classifier, frame.take(segmented.indices), pose)
        clusters = clusters_of(seen.take(chosen), ids[chosen]).on(
            seen.xyz.compress(segmented.ground, axis=0))
        judged, whole = rescored_by(self.classifier, candidates.final, clusters, 1.0, pose)
        # The curves of the fused detector, with a proposer that has no opinion.
        evidence = {"network": np.zeros(len(judged)),
                    "silhouette": clipped_logit(candidates.final.scores),
                    "classifier": clipped_logit(judged.scores)}
        models = package_models()
        result = replace(judged, scores=probabilities(models, judged.class_ids, evidence), sources={
            name: said for name, said in sources(models, judged.class_ids, evidence).items()
            if name != "network"})
        result = result[result.scores >= params.threshold] if params.box == "cluster" else (
            self._whole(result, whole))
        result = result[np.argsort(-result.scores, kind="stable")]
        return Found(result, {**candidates.ms, "network": (perf_counter() - t0) * 1e3},
                     joined(problem, explain_nothing(len(frame), segmented.ground,
                                                     segmented.cluster_ids)))

    def _whole(self, detections: Detections, boxes: np.ndarray) -> Detections:
        """The detections with these boxes; of those that overlap the best."""
        detections = replace(detections, boxes=boxes)[detections.scores >= self.params.threshold]
        return detections[suppressed(detections.boxes, detections.scores, detections.class_ids,
                                     self.params.overlap)]
