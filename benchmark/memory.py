"""Peak memory of our DBSCAN above the baseline of a fresh process.

The child loads the points, warms up, resets its high-water mark (/proc/self/clear_refs), notes its
resident memory, runs, and reads the mark (VmHWM). getrusage is not suitable: its ru_maxrss is
inherited from the parent across exec.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

METHOD = ("peak resident memory (VmHWM, set back before the run) less the resident memory before "
          "the run, in a fresh process that has loaded the points and warmed up")


def dbscan_memory(xyz: np.ndarray) -> float | None:
    """Return MB above baseline of DBSCAN on points (N, 3), or None without Linux' /proc."""
    if not Path("/proc/self/clear_refs").exists():
        return None
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "points.npy"
        np.save(file, xyz)
        done = subprocess.run([sys.executable, "-m", "benchmark.memory", str(file)], text=True,
                              capture_output=True, check=True,
                              cwd=Path(__file__).resolve().parents[1])
    return float(done.stdout)


def _resident(name: str) -> float:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(x.split()[1]) for x in lines if x.startswith(name + ":")) / 1024


def _main(file: str) -> None:
    from lidar_perception.candidates.warm_up import warm_up
    from lidar_perception.clustering.dbscan import distance_aware_dbscan
    xyz = np.load(file)
    warm_up()
    Path("/proc/self/clear_refs").write_text("5")
    before = _resident("VmRSS")
    distance_aware_dbscan(xyz)
    print(_resident("VmHWM") - before)


if __name__ == "__main__":
    _main(sys.argv[1])
