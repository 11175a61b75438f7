"""CPU time and memory of a process until its detector is ready.

Measured with compiled code in the cache, with torch, and with an empty cache.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmark.rows import make_measurement, make_row

CODE_BY_NAME = {
    "fused": "import lidar_perception; lidar_perception.load_detector(device='cpu')",
    "fused, engine torch": "from lidar_perception.detectors.open import open_detector; "
    "open_detector(device='cpu', settings={'fused.engine': 'torch'})",
    "clustering": "from lidar_perception.params import ClusteringNodeParams as P; "
    "from lidar_perception.candidates.warm_up import warm_up_clustering; "
    "warm_up_clustering(P().clustering, P().boxes)",
    "ground segmentation": "from lidar_perception.params import GroundNodeParams as P; "
    "from lidar_perception.candidates.warm_up import warm_up_ground; "
    "warm_up_ground(P().ground)",
    "tracker": "from lidar_perception.tracking.tracker import warm_up; warm_up()",
}
NODES = "fused", "clustering", "ground segmentation", "tracker"
PRINT_USAGE = """
import resource
usage = resource.getrusage(resource.RUSAGE_SELF)
status = open('/proc/self/status').read()
print(usage.ru_utime + usage.ru_stime, int(status.split('VmHWM:')[1].split()[0]) / 1024)
"""
WITH_TORCH = "fused, engine torch"


def measure_startup(repeat: int, cold_starts: Sequence[str] = NODES) -> dict:
    """Measure the start of processes.

    Args:
        repeat: Number of runs.
        cold_starts: Names in CODE_BY_NAME that are also measured with an empty cache, which takes
            minutes.
    """
    runs = {name: np.median([_run_process(code) for _ in range(repeat)], axis=0) for name, code in CODE_BY_NAME.items()}
    rows = [
        make_row(
            WITH_TORCH,
            peer_ms=1e3 * runs[WITH_TORCH][0],
            ours_ms=1e3 * runs["fused"][0],
            value=runs[WITH_TORCH][0] / runs["fused"][0],
        )
    ]
    rows += [make_row(f"{name}, full cache", ours_ms=1e3 * runs[name][0]) for name in runs if name != WITH_TORCH]
    rows += [make_row(f"{name}, peak memory", value=memory, unit="MB") for name, (_, memory) in runs.items()]
    for name in cold_starts:
        with tempfile.TemporaryDirectory() as folder:
            seconds, _ = _run_process(CODE_BY_NAME[name], NUMBA_CACHE_DIR=folder)
        rows.append(make_row(f"{name}, empty cache", ours_ms=1e3 * seconds))
    title = f"Start of a process, CPU ms at a load of {os.getloadavg()[0]:.1f}"
    return make_measurement(title, repeat, 0, rows)


def _run_process(code: str, **variables: str) -> tuple[float, float]:
    """Return CPU seconds and peak memory in MB of a process that runs some code."""
    process = subprocess.run(
        [sys.executable, "-c", code + PRINT_USAGE],
        text=True,
        check=True,
        capture_output=True,
        env={**os.environ, **variables},
        cwd=Path(__file__).resolve().parents[1],
    )
    seconds, memory = map(float, process.stdout.split())
    return seconds, memory
