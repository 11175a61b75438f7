"""Publishing the candidates of a frame, shared by candidate_refinement and perception."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from typing import Any

import numpy as np
from std_msgs.msg import Float64

from lidar_perception.candidates.refine import Candidates
from lidar_perception.clustering.shapes import class_by_diagonal
from lidar_perception.datasets.bag import bag_message, encode
from lidar_perception.messages import detection_markers
from lidar_perception.nodes.runtime import MARKERS, OK, RELIABLE, WARN, LidarNode
from lidar_perception.types import CLASSES, InputError
from msg_utils.detections import to_detection_array
from msg_utils.markers import marker_keys, to_marker_array
from msg_utils.messages import message_class, ros_message
from msg_utils.stamps import header_message, to_ns


class ClusterBoxes:
    """~/output/boxes, made only while somebody subscribes."""

    def __init__(self, node: LidarNode):
        self.publisher = node.output("boxes", MARKERS)
        self.shown: Any = ()

    def publish(self, header: Any, boxes: Callable[[], np.ndarray]) -> None:
        if self.publisher.get_subscription_count():
            found = boxes()
            markers = to_marker_array(found, ["cluster"] * len(found), header=header,
                                      make=bag_message, previous=self.shown,
                                      extras=_size_classes(found))
            self.shown = marker_keys(markers)
            self.publisher.publish(encode(markers))


def _size_classes(boxes: np.ndarray) -> list[dict]:
    """What each box could be by its length and width alone, for the text of its marker."""
    ids = class_by_diagonal(boxes)
    return [{"size_class": CLASSES[i]} if i >= 0 else {} for i in ids]


class CandidateOutputs:
    """~/output/detections (and ~/output/detections_3d where vision_msgs is installed), the earlier
    stages under ~/debug/stage1 and ~/debug/stage2, and the time of each step."""

    def __init__(self, node: LidarNode, steps: tuple[str, ...] = ("height", "stm", "cpa")):
        self.node = node
        self.markers = {"stage1": node.output("~/debug/stage1", MARKERS),
                        "stage2": node.output("~/debug/stage2", MARKERS),
                        "final": node.output("detections", MARKERS)}
        self.shown: dict[str, Any] = dict.fromkeys(self.markers, ())
        self.detections_3d = None
        if importlib.util.find_spec("vision_msgs"):
            self.detections_3d = node.create_publisher(
                message_class("vision_msgs/msg/Detection3DArray"), "~/output/detections_3d",
                RELIABLE)
        self.step_times = {step: node.create_publisher(Float64, f"~/debug/{step}_ms", RELIABLE)
                           for step in steps}

    def publish(self, header: Any, find: Callable[[], Candidates],
                problem: str | None = None) -> None:
        """Publish what find() gives; where it raises InputError, no candidates and the reason.
        problem is what is known to be wrong with the frame already."""
        try:
            candidates = find()
        except InputError as error:
            candidates, problem = Candidates.none(), problem or str(error)
        for stage, publisher in self.markers.items():
            if stage == "final" or publisher.get_subscription_count():
                message = detection_markers(getattr(candidates, stage), header, bag_message,
                                            self.shown[stage])
                self.shown[stage] = marker_keys(message)
                publisher.publish(encode(message))
        if self.detections_3d is not None and self.detections_3d.get_subscription_count():
            final = candidates.final
            self.detections_3d.publish(to_detection_array(
                final.boxes, [CLASSES[i] for i in final.class_ids], final.scores, make=ros_message,
                header=header_message(to_ns(header.stamp), header.frame_id, ros_message)))
        for step, publisher in self.step_times.items():
            if step in candidates.ms:
                publisher.publish(Float64(data=candidates.ms[step]))
        self._diagnose(candidates, problem)

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
