"""The graph of nodes over DDS."""

from __future__ import annotations

import tempfile
from pathlib import Path

from rich.table import Table

from lidar_perception.candidates.configurations import PAPER
from lidar_perception.data.bag import Bag
from lidar_perception.data.frame import Recording
from lidar_perception.data.to_bag import write_bag
from lidar_perception.runs.terminal import console, show_progress
from lidar_perception.wire.topics import POINTS


def measure_graph(recording: Recording, single: bool) -> dict:
    """Measure latency, losses and memory of the nodes at 10 Hz, with the recorder subscribed."""
    from lidar_perception.nodes.replay.graph_replay import replay
    with tempfile.TemporaryDirectory() as folder:
        drive, out = Path(folder) / "drive", Path(folder)
        write_bag(drive, show_progress(recording, "writing a bag", len(recording)))
        with Bag(drive) as bag:
            clouds = bag.counts[POINTS]
        content = replay(drive, clouds, out, PAPER, single=single)
    return {k: content[k] for k in ("clouds", "results", "latency_ms", "memory_mb", "ms")}


def print_graph(content: dict) -> None:
    table = Table(title="Nodes over DDS at 10 Hz")
    for name in ("graph", "clouds", "lost", "median ms", "95 % under ms", "memory MB"):
        table.add_column(name, justify="left" if name == "graph" else "right")
    for name, run in content.items():
        table.add_row(name.replace("_", " "), str(run["clouds"]),
                      str(run["clouds"] - run["results"]), f"{run['latency_ms']['median']:.0f}",
                      f"{run['latency_ms']['p95']:.0f}", f"{run['memory_mb']:.0f}")
    console.print(table)
