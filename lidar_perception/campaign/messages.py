"""Mutated messages through the callbacks of every node, all in this process: as bytes, as they come
from DDS, without DDS in between."""

from __future__ import annotations

import importlib
import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from lidar_perception.campaign.case import FAILED, REFUSED, SURVIVED, Case, Outcome, generator, pick
from lidar_perception.campaign.good import CLOUD, good, mutated
from lidar_perception.campaign.mutation import mutate_bytes
from lidar_perception.candidates.warm_up import warm_up
from lidar_perception.nodes import NODES
from lidar_perception.nodes.graph import private_domain
from lidar_perception.nodes.reception import Reception
from lidar_perception.nodes.runtime import ERROR, MARKERS, OK
from lidar_perception.nodes.watch import Context, new_context, parameters_of
from lidar_perception.types import InputError
from lidar_perception.wire.codec import decode
from lidar_perception.wire.transforms import ODOMETRY_MESSAGE
from msg_utils.markers import from_marker_array
from msg_utils.messages import message_class
from msg_utils.point_cloud2 import CloudError, to_array

INFO, TRANSFORM = "sensor_msgs/msg/CameraInfo", "geometry_msgs/msg/TransformStamped"
CAMERA = {"input/camera_info": INFO, "input/extrinsics": TRANSFORM}
SEED = {"input/ground_truth": MARKERS, "clicked_point": "geometry_msgs/msg/PointStamped"}
POINTS = {"input/points": CLOUD}
# Node -> how often it is drawn, its inputs with their types, settings of which each case has one.
# PointPillars takes a tenth of a second, whatever the cloud, alone and fused.
TRIED: dict[str, tuple[float, dict[str, str], list[dict[str, Any]]]] = {
    "ground_segmentation": (20, POINTS | CAMERA, [
        {"ground.method": "threshold", "view.enabled": False},
        {"ground.method": "threshold", "view.enabled": True},
        {"ground.method": "patchwork", "view.enabled": False},
        {"ground.method": "cloth", "view.enabled": False}]),
    "clustering": (20, POINTS, [
        {"clustering.method": "dbscan", "clustering.dbscan.join_bands": False},
        {"clustering.method": "dbscan", "clustering.dbscan.join_bands": True},
        *({"clustering.method": "euclidean", "clustering.euclidean.threshold": t}
          for t in ("local", "global", "fixed"))]),
    "candidate_refinement": (24, POINTS | SEED, [
        {"seed.source": source, "boxes.shape": shape, "confidence.enabled": confidence}
        for source, shape, confidence in (
            ("ground_truth", "axis_aligned", False), ("file", "min_area", False),
            ("automatic", "l_shape", True), ("click", "axis_aligned", True))]),
    "perception": (24, POINTS | CAMERA | SEED, [
        {"seed.source": source, "view.enabled": view, "stm.window": window}
        for source, view, window in (
            ("ground_truth", True, "stretched"), ("file", False, "stretched"),
            ("automatic", False, "metric"), ("click", False, "metric"))]),
    "tracker": (8, {"input/detections": MARKERS, "input/odometry": ODOMETRY_MESSAGE}, [{}]),
    "evaluator": (8, {"input/ground_truth": MARKERS, "input/final": MARKERS}, [{}]),
    "pointnet_detector": (0.5, POINTS, [{}]),
    "pointpillars_detector": (0.2, POINTS, [{}]),
    "fused_detector": (0.2, POINTS, [{}]),
}
THEN_GOOD = 0.125  # of the cases: the next good message must be served
BUG = "this is a bug"  # what a node says of an exception that it did not expect


def case_of(seed: int, number: int) -> Case:
    """One message for one input of one node."""
    rng = generator("messages", seed, number)
    weights = np.array([weight for weight, _, _ in TRIED.values()])
    node = list(TRIED)[int(rng.choice(len(TRIED), p=weights / weights.sum()))]
    _, inputs, variants = TRIED[node]
    topic = "input/points" if "input/points" in inputs and rng.random() < 0.7 else pick(
        rng, list(inputs))
    data, change = mutated(inputs[topic], rng)
    if rng.random() < 0.1:
        data, damage = mutate_bytes(data, rng)
        change += f"; {damage}"
    return Case("messages", f"{node}/{topic}: {change}", seed, number,
                {"node": node, "topic": topic, "params": pick(rng, variants),
                 "then_good": topic != "input/points" or bool(rng.random() < THEN_GOOD)}, data)


