"""Nodes in this process, fed through their callbacks with bytes as they come from DDS."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

import numpy as np
from rclpy.logging import LoggingSeverity, set_logger_level

from fuzz.case import FAILED, REFUSED, SURVIVED, Outcome
from fuzz.valid_messages import CLOUD, make_valid_message
from lidar_perception.candidates.warm_up import warm_up
from lidar_perception.nodes import load_node_class
from lidar_perception.nodes.diagnostics import ERROR, OK
from lidar_perception.nodes.external_node import Context, create_context, to_parameters
from lidar_perception.nodes.graph import reserve_domain
from lidar_perception.nodes.interfaces import MARKERS
from lidar_perception.nodes.reception import Reception
from lidar_perception.types import InputError
from lidar_perception.wire.codec import decode
from lidar_perception.wire.transforms import ODOMETRY_MESSAGE
from msg_utils.markers import from_marker_array
from msg_utils.messages import load_message_class
from msg_utils.point_cloud2 import CloudError, to_array

CAMERA = {"input/camera_info": "sensor_msgs/msg/CameraInfo", "input/extrinsics": "geometry_msgs/msg/TransformStamped"}
SEED = {"input/ground_truth": MARKERS, "clicked_point": "geometry_msgs/msg/PointStamped"}
POINTS = {"input/points": CLOUD}
# Node -> weight, inputs with their types, and the settings from which each case draws one. Detectors have small
# weights because they take a tenth of a second per cloud.
INPUTS: dict[str, tuple[float, dict[str, str], list[dict[str, Any]]]] = {
    "ground_segmentation": (
        20,
        POINTS | CAMERA,
        [
            {"ground.method": "threshold", "view.enabled": False},
            {"ground.method": "threshold", "view.enabled": True},
            {"ground.method": "patchwork", "view.enabled": False},
            {"ground.method": "cloth", "view.enabled": False},
        ],
    ),
    "clustering": (
        20,
        POINTS,
        [
            {"clustering.method": "dbscan", "clustering.dbscan.join_bands": False},
            {"clustering.method": "dbscan", "clustering.dbscan.join_bands": True},
            *(
                {"clustering.method": "euclidean", "clustering.euclidean.threshold": t}
                for t in ("local", "global", "fixed")
            ),
        ],
    ),
    "candidate_refinement": (
        24,
        POINTS | SEED,
        [
            {"seed.source": source, "boxes.shape": shape, "confidence.enabled": confidence}
            for source, shape, confidence in (
                ("ground_truth", "axis_aligned", False),
                ("file", "min_area", False),
                ("automatic", "l_shape", True),
                ("click", "axis_aligned", True),
            )
        ],
    ),
    "perception": (
        24,
        POINTS | CAMERA | SEED,
        [
            {"seed.source": source, "view.enabled": view, "stm.window": window}
            for source, view, window in (
                ("ground_truth", True, "stretched"),
                ("file", False, "stretched"),
                ("automatic", False, "metric"),
                ("click", False, "metric"),
            )
        ],
    ),
    "tracker": (8, {"input/detections": MARKERS, "input/odometry": ODOMETRY_MESSAGE}, [{}]),
    "evaluator": (8, {"input/ground_truth": MARKERS, "input/final": MARKERS} | CAMERA, [{}]),
    "pointnet_detector": (0.5, POINTS, [{}]),
    "pointpillars_detector": (0.2, POINTS, [{}]),
    "fused_detector": (0.2, POINTS, [{}]),
}
WEIGHTS = np.array([weight for weight, _, _ in INPUTS.values()])
BUG = "this is a bug"  # state of a node after an unexpected exception


def draw_node(rng: np.random.Generator) -> str:
    """Draw the name of a node with probability proportional to its weight."""
    return list(INPUTS)[int(rng.choice(len(INPUTS), p=WEIGHTS / WEIGHTS.sum()))]


class Nodes:
    """All nodes of INPUTS on a private domain, or the given ones. Parts derive from it."""

    def __init__(self, folder: Path, nodes: dict[str, FedNode] | None = None):
        if nodes is None:
            os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
            set_logger_level("", LoggingSeverity.FATAL)
            warm_up()
            context = create_context(reserve_domain())
            nodes = {name: FedNode(name, context) for name in INPUTS}
        self.nodes = nodes


class FedNode:
    """Node that gets its messages by calls; `sent` collects its output."""

    def __init__(self, name: str, context: Context, **values: Any):
        self.node = load_node_class(name)(
            context=context,
            enable_rosout=False,
            start_parameter_services=False,
            parameter_overrides=to_parameters(values),
        )
        self.node.start()
        self.inputs = INPUTS[name][1]
        self.calls = {s.topic_name.removeprefix(f"/{name}").lstrip("/"): s.callback for s in self.node.subscriptions}
        for item in self.node.inputs.items:
            if isinstance(item, Reception):  # delivers immediately, without the input queue
                self.calls[item.topic.removeprefix(f"/{name}").lstrip("/")] = item.deliver
        self.params: dict[str, Any] = {}
        self.sent: list[tuple[Any, bytes]] = []
        for publisher in self.node.publishers:
            publisher.publish = lambda data, by=publisher: self.sent.append((by, data))
            publisher.get_subscription_count = lambda: 1  # so that nodes compute every output

    def attempt(self, topic: str, data: bytes, params: dict[str, Any], then_valid: bool) -> Outcome:
        """Deliver valid messages to the other inputs, then `data`. With then_valid, deliver valid messages again,
        which must have a result."""
        if params != self.params:
            results = self.node.set_parameters(to_parameters(params))
            assert all(result.successful for result in results), results
            self.params = params
        for other in self.inputs:
            if other not in (topic, "input/points"):
                self.calls[other](make_valid_message(self.inputs[other]))
        states = [self.deliver(topic, data)]
        if then_valid:
            states += self.deliver_valid(topic)
        outcome = self.judge(states)
        if outcome.verdict == FAILED:
            return outcome
        level, message = states[0]
        return Outcome(REFUSED, message) if level == ERROR else Outcome(SURVIVED)

    def deliver(self, topic: str, data: bytes) -> tuple[bytes, str]:
        """Deliver a message in state OK and return level and text of the node's state afterwards."""
        if topic == "input/points":
            self.sent.clear()
        self.node.diagnostics.state = (OK, "")
        self.calls[topic](data)
        return self.node.diagnostics.state

    def deliver_valid(self, *first: str) -> list[tuple[bytes, str]]:
        """Deliver a valid message to some inputs, then to all, the cloud last."""
        return [
            self.deliver(t, make_valid_message(self.inputs[t]))
            for t in [*first, *sorted(self.inputs, key=lambda t: t == "input/points")]
        ]

    def judge(self, states: list[tuple[bytes, str]]) -> Outcome:
        """Return a failure after an exception or unreadable output, or if the valid last message was rejected."""
        problem = next((message for _, message in states if BUG in message), None)
        if problem is None and len(states) > 1 and states[-1][0] == ERROR:
            problem = f"a valid message was refused: {states[-1][1]}"
        problem = problem or self._invalid_output()
        return Outcome(FAILED, problem) if problem else Outcome(SURVIVED)

    def _invalid_output(self) -> str | None:
        clouds, boxes = load_message_class(CLOUD), load_message_class(MARKERS)
        for publisher, data in self.sent:
            topic, kind = publisher.topic_name, publisher.msg_type
            try:
                if kind is clouds:
                    to_array(decode(data, CLOUD))
                elif kind is boxes and not np.isfinite(from_marker_array(decode(data, MARKERS)).boxes).all():
                    return f"{topic} has boxes that are not finite"
            except (InputError, CloudError, ValueError) as error:
                return f"{topic} cannot be read: {error}"
        if any(isinstance(v, float) and math.isnan(v) for v in self.node.diagnostics.counts.values()):
            return f"NaN in the diagnostics: {self.node.diagnostics.counts}"
        return None
