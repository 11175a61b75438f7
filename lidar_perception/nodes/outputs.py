"""Publishing the candidates of a frame, shared by candidate_refinement and perception."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from typing import Any

from std_msgs.msg import Float64
from visualization_msgs.msg import MarkerArray

from lidar_perception.candidates.refine import Candidates
from lidar_perception.messages import detection_markers
from lidar_perception.nodes.runtime import OK, RELIABLE, WARN, LidarNode
from lidar_perception.types import CLASSES, InputError
from msg_utils.detections import to_detection_array
from msg_utils.markers import marker_keys
from msg_utils.messages import ros_message


class CandidateOutputs:
    """~/output/detections (and ~/output/detections_3d where vision_msgs is installed), the earlier
    stages under ~/debug/stage1 and ~/debug/stage2, and the time of each step."""

    def __init__(self, node: LidarNode):
        self.node = node
        self.markers = {"stage1": node.output("~/debug/stage1", MarkerArray, RELIABLE),
                        "stage2": node.output("~/debug/stage2", MarkerArray, RELIABLE),
                        "final": node.output("detections", MarkerArray, RELIABLE)}
        self.shown: dict[str, Any] = dict.fromkeys(self.markers, ())
        self.detections_3d = None
        if importlib.util.find_spec("vision_msgs"):
            from vision_msgs.msg import Detection3DArray
            self.detections_3d = node.output("detections_3d", Detection3DArray, RELIABLE)
        self.step_times: dict[str, Any] = {}

    def publish(self, header: Any, find: Callable[[], Candidates]) -> Candidates:
        """Publish what find() gives; where it raises InputError, no candidates and the reason."""
        try:
            candidates, problem = find(), None
        except InputError as error:
            candidates, problem = Candidates.none(), str(error)
        for stage, publisher in self.markers.items():
            if stage == "final" or publisher.get_subscription_count():
                message = detection_markers(getattr(candidates, stage), header, ros_message,
                                            self.shown[stage])
                self.shown[stage] = marker_keys(message)
                publisher.publish(message)
        if self.detections_3d is not None and self.detections_3d.get_subscription_count():
            final = candidates.final
            self.detections_3d.publish(to_detection_array(
                final.boxes, [CLASSES[i] for i in final.class_ids], final.scores, header=header,
                make=ros_message))
        for step, ms in candidates.ms.items():
            if step not in self.step_times:
                self.step_times[step] = self.node.create_publisher(
                    Float64, f"~/debug/{step}_ms", RELIABLE)
            self.step_times[step].publish(Float64(data=ms))
        self._diagnose(candidates, problem)
        return candidates

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