class Attempt:
    """All nodes of TRIED, made once, on a private domain."""

    def __init__(self, folder: Path):
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
        self.context = new_context(private_domain())
        warm_up()
        self.nodes = {name: Tried(name, self.context) for name in TRIED}

    def __call__(self, case: Case) -> Outcome:
        return self.nodes[case.settings["node"]].attempt(case)


class Tried:
    """A node whose messages come from here and go nowhere."""

    def __init__(self, name: str, context: Context, **values: Any):
        module = importlib.import_module(f"lidar_perception.nodes.{name}")
        self.node = getattr(module, NODES[name][0])(
            context=context, enable_rosout=False, start_parameter_services=False,
            parameter_overrides=parameters_of(values))
        self.node.start()
        self.inputs = TRIED[name][1]
        self.calls = {s.topic_name.removeprefix(f"/{name}").lstrip("/"): s.callback
                      for s in self.node.subscriptions}
        for made in self.node.inputs:
            if isinstance(made, Reception):  # what it delivers, without its queue
                self.calls[made.topic.removeprefix(f"/{name}").lstrip("/")] = made.deliver
        self.params: dict[str, Any] = {}
        self.sent: list[tuple[Any, bytes]] = []
        for publisher in self.node.publishers:
            publisher.publish = lambda data, by=publisher: self.sent.append((by, data))
            publisher.get_subscription_count = lambda: 1  # so that all is made that can be

    def attempt(self, case: Case) -> Outcome:
        """Deliver the messages that the case needs beside its own, its own, and perhaps a good
        one."""
        self.set(case.settings["params"])
        topic, beside = case.settings["topic"], [t for t in self.inputs if t != "input/points"]
        for other in beside:
            if other != topic:
                self.calls[other](good(self.inputs[other]))
        said = [self.deliver(topic, case.data)]
        if case.settings["then_good"]:
            said += [self.deliver(t, good(self.inputs[t])) for t in [topic, *self.inputs]]
        for _, message in said:
            if BUG in message:
                return Outcome(FAILED, message)
        if (problem := self._unsound()) is not None:
            return Outcome(FAILED, problem)
        level, message = said[0]
        if len(said) > 1 and said[-1][0] == ERROR:
            return Outcome(FAILED, f"a good message was refused after it: {said[-1][1]}")
        return Outcome(REFUSED, message) if level == ERROR else Outcome(SURVIVED)

    def set(self, params: dict[str, Any]) -> None:
        """Change parameters of the node, as at run time."""
        if params != self.params:
            for result in self.node.set_parameters(parameters_of(params)):
                if not result.successful:
                    raise InputError(result.reason)
            self.params = params

    def deliver(self, topic: str, data: bytes) -> tuple[bytes, str]:
        """The level and message of the diagnostics after a message, which starts from OK."""
        if topic == "input/points":
            self.sent.clear()
        self.node.state = (OK, "")
        self.calls[topic](data)
        return self.node.state

    def _unsound(self) -> str | None:
        """What is wrong with what the node has published; None if nothing is."""
        clouds, boxes = message_class(CLOUD), message_class(MARKERS)
        for publisher, data in self.sent:
            topic, kind = publisher.topic_name, publisher.msg_type
            try:
                if kind is clouds:
                    to_array(decode(data, CLOUD))
                elif kind is boxes and not np.isfinite(
                        from_marker_array(decode(data, MARKERS)).boxes).all():
                    return f"{topic} has boxes that are not finite"
            except (InputError, CloudError, ValueError) as error:
                return f"{topic} cannot be read: {error}"
        if any(isinstance(v, float) and math.isnan(v) for v in self.node.counts.values()):
            return f"NaN in the diagnostics: {self.node.counts}"
        return None
