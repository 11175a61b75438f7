"""Publishers of detections, cluster boxes and obstacles, shared by several nodes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from std_msgs.msg import Float64

from lidar_perception.candidates.refine import Candidates
from lidar_perception.clustering.shapes import classify_by_diagonal
from lidar_perception.ground.obstacles import find_obstacles
from lidar_perception.nodes.diagnostics import OK, WARN
from lidar_perception.nodes.interfaces import CLOUD, DETECTIONS_3D, RELIABLE
from lidar_perception.nodes.runtime import LidarNode
from lidar_perception.nodes.track_outputs import MarkerOutput, TrackOutputs, has_detections_3d
from lidar_perception.robot.poses import invert_pose, transform_boxes
from lidar_perception.types import CLASSES, Detections, InputError
from lidar_perception.wire.array_codec import encode_detection_array
from lidar_perception.wire.codec import make_bag_message
from lidar_perception.wire.messages import make_detection_rows, make_pose_covariances, make_xyz_cloud
from msg_utils.markers import make_marker_rows
from msg_utils.messages import load_message_class
from msg_utils.stamps import make_header, to_ns


def to_output_frame(node: LidarNode, header: Any, boxes: np.ndarray) -> tuple[Any, np.ndarray]:
    """Transform boxes (K, 7) from the level frame of a cloud to the output frame.

    Returns:
        The header in the output frame, and the boxes in float64, because coordinates in a map can be
        large.
    """
    placement = node.transforms.find_placement(header)
    if placement.frame_id != header.frame_id:
        header = make_header(to_ns(header.stamp), placement.frame_id, make_bag_message)
    return header, boxes if placement.out is None else transform_boxes(boxes, placement.out)


class ClusterBoxes:
    """Publisher of ~/output/boxes, which are computed only while there are subscribers."""

    def __init__(self, node: LidarNode):
        self.node, self.markers = node, MarkerOutput(node, "boxes")

    def publish(self, header: Any, fit_boxes: Callable[[], np.ndarray]) -> None:
        """Publish the boxes that fit_boxes() returns. Texts have the id, and the class by the size of the box."""
        if not self.markers.publisher.get_subscription_count():
            return
        header, boxes = to_output_frame(self.node, header, fit_boxes())
        ids = range(1, len(boxes) + 1)  # the ids in the column cluster_id
        texts = [
            {"id": i, **({"size_class": CLASSES[class_id]} if class_id >= 0 else {})}
            for i, class_id in zip(ids, classify_by_diagonal(boxes), strict=True)
        ]
        labels = ["cluster"] * len(boxes)
        self.markers.publish(
            header, lambda previous: make_marker_rows(boxes, labels, ids=ids, extras=texts, previous=previous)
        )


class Obstacles:
    """Publisher of ~/output/obstacles for a costmap, computed only while there are subscribers.

    Obstacles are the non-ground points in the height band of the parameters, with x, y, z and, if
    the cloud has it, intensity. The node must have node_params.obstacles and params.ground.
    """

    def __init__(self, node: LidarNode):
        self.node, self.publisher = node, node.outputs.advertise("obstacles", CLOUD)

    def publish(self, msg: Any, xyz: np.ndarray, ground: np.ndarray, indices: np.ndarray) -> None:
        """Publish the obstacles of a cloud in the frame of the cloud.

        Args:
            msg: the cloud.
            xyz: (M, 3) points in the level frame.
            ground: (M,) bool.
            indices: (M,) indices of the points in the cloud.
        """
        if self.publisher.get_subscription_count():
            placement = self.node.transforms.find_placement(msg.header)
            params = self.node.transforms.with_mounting(self.node.params, placement)
            is_obstacle = find_obstacles(xyz, ground, self.node.node_params.obstacles, params.ground.sensor_pose)
            self.publisher.publish(
                make_xyz_cloud(
                    msg,
                    placement.to_cloud_frame(xyz.compress(is_obstacle, axis=0)),
                    indices.compress(is_obstacle),
                    make_bag_message,
                )
            )


class DetectionOutputs:
    """Publishers of detections, step times and, with tracking.enabled, tracks.

    Detections are also published as detections_3d if vision_msgs is installed.
    """

    def __init__(self, node: LidarNode, steps: tuple[str, ...]):
        self.node = node
        self.markers = MarkerOutput(node, "detections")
        self.detections_3d = None
        if has_detections_3d():
            self.detections_3d = node.create_publisher(
                load_message_class(DETECTIONS_3D), "~/output/detections_3d", RELIABLE
            )
        self.step_times = {step: node.create_publisher(Float64, f"~/debug/{step}_ms", RELIABLE) for step in steps}
        self.tracks = (
            TrackOutputs(node, lambda: node.node_params, clouds=True) if node.node_params.tracking.enabled else None
        )

    def publish(
        self,
        header: Any,
        detections: Detections,
        ms: Mapping[str, float],
        xyz: np.ndarray,
        *,
        tracker_input: Detections | None = None,
        clusters: np.ndarray | None = None,
    ) -> str | None:
        """Publish detections that are in the level frame, and their tracks in the cloud's frame.

        Args:
            header: header of the cloud.
            detections: detections above the thresholds.
            ms: {step: its time in ms}.
            xyz: (N, 3) points in the level frame, for the tracker.
            tracker_input: detections to track, including those below the thresholds; by default
                `detections`.
            clusters: (K,) cluster_id of each detection.

        Returns:
            The problem of the tracker with its remedy, or None.
        """
        cloud_header, tracker_input = header, detections if tracker_input is None else tracker_input
        header, boxes = to_output_frame(self.node, header, detections.boxes)
        detections = replace(detections, boxes=boxes)
        self.markers.publish(header, lambda previous: make_detection_rows(detections, previous, clusters))
        if self.detections_3d is not None and self.detections_3d.get_subscription_count():
            self.detections_3d.publish(
                encode_detection_array(
                    detections.boxes,
                    detections.labels,
                    detections.scores,
                    header=header,
                    covariances=make_pose_covariances(detections.class_ids),
                )
            )
        for step, publisher in self.step_times.items():
            if step in ms:
                publisher.publish(Float64(data=ms[step]))
        if self.tracks is None:
            return None
        placement = self.node.transforms.find_placement(cloud_header)
        if placement.level is not None:
            boxes = transform_boxes(tracker_input.boxes, invert_pose(placement.level))
            tracker_input = replace(tracker_input, boxes=boxes)
        return self.tracks.publish(cloud_header, tracker_input, placement.to_cloud_frame(xyz))


class CandidateOutputs:
    """Publishers of candidates as detections, and of earlier stages on ~/debug/stage1 and stage2."""

    def __init__(self, node: LidarNode, steps: tuple[str, ...] = ("height", "stm", "cpa")):
        self.node = node
        self.stages = {stage: MarkerOutput(node, f"~/debug/{stage}") for stage in ("stage1", "stage2")}
        self.final = DetectionOutputs(node, steps)

    def publish(
        self, header: Any, xyz: np.ndarray, find_candidates: Callable[[], Candidates], problem: str | None = None
    ) -> None:
        """Find candidates and publish them.

        Args:
            header: header of the cloud.
            xyz: (N, 3) points in the level frame.
            find_candidates: returns the candidates; if it raises InputError, empty arrays are
                published.
            problem: a known problem of the frame, for the diagnostics.
        """
        try:
            candidates = find_candidates()
        except InputError as error:
            candidates, problem = Candidates.none(), problem or str(error)
        for stage, markers in self.stages.items():
            if markers.publisher.get_subscription_count():
                output_header, boxes = to_output_frame(self.node, header, getattr(candidates, stage).boxes)
                detections = replace(getattr(candidates, stage), boxes=boxes)
                markers.publish(output_header, partial(make_detection_rows, detections))
        tracking_problem = self.final.publish(
            header, candidates.final, candidates.ms, xyz, clusters=candidates.clusters
        )
        self._diagnose(candidates, problem or tracking_problem)

    def _diagnose(self, candidates: Candidates, problem: str | None) -> None:
        self.node.diagnostics.counts["candidates"] = len(candidates.final)
        if problem:
            self.node.diagnostics.report(WARN, problem)
        elif self.node.params.seed.source == "automatic" or len(candidates.final):
            self.node.diagnostics.report(OK, "detecting")
        elif len(candidates.stage1) == 0:
            self.node.diagnostics.report(WARN, "no cluster has the height of the seed; choose another seed")
        else:
            self.node.diagnostics.report(
                WARN,
                f"none of the {len(candidates.stage1)} clusters with the height of the seed matches it; "
                "lower stm.threshold or choose another seed",
            )
