"""STM-CPA candidates (paper A) scored again by the cluster network (paper C)."""

from __future__ import annotations

from time import perf_counter

import numpy as np

from lidar_perception.camera import Camera
from lidar_perception.candidates.configurations import BEST
from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.pipeline import find_candidates
from lidar_perception.candidates.seed_sources import SeedSource
from lidar_perception.candidates.segmented import explain_nothing
from lidar_perception.detectors.hybrid.judging import judged, seen_by
from lidar_perception.detectors.hybrid.params import RescoringParams
from lidar_perception.detectors.nms import suppressed
from lidar_perception.detectors.pointnet.clusters import clusters_of
from lidar_perception.detectors.pointnet.detector import PointNetDetector
from lidar_perception.param_fields import with_values
from lidar_perception.types import Detections, InputError, LidarFrame


class RescoredCandidates:
    """detector(frame, seed, camera) -> Detections of pedestrians, in the frame's own coordinates.

    judge: a network that knows Pedestrian, else InputError. pipeline: how candidates are found;
    their score must be a confidence (confidence.enabled). ms and problem as of other detectors.
    """

    def __init__(self, judge: PointNetDetector, params: RescoringParams = RescoringParams(),
                 pipeline: PipelineParams = BEST):
        if "Pedestrian" not in judge.config.classes:
            raise InputError("the network knows no Pedestrian, only "
                             f"{', '.join(judge.config.classes)}; candidates need one that does")
        self.judge, self.params = judge, params
        self.pipeline = with_values(pipeline, {"confidence.enabled": True,
                                               "confidence.threshold": params.least_confidence})
        self.ms: dict[str, float] = {}
        self.problem: str | None = None

    def __call__(self, frame: LidarFrame, seed: SeedSource,
                 camera: Camera | None = None) -> Detections:
        """The candidates by their combined score, best first. InputError where there is no seed,
        and without a camera where the pipeline crops to its view."""
        params, pose = self.params, self.pipeline.ground.sensor_pose
        segmented, found = find_candidates(frame, seed, camera, self.pipeline)
        self.problem = explain_nothing(len(frame), segmented.ground, segmented.cluster_ids)
        t0 = perf_counter()
        chosen = np.flatnonzero(np.isin(segmented.cluster_ids, found.clusters))
        seen = seen_by(self.judge, frame.take(segmented.places), pose)
        clusters = clusters_of(seen.take(chosen), segmented.cluster_ids[chosen]).on(
            seen.xyz.compress(segmented.ground, axis=0))
        result, whole = judged(self.judge, found.final, clusters, params.weight, pose)
        result = result[result.scores >= params.threshold] if params.box == "cluster" else (
            self._whole(result, whole))
        result = result[np.argsort(-result.scores, kind="stable")]
        self.ms = {**found.ms, "network": (perf_counter() - t0) * 1e3}
        return result

    def _whole(self, found: Detections, boxes: np.ndarray) -> Detections:
        """The detections with these boxes; of those that overlap the best."""
        found = Detections(boxes, found.class_ids, found.scores)[
            found.scores >= self.params.threshold]
        return found[suppressed(found.boxes, found.scores, found.class_ids, self.params.overlap)]
