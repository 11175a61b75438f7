"""Files of records of a fixed size, one behind another: scans, and labels of their points."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import DTypeLike

from lidar_perception.runs.files import regular
from lidar_perception.types import InputError


def read_records(path: Path, columns: str, dtype: DTypeLike = np.float32) -> np.ndarray:
    """(N, C) of a file of N records, each a number of this dtype for each of the C columns, which
    are named for people: "x y z reflectance". InputError where it is missing or cut."""
    try:
        numbers, size = np.fromfile(regular(path), dtype), path.stat().st_size
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}; download it again") from None
    count = len(columns.split())
    if size % (count * numbers.itemsize):
        raise InputError(f"{path} has {size} bytes, not a multiple of {count * numbers.itemsize} "
                         f"({columns} as {numbers.dtype}); it was cut, download it again")
    return numbers.reshape(-1, count)
