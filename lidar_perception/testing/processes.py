"""Nodes and other programs as processes of a test, on one ROS domain."""

from __future__ import annotations

import signal
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lidar_perception.nodes.graph import CLOUDS, Graph, Processes, build_graph, relative_name
from lidar_perception.param_fields import flatten
from lidar_perception.testing.forking import Forked
from lidar_perception.wire.topics import POINTS

LAST_LINES = 60  # of a log, where a test failed


class NodesUnderTest(Processes):
    """Processes whose logs are shown when a test fails while they run. Our nodes are forked from a
    process that has loaded their code, unless they are to be fresh: then each is a Python of its
    own, as in use, and takes seconds to start."""

    entered: list[NodesUnderTest] = []  # of all tests
    fresh = False

    def __enter__(self) -> NodesUnderTest:
        super().__enter__()
        self.entered.append(self)
        return self

    def __exit__(self, *error: Any) -> None:
        self.entered.remove(self)
        super().__exit__(*error)

    def run_node(self, name: str, arguments: Sequence[str]) -> None:
        """Start one of our executables."""
        if self.fresh:
            super().run_node(name, arguments)
        else:
            self.running[name] = Forked(arguments, self.environment, self.logs / f"{name}.log")

    def start_graph(self, detectors: Sequence[str], params: Any = None, *, single: bool = False,
                    points: str = relative_name(POINTS), namespace: str = "") -> Graph:
        """Start the nodes of one or several of candidates, pointpillars and pointnet, as the launch
        files do: ground and clusters once for all, or with single one process a detector. params: a
        dataclass of parameters, or NAME: value, for all nodes that have a parameter of that name;
        points: the topic of the clouds, in the namespace unless it starts with /. Returns node ->
        remapping."""
        values = {} if params is None else (
            params if isinstance(params, Mapping) else flatten(params))
        own = {node: {a: points if b == CLOUDS["~/input/points"] else b for a, b in remap.items()}
               for node, remap in build_graph(detectors, single).items()}
        for node, remap in own.items():
            self.start(node, remap, values, namespace)
        return own

    def play(self, bag: Path, follow: Sequence[str] = (), **params: Any) -> None:
        """Start bag_player, which waits up to two minutes for a subscriber of the clouds. follow:
        topics of detections; the next cloud comes when those before have their answer there, so
        that none is lost however slow the machine is. params: others of bag_player."""
        if "bag_player" in self.running:
            self.end("bag_player")
        self.start("bag_player", {}, {"bag": str(bag), "wait_timeout": 120.0,
                                      "follow_timeout": 60.0, "follow": list(follow), **params})

    def end(self, name: str, timeout: float = 15.0) -> int:
        """SIGINT to one process, if it still runs; its exit code."""
        process = self.running[name]
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        return process.wait(timeout)

    def log(self, name: str) -> str:
        """What a process has written so far."""
        return (self.logs / f"{name}.log").read_text(errors="replace")

    def failed(self) -> dict[str, int]:
        """Exit codes of the processes that ended with another code than 0."""
        return {name: code for name, process in self.running.items() if (code := process.poll())}


def logs_of_all() -> list[tuple[str, str]]:
    """Title and last lines of the log of each process that any test runs now."""
    found = []
    for processes in NodesUnderTest.entered:
        for name, process in processes.running.items():
            code = process.poll()
            state = "runs" if code is None else f"ended with code {code}"
            lines = processes.log(name).splitlines()
            cut = f"(the last {LAST_LINES} of {len(lines)} lines, all in {processes.logs})\n" if (
                len(lines) > LAST_LINES) else ""
            found.append((f"{name}, which {state}", cut + "\n".join(lines[-LAST_LINES:])))
    return found
