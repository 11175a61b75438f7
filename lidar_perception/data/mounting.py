"""How high the sensor of a folder is mounted, for which KITTI's layouts have no place."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path

from lidar_perception.runs.files import read_text, write_text
from lidar_perception.runs.folder import MARK, RECORD
from lidar_perception.types import InputError

MOUNT = "mount.json"  # of what `convert` makes
SIMULATED = "sensor_digest"  # in what `simulate` writes; other programs have a RECORD, too
MAX_BYTES = 1 << 16
DEEPEST = 3      # training/velodyne/0000 can be opened, too
HIGHEST = 50.0   # metres


def write_height(folder: Path, height: float) -> None:
    """Say in a folder how many metres above the ground its sensor is."""
    write_text(folder / MOUNT, json.dumps({"height": height}))


def height_of(path: Path) -> float | None:
    """Metres of the sensor above the ground, where `convert` or `simulate` has written the path, or
    a folder above it, and says so."""
    for folder in (path, *path.absolute().parents[:DEEPEST]):
        for name in (MOUNT, RECORD, MARK):
            with suppress(InputError, ValueError, RecursionError):
                said = json.loads(read_text(folder / name, MAX_BYTES))
                if isinstance(said, dict) and (name == MOUNT or SIMULATED in said):
                    height = said.get("height")
                    if isinstance(height, (int, float)) and 0 < height <= HIGHEST:
                        return float(height)
    return None
