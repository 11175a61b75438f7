"""Print the errors of the measured sensors of tilted_samples.MOUNTS for docs/how-to/own-sensor.md.

    PYTHONPATH=.:test/support python test/sensor_setup/truth_table.py [--uneven]
"""

from __future__ import annotations

import sys

import numpy as np
from tilted_samples import MOUNTS, simulate_clouds

from lidar_perception.sensor_setup.measurement.measure import measure_sensor
from lidar_perception.sensor_setup.measurement.scans import read_scan
from lidar_perception.simulation.sensor import find_sensor

SCANS = 6


def row(name: str, even: bool) -> str:
    """Return one row of the table."""
    _, roll, pitch, height = MOUNTS[name]
    sensor = find_sensor(name)
    scans = [read_scan(msg) for msg in simulate_clouds(name, SCANS, even)]
    m = measure_sensor(scans, [0, 1, 10, 11, 20, 21], name, SCANS, None)
    true = np.degrees(sensor.elevations)
    pattern, mount = m.pattern, m.mounting.mount
    up = pattern.beams.elevations
    error = np.abs(up[:, None] - true).min(axis=1).max()
    step_error = pattern.azimuth_step * sensor.columns / 360 - 1
    return (f"| `{name}` | {height} m, {roll:g}, {pitch:g} | {len(up)} by {pattern.beams.method}, "
            f"{error:.4f} | {100 * step_error:.2f} % | {100 * (mount.height - height):.1f} cm | "
            f"{np.degrees(mount.roll) - roll:.2f}, {np.degrees(mount.pitch) - pitch:.2f} | "
            f"{100 * pattern.range_noise:.1f} of {100 * sensor.range_noise:.1f} cm | "
            f"{pattern.model} |")


if __name__ == "__main__":
    print("| sensor | mount: height, roll, pitch | beams, largest error (deg) | azimuth step | "
          "height | roll, pitch (deg) | noise | model |\n|---|---|---|---|---|---|---|---|")
    for sensor_name in MOUNTS:
        print(row(sensor_name, "--uneven" not in sys.argv), flush=True)
