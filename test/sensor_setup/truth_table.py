"""Print how far the measured sensors of tilted_samples.MOUNTS are from the truth:

    PYTHONPATH=.:test/support python test/sensor_setup/truth_table.py [--uneven]
"""

from __future__ import annotations

import sys

import numpy as np
from tilted_samples import MOUNTS, clouds_of

from lidar_perception.sensor_setup.measure import measured
from lidar_perception.sensor_setup.scans import scan_of
from lidar_perception.simulation.sensor import sensor_named

SCANS = 6


def row(name: str, even: bool) -> str:
    """One row of the table."""
    _, roll, pitch, height = MOUNTS[name]
    sensor = sensor_named(name)
    scans = [scan_of(msg) for msg in clouds_of(name, SCANS, even)]
    m = measured(scans, [0, 1, 10, 11, 20, 21], name, SCANS, None)
    true = np.degrees(sensor.elevations)
    off = np.abs(m.beams.elevations[:, None] - true).min(axis=1).max()
    q = m.mount
    return (f"| `{name}` | {height} m, {roll:g}, {pitch:g} | {len(m.beams.elevations)} by "
            f"{m.beams.how}, {off:.4f} | {100 * (m.step * sensor.columns / 360 - 1):.2f} % | "
            f"{100 * (q.height - height):.1f} cm | {np.degrees(q.roll) - roll:.2f}, "
            f"{np.degrees(q.pitch) - pitch:.2f} | {100 * m.noise:.1f} of "
            f"{100 * sensor.range_noise:.1f} cm | {m.model} |")


if __name__ == "__main__":
    print("| sensor | mount: height, roll, pitch | beams, largest error (deg) | azimuth step | "
          "height | roll, pitch (deg) | noise | model |\n|---|---|---|---|---|---|---|---|")
    for sensor_name in MOUNTS:
        print(row(sensor_name, "--uneven" not in sys.argv), flush=True)
