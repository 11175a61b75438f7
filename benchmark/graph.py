"""Latency, CPU time and memory of the graph of nodes over DDS."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.table import Table

from lidar_perception.candidates.configurations import PAPER
from lidar_perception.data.bag import Bag
from lidar_perception.data.frame import Recording
from lidar_perception.data.to_bag import write_bag
from lidar_perception.detectors.fused.params import FusedDetectorParams
from lidar_perception.runs.terminal import console, show_progress
from lidar_perception.wire.topics import POINTS

CANDIDATES: dict[str, Any] = {"detector": "candidates", "params": PAPER}
FUSED: dict[str, Any] = {"detector": "fused", "params": FusedDetectorParams()}
RUNS: dict[str, tuple[dict[str, Any], int]] = {  # name -> (arguments of replay(), number of busy processes)
    "candidates, a process per node": (CANDIDATES | {"processes": True}, 0),
    "candidates, one process": (CANDIDATES | {"processes": False}, 0),
    "candidates, one node": (CANDIDATES | {"single": True, "processes": True}, 0),
    "fused, a process per node": (FUSED | {"processes": True}, 0),
    "fused, one process": (FUSED | {"processes": False}, 0),
    "fused, one process, one other busy": (FUSED | {"processes": False}, 1),
}


def measure_graph(recording: Recording) -> dict[str, dict]:
    """Replay a recording at 10 Hz through the graphs of RUNS, one after the other.

    No cloud is lost: the replay waits for a graph that cannot keep up, see `speed`.

    Returns:
        For each graph clouds, results, speed (1 = real time), latency_ms, stage_ms, cpu_ms (CPU time
        of all processes per cloud), memory_mb, and load (load average before the run).
    """
    from lidar_perception.nodes.replay.graph_replay import replay

    runs = {}
    with tempfile.TemporaryDirectory() as folder:
        drive = Path(folder) / "drive"
        write_bag(drive, show_progress(recording, "writing a bag", len(recording)))
        with Bag(drive) as bag:
            clouds = bag.counts[POINTS]
        for i, (name, (arguments, busy_count)) in enumerate(RUNS.items()):
            load = os.getloadavg()[0]
            with run_busy_processes(busy_count):
                content = replay(drive, clouds, Path(folder) / str(i), **arguments)
            runs[name] = {key: content[key] for key in ("clouds", "results", "latency_ms", "memory_mb", "stage_ms")} | {
                "speed": 1 / content["slower"],
                "load": load,
                "cpu_ms": sum(content["cpu_ms_by_process"].values()),
            }
    return runs


@contextmanager
def run_busy_processes(count: int) -> Iterator[None]:
    """Run `count` processes that each keep one core busy."""
    processes = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def print_graph(content: dict[str, dict]) -> None:
    table = Table(title="Nodes over DDS at 10 Hz")
    for name in ("graph", "clouds", "lost", "speed", "median ms", "95th pct. ms", "CPU ms", "memory MB", "load"):
        table.add_column(name, justify="left" if name == "graph" else "right")
    for name, run in content.items():
        table.add_row(
            name,
            str(run["clouds"]),
            str(run["clouds"] - run["results"]),
            f"{run['speed']:.2g}x",
            f"{run['latency_ms']['median']:.0f}",
            f"{run['latency_ms']['p95']:.0f}",
            f"{run['cpu_ms']:.0f}",
            f"{run['memory_mb']:.0f}",
            f"{run['load']:.1f}",
        )
    console.print(table)
