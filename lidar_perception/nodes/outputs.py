"""Publishing what was found in a frame, shared by the nodes that find objects."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from std_msgs.msg import Float64

from lidar_perception.candidates.refine import Candidates
from lidar_perception.clustering.shapes import classify_by_diagonal
from lidar_perception.ground.obstacles import find_obstacles
from lidar_perception.nodes.runtime import CLOUD, MARKERS, OK, RELIABLE, WARN, LidarNode
from lidar_perception.nodes.track_outputs import (
    DETECTIONS_3D,
    TrackOutputs,
    has_detections_3d,
    lifetime_ns,
)
from lidar_perception.robot.poses import invert_pose, transform_boxes
from lidar_perception.types import CLASSES, Detections, InputError
from lidar_perception.wire.codec import bag_message, encode
from lidar_perception.wire.messages import make_detection_markers, make_xyz_cloud
from msg_utils.detections import to_detection_array
from msg_utils.markers import marker_keys, to_marker_array
from msg_utils.messages import message_class, ros_message
from msg_utils.stamps import header_message, to_ns


def placed(node: LidarNode, header: Any, boxes: np.ndarray) -> tuple[Any, np.ndarray]:
    """header and boxes (K, 7), found in the levelled frame of a cloud with this header, in the
    frame that the results go out in; float64 there, as a map may be far from its origin."""
    placing = node.transforms.placing(header)
    if placing.frame_id != header.frame_id:
        header = header_message(to_ns(header.stamp), placing.frame_id, bag_message)
    return header, boxes if placing.out is None else transform_boxes(boxes, placing.out)


class ClusterBoxes:
    """~/output/boxes, made only while somebody subscribes."""

    def __init__(self, node: LidarNode):
        self.node = node
        self.publisher = node.output("boxes", MARKERS)
        self.shown: Any = ()

    def publish(self, header: Any, boxes: Callable[[], np.ndarray]) -> None:
        if self.publisher.get_subscription_count():
            header, found = placed(self.node, header, boxes())
            ids = range(1, len(found) + 1)  # as in the column cluster_id
            markers = to_marker_array(found, ["cluster"] * len(found), header=header,
                                      make=bag_message, ids=ids, previous=self.shown,
                                      lifetime_ns=lifetime_ns(self.node),
                                      extras=_texts(found, ids))
            self.shown = marker_keys(markers)
            self.publisher.publish(encode(markers))


def _texts(boxes: np.ndarray, ids: Sequence[int]) -> list[dict]:
    """For the text of each box's marker: its id, and what it could be by its length and width
    alone."""
    return [{"id": i, **({"size_class": CLASSES[c]} if c >= 0 else {})}
            for i, c in zip(ids, classify_by_diagonal(boxes), strict=True)]


class Obstacles:
    """~/output/obstacles for a costmap, made only while somebody subscribes: x y z, and intensity
    where the cloud has one, of what is no ground and in the height band of the parameters. node
    has the groups robot.obstacles and params.ground."""

    def __init__(self, node: LidarNode):
        self.node, self.publisher = node, node.output("obstacles", CLOUD)

    def publish(self, msg: Any, xyz: np.ndarray, ground: np.ndarray, indices: np.ndarray) -> None:
        """Of levelled points (M, 3) that are ground (M,) or not, at indices (M,) in the cloud
        msg, in whose frame they are published."""
        if self.publisher.get_subscription_count():
            placing = self.node.transforms.placing(msg.header)
            params = self.node.transforms.mounted(self.node.params, placing)
            chosen = find_obstacles(xyz, ground, self.node.robot.obstacles,
                                    params.ground.sensor_pose)
            self.publisher.publish(encode(make_xyz_cloud(
                msg, placing.to_cloud_frame(xyz.compress(chosen, axis=0)), indices.compress(chosen),
                bag_message)))


class DetectionMarkers:
    """A topic with detections as markers."""

    def __init__(self, node: LidarNode, topic: str):
        self.node, self.publisher = node, node.output(topic, MARKERS)
        self.shown: Any = ()

    def publish(self, header: Any, detections: Detections,
                clusters: np.ndarray | None = None) -> None:
        """In the frame of header, as they are."""
        message = make_detection_markers(detections, header, bag_message, self.shown,
                                         lifetime_ns(self.node), clusters)
        self.shown = marker_keys(message)
        self.publisher.publish(encode(message))


class DetectionOutputs:
    """~/output/detections (and ~/output/detections_3d where vision_msgs is installed), the time
    of each step, and with the parameter tracking.enabled the tracks."""

    def __init__(self, node: LidarNode, steps: tuple[str, ...]):
        self.node = node
        self.markers = DetectionMarkers(node, "detections")
        self.detections_3d = None
        if has_detections_3d():
            self.detections_3d = node.create_publisher(
                message_class(DETECTIONS_3D), "~/output/detections_3d", RELIABLE)
        self.step_times = {step: node.create_publisher(Float64, f"~/debug/{step}_ms", RELIABLE)
                           for step in steps}
        self.tracks = (TrackOutputs(node, lambda: node.robot, clouds=True)
                       if node.robot.tracking.enabled else None)

    def publish(self, header: Any, detections: Detections, ms: Mapping[str, float],
                xyz: np.ndarray, *, weak: Detections | None = None,
                clusters: np.ndarray | None = None) -> str | None:
        """Publish detections of the scan xyz (N, 3), with the cluster_id of each where it is known,
        the times of the steps that are known, and where there is a tracker the tracks; it is given
        `weak`, with those below the thresholds too, if there are any. All are of the levelled
        cloud; tracks are in the cloud's frame. Returns what was wrong for the tracker."""
        cloud, found = header, detections if weak is None else weak
        header, boxes = placed(self.node, header, detections.boxes)
        detections = replace(detections, boxes=boxes)
        self.markers.publish(header, detections, clusters)
        if self.detections_3d is not None and self.detections_3d.get_subscription_count():
            self.detections_3d.publish(to_detection_array(
                detections.boxes, [CLASSES[i] for i in detections.class_ids], detections.scores,
                make=ros_message,
                header=header_message(to_ns(header.stamp), header.frame_id, ros_message)))
        for step, publisher in self.step_times.items():
            if step in ms:
                publisher.publish(Float64(data=ms[step]))
        if self.tracks is None:
            return None
        placing = self.node.transforms.placing(cloud)
        if placing.level is not None:
            found = replace(found, boxes=transform_boxes(found.boxes, invert_pose(placing.level)))
        return self.tracks.publish(cloud, found, placing.to_cloud_frame(xyz))


