"""More clouds than the graph can work on: what is dropped is counted, the newest wins, and memory
stays."""

from __future__ import annotations

from pathlib import Path
from time import monotonic

import numpy as np

from lidar_perception.campaign.case import FAILED, SURVIVED, Case, Outcome
from lidar_perception.campaign.good import header
from lidar_perception.campaign.graph import Graph, stamped
from lidar_perception.nodes.graph import SINGLE, STAGES, result_topics
from lidar_perception.nodes.runtime import MARKERS
from lidar_perception.types import SENSOR_HEIGHT, InputError
from lidar_perception.wire.codec import bag_message, decode, encode
from lidar_perception.wire.topics import POINTS
from msg_utils.markers import from_marker_array
from msg_utils.point_cloud2 import from_array

COUNT = 120_000
FIRST = 1_750_000_000_000_000_000  # ns; stamps are counted on from here, one a cloud
RECOVERY_SECONDS = 60.0
GROWTH_MB = 100.0
# In one process or one a stage, Hz, seconds.
CASES = [*((single, rate, 20.0) for rate in (10, 20, 40) for single in (True, False)),
         (True, 20, 1800.0)]


def case_of(seed: int, number: int) -> Case | None:
    """The graph in one process, and in one a stage, at each rate; last for half an hour."""
    if number >= len(CASES):
        return None
    single, rate, seconds = CASES[number]
    name = (f"{'one process' if single else 'a process a stage'}, {rate} Hz"
            + (f", {seconds / 60:.0f} minutes" if seconds > 60 else ""))
    return Case("load", name, seed, number, {"single": single, "rate": rate}, seconds=seconds)


class Attempt:
    """A graph for each case."""

    def __init__(self, folder: Path):
        self.folder = folder
        rng = np.random.default_rng(0)
        points = rng.uniform([-40, -30, -SENSOR_HEIGHT], [60, 30, -SENSOR_HEIGHT + 0.05],
                             (COUNT, 3))
        for i in range(60):  # things that stand on it
            points[600 * i:600 * (i + 1)] = rng.uniform([-0.3, -0.3, -1.7], [0.3, 0.3, 0.1],
                                                        (600, 3)) + [
                5 + 3 * (i % 10), 4 * (i // 10) - 10, 0]
        cloud = np.zeros(COUNT, [(name, "<f4") for name in ("x", "y", "z", "intensity")])
        for i, name in enumerate("xyz"):
            cloud[name] = points[:, i]
        self.cloud = encode(from_array(cloud, header(), bag_message))

    def __call__(self, case: Case) -> Outcome:
        single, rate = case.settings["single"], case.settings["rate"]
        with Graph(self.folder / str(case.number), tuple(SINGLE if single else STAGES)) as graph:
            return _under_load(graph, case.name, self.cloud, result_topics(single)["final"], rate,
                               case.seconds)


def _under_load(graph: Graph, what: str, cloud: bytes, results: str, rate: int,
                seconds: float) -> Outcome:
    sent: dict[int, float] = {}
    answers: list[tuple[int, float]] = []

    def heard(data: bytes) -> None:
        stamp = from_marker_array(decode(data, MARKERS)).stamp_ns
        if stamp in sent:
            answers.append((stamp, monotonic() - sent[stamp]))

    first = next(iter(graph.nodes))  # takes the clouds as they are sent
    graph.listen(results, MARKERS, heard)
    graph.outside.until(lambda: graph.outside.node.count_publishers(results), 10.0)
    graph.spin(2.0)
    before = {key: graph.count(first, key) for key in ("frames", "dropped", "lost")}
    memory, begin, number = 0.0, monotonic(), 0
    while monotonic() - begin < seconds:
        stamp = FIRST + number * 10**9 // rate
        sent[stamp] = monotonic()
        graph.send(POINTS, stamped(cloud, stamp))
        number += 1
        if not memory and monotonic() - begin > seconds / 4:
            memory = sum(graph.processes.memory_mb().values())
        graph.spin(max(0.0, begin + number / rate - monotonic()))
    took = monotonic() - begin
    newest = max(sent)
    if not graph.outside.until(lambda: any(s == newest for s, _ in answers), RECOVERY_SECONDS):
        return Outcome(FAILED, f"{what}: the newest cloud was not answered within "
                       f"{RECOVERY_SECONDS:g} s")
    recovery = monotonic() - begin - took
    graph.outside.until(lambda: _known(graph, first, before) >= number, RECOVERY_SECONDS)
    counts = {key: graph.count(first, key) - value for key, value in before.items()}
    growth = sum(graph.processes.memory_mb().values()) - memory
    figures = {"sent": number, "sent_hz": round(number / took, 1), "processed": counts["frames"],
               "dropped": counts["dropped"], "lost": counts["lost"], "answered": len(answers),
               "recovery_s": round(recovery, 2), "memory_mb": round(memory),
               "growth_mb": round(growth, 1), **{f"latency_p{p}_ms": round(float(np.percentile(
                   [1e3 * late for _, late in answers], p))) for p in (50, 95, 99)}}
    stamps = [stamp for stamp, _ in answers]
    if stamps != sorted(stamps):
        return Outcome(FAILED, f"{what}: an older cloud was answered after a newer one", figures)
    if sum(counts.values()) != number:
        return Outcome(FAILED, f"{what}: {number} clouds were sent, and {counts} make "
                       f"{sum(counts.values())}", figures)
    if growth > GROWTH_MB:
        return Outcome(FAILED, f"{what}: memory grew by {growth:.0f} MB", figures)
    try:
        graph.alive()
    except InputError as error:
        return Outcome(FAILED, str(error), figures)
    return Outcome(SURVIVED, what, figures)


def _known(graph: Graph, node: str, before: dict[str, int]) -> int:
    return sum(graph.count(node, key) - value for key, value in before.items())
