"""Child processes of a test: nodes and other programs on a ROS domain."""

from __future__ import annotations

import signal
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lidar_perception.nodes.graph import CLOUD_INPUT, Graph, Processes, build_graph, make_relative
from lidar_perception.param_fields import flatten
from lidar_perception.testing.forking import ForkedNode
from lidar_perception.wire.topics import POINTS

MAX_LOG_LINES = 60  # maximum number of lines of each log in the report of a failed test


class NodesUnderTest(Processes):
    """Processes whose logs are shown if a test fails while they are running.

    Nodes of this package are forked from a process that has imported their code. If `fresh` is
    True, each node is started in a new interpreter instead, as in production, which takes seconds.
    """

    active: list[NodesUnderTest] = []  # objects whose context is open
    fresh = False

    def __enter__(self) -> NodesUnderTest:
        super().__enter__()
        self.active.append(self)
        return self

    def __exit__(self, *error: Any) -> None:
        self.active.remove(self)
        super().__exit__(*error)

    def run_node(self, name: str, arguments: Sequence[str]) -> None:
        """Start an executable of this package."""
        if self.fresh:
            super().run_node(name, arguments)
        else:
            self.running[name] = ForkedNode(arguments, self.environment, self.logs / f"{name}.log")

    def start_graph(
        self,
        detectors: Sequence[str],
        params: Any = None,
        *,
        single: bool = False,
        points: str = make_relative(POINTS),
        namespace: str = "",
    ) -> Graph:
        """Start the nodes of one or several detectors, as the launch files do.

        Args:
            detectors: Names of detectors, see nodes.graph.
            params: Dataclass or mapping with parameter values; each node gets the parameters that
                it declares.
            single: True to run each detector in one process; False to compute ground and clusters
                once for all detectors.
            points: Topic of the clouds, relative to the namespace unless it starts with /.

        Returns:
            The remappings of each node.
        """
        values = {} if params is None else (params if isinstance(params, Mapping) else flatten(params))
        graph = {
            node: {a: points if b == CLOUD_INPUT["~/input/points"] else b for a, b in remap.items()}
            for node, remap in build_graph(detectors, single).items()
        }
        for node, remap in graph.items():
            self.start(node, remap, values, namespace)
        return graph

    def play(self, bag: Path, follow: Sequence[str] = (), **params: Any) -> None:
        """Start bag_player, which waits up to two minutes for a subscriber of the clouds.

        Args:
            follow: Topics of detections. The next cloud is sent when the detections of the previous
                clouds have arrived there, so that no cloud is lost on a slow machine.
            params: Other parameters of bag_player.
        """
        if "bag_player" in self.running:
            self.end("bag_player")
        self.start(
            "bag_player",
            {},
            {"bag": str(bag), "wait_timeout": 120.0, "follow_timeout": 60.0, "follow": list(follow), **params},
        )

    def end(self, name: str, timeout: float = 15.0) -> int:
        """End a process with SIGINT if it is still running; return its exit code."""
        process = self.running[name]
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        return process.wait(timeout)

    def read_log(self, name: str) -> str:
        """Return the output of a process so far."""
        return (self.logs / f"{name}.log").read_text(errors="replace")

    def find_failed(self) -> dict[str, int]:
        """Return the exit codes of the processes that have failed, by name."""
        return {name: code for name, process in self.running.items() if (code := process.poll())}


def collect_logs() -> list[tuple[str, str]]:
    """Return the title and last lines of the log of each process of the running tests."""
    logs = []
    for processes in NodesUnderTest.active:
        for name, process in processes.running.items():
            code = process.poll()
            state = "runs" if code is None else f"ended with code {code}"
            lines = processes.read_log(name).splitlines()
            note = ""
            if len(lines) > MAX_LOG_LINES:
                note = f"(the last {MAX_LOG_LINES} of {len(lines)} lines; the full log is in {processes.logs})\n"
            logs.append((f"{name}, which {state}", note + "\n".join(lines[-MAX_LOG_LINES:])))
    return logs
