"""Proposals of another detector, confirmed or rejected by the shape of the points in them."""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter

import numpy as np

from lidar_perception.detectors.base import NetworkDetector
from lidar_perception.detectors.contract import Cloud, Detector, Found, accept, joined
from lidar_perception.detectors.hybrid.params import ConfirmingParams
from lidar_perception.detectors.pointnet.clusters import points_of
from lidar_perception.detectors.pointnet.detector import PointNetDetector
from lidar_perception.detectors.pointnet.rescoring import known, rescored_by, seen_by
from lidar_perception.detectors.view import levelled_ground


class ConfirmedProposals:
    """A detector, see contract.py.

    proposer: a detector that proposes boxes; of a network its own scores count, as calibrated ones
    hide what is weak (simulated scans: F1 of pedestrians 78 and 68). classifier: whose network
    reads their points; its params say how the sensor is mounted and what is ground. Boxes stay the
    proposer's.
    """

    def __init__(self, proposer: Detector, classifier: PointNetDetector,
                 params: ConfirmingParams = ConfirmingParams()):
        self.proposer = proposer.raw() if isinstance(proposer, NetworkDetector) else proposer
        self.classifier, self.params = classifier, params

    @property
    def classes(self) -> tuple[str, ...]:
        """The proposer's."""
        return self.proposer.classes

    @property
    def min_scores(self) -> dict[str, float]:
        """By class, the least score of a detection."""
        return dict.fromkeys(self.classes, self.params.threshold)

    def with_min_score(self, min_score: float) -> ConfirmedProposals:
        """The same detector with this least score of what comes out; the proposer keeps its own."""
        return ConfirmedProposals(self.proposer, self.classifier,
                                  replace(self.params, threshold=min_score))

    def mounted_at(self, height: float) -> ConfirmedProposals:
        """The same detector for a sensor so many metres above the ground."""
        return ConfirmedProposals(self.proposer.mounted_at(height),
                                  self.classifier.mounted_at(height), self.params)

    def __call__(self, cloud: Cloud, *, ground: np.ndarray | None = None,
                 cluster_ids: np.ndarray | None = None) -> Found:
        """See contract.Detector: the proposals by their combined score, best first."""
        params, t0 = self.params, perf_counter()
        frame, ground, cluster_ids, problem = accept(cloud, ground, cluster_ids,
                                                     self.classifier.settings.intensity_scale)
        proposed = self.proposer(frame, ground=ground, cluster_ids=cluster_ids)
        proposals = proposed.detections
        t1 = perf_counter()
        t2 = t3 = t1
        if len(proposals):
            pose = self.classifier.params.ground.sensor_pose
            seen = seen_by(self.classifier, frame, pose)
            if ground is None:
                ground = levelled_ground(seen, self.classifier.params.ground)
            ground = np.asarray(ground, bool)
            obstacles = np.flatnonzero(~ground)
            t2 = perf_counter()
            clusters = points_of(proposals.boxes, frame.take(obstacles), seen.take(obstacles),
                                 params.margin)
            asked = np.flatnonzero((clusters.sizes >= params.min_points)
                                   & known(self.classifier, proposals.class_ids))
            clusters = clusters.take(asked).on(seen.xyz.compress(ground, axis=0))
            t3 = perf_counter()
            scores = proposals.scores.copy()
            scores[asked] = rescored_by(self.classifier, proposals[asked], clusters,
                                        params.weight)[0].scores
            kept = np.flatnonzero(scores >= params.threshold)
            kept = kept[np.argsort(-scores[kept], kind="stable")]
            proposals = replace(proposals, scores=scores)[kept]
        ms = {step: seconds * 1e3 for step, seconds in (
            ("proposals", t1 - t0), ("ground", t2 - t1), ("clusters", t3 - t2),
            ("network", perf_counter() - t3))}
        return Found(proposals, ms, joined(problem, proposed.problem), proposed.best)
