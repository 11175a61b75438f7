"""Mutated messages through the running graph, over DDS: after each burst every node must serve a
good cloud."""

from __future__ import annotations

from pathlib import Path

from lidar_perception.campaign.case import FAILED, SURVIVED, Case, Outcome, generator, pick
from lidar_perception.campaign.good import mutated
from lidar_perception.campaign.graph import TOPICS, Graph, graph_nodes
from lidar_perception.campaign.mutation import mutate_bytes
from lidar_perception.types import InputError
from lidar_perception.wire.topics import POINTS

BURST, PAUSE = 50, 0.02  # messages, seconds between them


def case_of(seed: int, number: int) -> Case:
    """A burst of messages, most of them clouds."""
    return Case("live", f"{BURST} messages", seed, number)


class Attempt:
    """The graph, started again when a case has broken it."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.graph: Graph | None = None
        self.starts = 0

    def __call__(self, case: Case) -> Outcome:
        if self.graph is None:
            self.starts += 1
            self.graph = Graph(self.folder / str(self.starts), graph_nodes())
            self.graph.__enter__()
        rng = generator("live", case.seed, case.number)
        known = len(self.graph.bugs())
        for _ in range(BURST):
            topic = POINTS if rng.random() < 0.7 else pick(rng, sorted(TOPICS))
            data, _ = mutated(TOPICS[topic], rng)
            if rng.random() < 0.1:
                data, _ = mutate_bytes(data, rng)
            self.graph.send(topic, data)
            self.graph.spin(PAUSE)
        try:
            self.graph.alive()
        except InputError as error:
            self.close()
            return Outcome(FAILED, str(error))
        bugs = self.graph.bugs()[known:]
        return Outcome(FAILED, bugs[0]) if bugs else Outcome(SURVIVED)

    def close(self) -> None:
        """End the nodes."""
        if self.graph is not None:
            self.graph.__exit__()
            self.graph = None
