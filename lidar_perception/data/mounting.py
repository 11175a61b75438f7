"""Sensor height of a folder, for KITTI's layouts, which do not store it."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path

from lidar_perception.runs.files import read_text, write_text
from lidar_perception.runs.resumable_folder import INCOMPLETE_NAME, RECORD_NAME
from lidar_perception.types import InputError

MOUNT = "mount.json"  # written by `convert`
SIMULATION_KEY = "sensor_digest"  # marks a RECORD of `simulate`; other commands write one, too
MAX_BYTES = 1 << 16
MAX_DEPTH = 3  # of an opened folder below the file: training/velodyne/0000
MAX_HEIGHT_M = 50.0


def write_height(folder: Path, height: float) -> None:
    """Store the height of the sensor above the ground, in metres, in a folder."""
    write_text(folder / MOUNT, json.dumps({"height": height}))


def read_height(path: Path) -> float | None:
    """Return the height of the sensor above the ground, in metres.

    None unless `convert` or `simulate` stored it in the path or a folder above it.
    """
    for folder in (path, *path.absolute().parents[:MAX_DEPTH]):
        for name in (MOUNT, RECORD_NAME, INCOMPLETE_NAME):
            with suppress(InputError, ValueError, RecursionError):
                content = json.loads(read_text(folder / name, MAX_BYTES))
                if isinstance(content, dict) and (name == MOUNT or SIMULATION_KEY in content):
                    height = content.get("height")
                    if isinstance(height, (int, float)) and 0 < height <= MAX_HEIGHT_M:
                        return float(height)
    return None
