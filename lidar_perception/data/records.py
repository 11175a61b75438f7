"""Files of fixed-size records, such as scans and point labels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import DTypeLike

from lidar_perception.runs.files import check_regular
from lidar_perception.types import InputError


def read_records(path: Path, columns: str, dtype: DTypeLike = np.float32) -> np.ndarray:
    """Read a file of N records with one number per column.

    Args:
        columns: names of the C columns, such as "x y z reflectance".

    Returns:
        (N, C) array of the given dtype.

    Raises:
        InputError: the file is missing or truncated.
    """
    try:
        numbers, size = np.fromfile(check_regular(path), dtype), path.stat().st_size
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}; download it again") from None
    count = len(columns.split())
    if size % (count * numbers.itemsize):
        raise InputError(
            f"{path} has {size} bytes, not a multiple of {count * numbers.itemsize} "
            f"({columns} as {numbers.dtype}): it is truncated; download it again"
        )
    return numbers.reshape(-1, count)
