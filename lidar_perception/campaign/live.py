"""Mutated messages through the running graph, over DDS: after each burst every node must serve a
good cloud."""

from __future__ import annotations

from pathlib import Path

from lidar_perception.campaign.case import FAILED, SURVIVED, Case, Outcome, generator, pick
from lidar_perception.campaign.good import mutated
from lidar_perception.campaign.graph import TOPICS, LazyGraph
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
        self.graph = LazyGraph(folder)

    def __call__(self, case: Case) -> Outcome:
        graph = self.graph()
        rng = generator("live", case.seed, case.number)
        known = len(graph.bugs())
        for _ in range(BURST):
            topic = POINTS if rng.random() < 0.7 else pick(rng, sorted(TOPICS))
            data, _ = mutated(TOPICS[topic], rng)
            if rng.random() < 0.1:
                data, _ = mutate_bytes(data, rng)
            graph.send(topic, data)
            graph.spin(PAUSE)
        try:
            graph.alive()
        except InputError as error:
            self.close()
            return Outcome(FAILED, str(error))
        bugs = graph.bugs()[known:]
        return Outcome(FAILED, bugs[0]) if bugs else Outcome(SURVIVED)

    def close(self) -> None:
        """End the nodes."""
        self.graph.close()