class CandidateOutputs:
    """The candidates as detections, and the earlier stages under ~/debug/stage1 and
    ~/debug/stage2."""

    def __init__(self, node: LidarNode, steps: tuple[str, ...] = ("height", "stm", "cpa")):
        self.node = node
        self.stages = {stage: DetectionMarkers(node, f"~/debug/{stage}")
                       for stage in ("stage1", "stage2")}
        self.final = DetectionOutputs(node, steps)

    def publish(self, header: Any, xyz: np.ndarray, find: Callable[[], Candidates],
                problem: str | None = None) -> None:
        """Publish what find() gives for the scan xyz (N, 3); where it raises InputError, no
        candidates and the reason. problem is what is known to be wrong with the frame already."""
        try:
            candidates = find()
        except InputError as error:
            candidates, problem = Candidates.none(), problem or str(error)
        for stage, markers in self.stages.items():
            if markers.publisher.get_subscription_count():
                found = getattr(candidates, stage)
                place, boxes = placed(self.node, header, found.boxes)
                markers.publish(place, replace(found, boxes=boxes))
        untracked = self.final.publish(header, candidates.final, candidates.ms, xyz,
                                       clusters=candidates.clusters)
        self._diagnose(candidates, problem or untracked)

    def _diagnose(self, candidates: Candidates, problem: str | None) -> None:
        self.node.counts["candidates"] = len(candidates.final)
        if problem:
            self.node.report(WARN, problem)
        elif len(candidates.stage1) == 0:
            self.node.report(WARN, "no cluster has the seed's height")
        elif len(candidates.final) == 0:
            self.node.report(WARN, f"none of {len(candidates.stage1)} clusters of the seed's "
                             "height looks like the seed")
        else:
            self.node.report(OK, "detecting")
