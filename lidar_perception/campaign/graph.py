"""The graph as it runs on a robot: a process for each node, real DDS, a domain of its own, and this
process as the sensor."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from time import monotonic
from typing import Any

from lidar_perception.campaign.good import good, markers
from lidar_perception.candidates.warm_up import warm_up
from lidar_perception.nodes.graph import (
    CAMERA,
    POINTNET,
    SINGLE,
    STAGES,
    Processes,
    evaluation,
    private_domain,
)
from lidar_perception.nodes.runtime import CLOUD, LATCHED, MARKERS, RELIABLE
from lidar_perception.nodes.shared_memory import use_large_shared_memory
from lidar_perception.nodes.watch import Outside
from lidar_perception.types import InputError
from lidar_perception.wire.topics import CLICK, POINTS, TRUTH
from msg_utils.messages import message_class
from msg_utils.stamps import SECOND

INFO, TRANSFORM = "sensor_msgs/msg/CameraInfo", "geometry_msgs/msg/TransformStamped"
TOPICS = {POINTS: CLOUD, TRUTH: MARKERS, CLICK: "geometry_msgs/msg/PointStamped",
          **{f"/{topic}": kind for topic, kind in zip(CAMERA.values(), (INFO, TRANSFORM))}}
START_SECONDS, ANSWER_SECONDS = 240.0, 90.0
AFTER = 1_800_000_000_123_456_789  # ns; a stamp that no other message has
SPEAKING = {"evaluator", "bag_recorder"}  # have no clouds of which to name the stamp


class Graph:
    """Nodes that are running, and what they say. A context manager that ends them."""

    def __init__(self, folder: Path, chosen: tuple[str, ...]):
        self.folder = folder
        use_large_shared_memory()
        warm_up()  # once, not by every node
        self.domain = private_domain()
        self.processes = Processes(folder / "logs", self.domain)
        remap, own = evaluation(folder / "scores.json")
        self.nodes: dict[str, tuple[Mapping[str, str], dict[str, Any]]] = {
            **{name: (rules, {}) for name, rules in {**POINTNET, **STAGES, **SINGLE}.items()},
            "evaluator": (remap, own),
            "bag_recorder": ({}, {"bag": str(folder / "recorded"),
                                  "topics": [POINTS, "/clustering/output/points"]})}
        self.nodes = {name: self.nodes[name] for name in chosen}

    def __enter__(self) -> Graph:
        self.processes.__enter__()
        self.outside = Outside(self.domain, "campaign")
        for name in self.nodes:
            self.start(name)
        self.publishers = {topic: self.outside.node.create_publisher(
            message_class(kind), topic, LATCHED if "camera" in topic else RELIABLE)
            for topic, kind in TOPICS.items()}
        try:
            self.alive(START_SECONDS)
        except BaseException:  # nothing goes on that nobody can end
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.processes.stop()
        self.outside.__exit__()

    def start(self, name: str) -> None:
        """Start a node, or one that has ended again."""
        remap, params = self.nodes[name]
        self.processes.start(name, remap, params)

    def send(self, topic: str, data: bytes) -> None:
        """Publish CDR bytes as they are."""
        self.publishers[topic].publish(data)

    def listen(self, topic: str, kind: str, heard: Callable[[bytes], None]) -> None:
        """heard(CDR bytes) of every message on a topic."""
        self.outside.node.create_subscription(message_class(kind), topic, heard, RELIABLE,
                                              raw=True)

    def spin(self, seconds: float) -> None:
        """Let messages come in for so long."""
        self.outside.until(lambda: False, seconds)

    def count(self, node: str, key: str) -> int:
        """A number of the node's last diagnostics; 0 where there is none."""
        return int(self.outside.value_of(node, key) or 0)

    def alive(self, seconds: float = ANSWER_SECONDS) -> None:
        """InputError unless every node takes part in good clouds that are sent until then: stages
        and detectors have the stamp of one in their diagnostics, and the others still speak."""
        waiting, since, stamps = set(self.nodes), monotonic(), set()
        self.outside.diagnostics.clear()
        while waiting:
            self.processes.check()
            if monotonic() - since > seconds:
                raise InputError(f"{', '.join(sorted(waiting))} did not answer a good cloud within "
                                 f"{seconds:g} s")
            stamp = AFTER + int((monotonic() - since) * 1e9)
            stamps.add(str(stamp))
            for topic, kind in TOPICS.items():
                self.send(topic, stamped(good(kind), stamp) if kind == CLOUD else
                          markers(True, stamp) if kind == MARKERS else good(kind))
            self.spin(0.7)
            waiting -= {name for name in waiting if name in self.outside.diagnostics and (
                name in SPEAKING or self.outside.value_of(name, "last_stamp_ns") in stamps)}

    def bugs(self) -> list[str]:
        """What the nodes' logs hold of unexpected exceptions."""
        found = []
        for name in self.nodes:
            text = (self.processes.logs / f"{name}.log").read_text(errors="replace")
            found += [f"{name}: {line[-300:]}" for line in text.splitlines()
                      if "this is a bug" in line]
        return found


class LazyGraph:
    """All nodes in one graph, started when it is asked for, and again once it has been closed."""

    def __init__(self, folder: Path):
        self.folder, self.starts = folder, 0
        self.running: Graph | None = None

    def __call__(self) -> Graph:
        if self.running is None:
            self.starts += 1
            self.running = Graph(self.folder / f"graph{self.starts}", graph_nodes()).__enter__()
        return self.running

    def close(self) -> None:
        """End the nodes."""
        if self.running is not None:
            self.running.__exit__()
            self.running = None


def stamped(data: bytes, stamp_ns: int) -> bytes:
    """A message whose header comes first, with another header.stamp."""
    seconds, rest = divmod(stamp_ns, SECOND)
    return data[:4] + struct.pack("<iI", seconds, rest) + data[12:]


def graph_nodes() -> tuple[str, ...]:
    """All that can stand in one graph."""
    return (*STAGES, *(name for name in POINTNET if name not in STAGES), *SINGLE, "evaluator",
            "bag_recorder")
