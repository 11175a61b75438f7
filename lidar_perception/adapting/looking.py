"""What all sources say of each frame: PointPillars, silhouettes and the cluster network."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lidar_perception.classes import CAR
from lidar_perception.data.frame import Frame
from lidar_perception.detectors.fused.detector import FusedDetector, Look
from lidar_perception.detectors.fused.evidence import clipped_logit
from lidar_perception.detectors.params import ScoreParams
from lidar_perception.detectors.view import in_sensor_frame
from lidar_perception.geometry import centre_distances, points_in_boxes, within
from lidar_perception.ground.params import SensorPoseParams
from lidar_perception.types import SENSOR_HEIGHT, Detections

LEAST = 0.05       # score from which on a detection is looked at
CLUSTERS = 0.3     # score of a cluster where PointPillars proposes nothing
SAME = {True: 1.5, False: 0.6}  # metres between what is one car, or one person
REACH = 5.0        # metres above the floor up to which something can go on
GAP = 0.5          # metres without a point, above which something else begins
WIDER = 0.15       # metres around a box in which it may go on upwards
SOURCES = ("network", "silhouette", "classifier")


@dataclass(frozen=True)
class FrameLook:
    """K detections of a frame, in its own coordinates, with sources; counts (K,) points in each;
    tops (K,) metres above its floor where what stands there ends; pose (4, 4) of the sensor in a
    frame that stands."""

    detections: Detections
    counts: np.ndarray
    tops: np.ndarray
    pose: np.ndarray

    def arrays(self) -> dict[str, np.ndarray]:
        """For an .npz file."""
        found = self.detections
        return dict(boxes=found.boxes, class_ids=found.class_ids, scores=found.scores,
                    **{name: found.sources[name] for name in SOURCES}, counts=self.counts,
                    tops=self.tops, pose=self.pose)

    @staticmethod
    def of(arrays: Any) -> FrameLook:
        """The inverse of arrays."""
        found = Detections(arrays["boxes"], arrays["class_ids"], arrays["scores"],
                           {name: arrays[name] for name in SOURCES})
        return FrameLook(found, arrays["counts"], arrays["tops"], arrays["pose"])


class Looker:
    """looker(frame, pose) -> FrameLook. detector: with the weights that are adapted."""

    def __init__(self, detector: FusedDetector) -> None:
        self._detector = detector.with_min_score(LEAST)

    def __call__(self, frame: Frame, pose: np.ndarray) -> FrameLook:
        """Nothing is detected in a cloud without points. InputError naming the file that cannot be
        read."""
        cloud = frame.load()
        if len(cloud) == 0:
            nothing = np.zeros(0, np.float32)
            return FrameLook(replace(Detections.none(), sources=dict.fromkeys(SOURCES, nothing)),
                             np.zeros(0, int), np.zeros(0), pose)
        mount = SensorPoseParams(height=frame.sensor_height)
        detector = self._detector.mounted_at(frame.sensor_height)
        classifier = detector.classifier.with_min_score(CLUSTERS).mounted_at(frame.sensor_height)
        clusters = classifier(cloud).detections
        boxes = clusters.boxes.copy()
        boxes[:, 2] += np.float32(frame.sensor_height - SENSOR_HEIGHT)
        look = detector.look(cloud, scores=ScoreParams.all_alike(LEAST))
        inside = within(boxes, detector.config.low, detector.config.high)
        clusters = replace(clusters, boxes=boxes)[np.flatnonzero(inside)]
        look = with_clusters(look, clusters, detector.settings.proposals)
        found = in_sensor_frame(detector.weighed(look)[0], mount)
        counts, tops = seen_in(found.boxes, cloud.xyz)
        return FrameLook(found, counts, tops, pose)


def with_clusters(look: Look, clusters: Detections, silent: float) -> Look:
    """A look with what the cluster network alone found, clusters, where there is no proposal of the
    class; PointPillars gives it the probability `silent`, and silhouettes none."""
    new = np.ones(len(clusters), bool)
    for k in range(len(clusters)):
        same = look.proposed.class_ids == clusters.class_ids[k]
        apart = centre_distances(look.proposed.boxes[same], clusters.boxes[k:k + 1])
        new[k] = apart.min(initial=np.inf) > SAME[bool(clusters.class_ids[k] == CAR)]
    added = clusters[new]
    said = {"network": clipped_logit(np.full(len(added), silent)),
            "classifier": clipped_logit(added.scores), "silhouette": np.full(len(added), np.nan)}
    return look._replace(proposed=look.proposed.followed_by(added), evidence={
        name: np.concatenate([odds, said[name]]) for name, odds in look.evidence.items()})


def seen_in(boxes: np.ndarray, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of boxes (K, 7) among all points (N, 3) of a frame: how many are in each (K,) int, and how
    high above its floor what stands there ends (K,) float64, metres: the highest point that is not
    GAP above the next lower one, however far above the box; 0 without points."""
    columns = np.array(boxes, np.float64)
    floors = columns[:, 2] - columns[:, 5] / 2
    columns[:, 2], columns[:, 5] = floors + REACH / 2, REACH
    inside, first = points_in_boxes(xyz, boxes)
    counts = np.diff(first)
    inside, first = points_in_boxes(xyz, columns + [0, 0, 0, WIDER, WIDER, 0, 0])
    tops = np.zeros(len(boxes))
    for k, floor in enumerate(floors):
        heights = np.sort(xyz[inside[first[k]:first[k + 1]], 2]) - floor
        if len(heights):
            ends = np.flatnonzero(np.diff(heights) > GAP)
            tops[k] = heights[ends[0] if len(ends) else -1]
    return counts, tops
