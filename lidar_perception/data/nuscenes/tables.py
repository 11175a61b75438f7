"""The tables of nuScenes: JSON lists of rows, read row by row.

Those of trainval have more than a gigabyte, of which a LiDAR needs a hundredth. So a table is
never held whole: rows are decoded one after the other out of a buffer, and the reader keeps what
it wants.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from lidar_perception.data.nuscenes.boxes import usable
from lidar_perception.runs.files import regular, short
from lidar_perception.types import LARGEST, InputError

CHUNK = 2**22        # characters read at a time; no row is longer
SPACE = " \t\r\n,"
MAX_TIME = 2**31 * 10**6  # microseconds since 1970 that a header's seconds can hold
KINDS: dict[str, type] = {
    **dict.fromkeys(("token", "sample_token", "instance_token", "scene_token", "sensor_token",
                     "category_token", "ego_pose_token", "calibrated_sensor_token", "prev", "next",
                     "name", "channel", "filename"), str),
    "timestamp": int, "attribute_tokens": list}
NOT_A = {str: "no text", int: "no time in microseconds", list: "no list"}


class Tables:
    """ROOT/VERSION/*.json. InputError where the folder is not there."""

    def __init__(self, root: str | Path, version: str):
        self.root, self.version = Path(root), version
        self.folder = self.root / version
        if not self.root.is_dir():
            raise InputError(f"{root} is not a folder; give the folder of a nuScenes download")
        if not version or not self.folder.is_dir():
            there = sorted(path.parent.name for path in self.root.glob("*/sample_data.json"))
            raise InputError(f"{root} has no folder {version or 'without a name'}; " + (
                f"its versions are: {', '.join(there)}" if there else
                "give the folder that holds v1.0-mini or v1.0-trainval, and samples"))

    def path(self, table: str) -> Path:
        return self.folder / f"{table}.json"

    def rows(self, table: str, *fields: str) -> Iterator[tuple]:
        """The values of two fields or more, row by row. InputError for a table that is missing,
        cut or damaged, and for a row without a field or with one of another kind."""
        kinds = [(at, KINDS[field]) for at, field in enumerate(fields) if field in KINDS]
        for number, row in enumerate(self._decoded(table)):
            try:
                values = tuple([row[field] for field in fields])
            except (KeyError, TypeError):
                missing = next(f for f in fields if not isinstance(row, dict) or f not in row)
                raise InputError(f"{self.path(table)}: row {number} has no {missing}; is it a "
                                 "table of nuScenes? download it again") from None
            for at, kind in kinds:
                if not isinstance(values[at], kind) or (
                        kind is int and not 0 <= values[at] < MAX_TIME):
                    raise InputError(f"{self.path(table)}: row {number}: {fields[at]} is "
                                     f"{NOT_A[kind]}; download it again")
            yield values

    def _decoded(self, table: str) -> Iterator[Any]:
        path, decode = self.path(table), json.JSONDecoder().raw_decode
        try:
            with open(regular(path), encoding="utf-8-sig") as stream:
                text = stream.read(CHUNK).lstrip()
                if text[:1] != "[":
                    raise InputError(f"{path} is no list of rows; download the tables of "
                                     f"{self.version} again")
                text, at, ended = text[1:], 0, False
                while True:
                    while at < len(text) and text[at] in SPACE:
                        at += 1
                    if at < len(text) and text[at] == "]":
                        return
                    try:
                        row, at = decode(text, at)
                        yield row
                        continue
                    except ValueError as error:  # the row goes on in the next chunk, or is broken
                        if ended or len(text) - at > 2 * CHUNK:
                            raise InputError(f"{path} is cut or damaged ({error}); download the "
                                             f"tables of {self.version} again") from None
                    more = stream.read(CHUNK)
                    text, at, ended = text[at:] + more, 0, not more
        except OSError as error:
            raise InputError(f"cannot read the table {path}: {error.strerror}; unpack the "
                             f"metadata of {self.version} there") from None
        except (UnicodeDecodeError, RecursionError) as error:
            raise InputError(f"{path} is damaged ({short(error)}); download the tables of "
                             f"{self.version} again") from None

    def numbers(self, table: str, field: str, values: list, width: int) -> np.ndarray:
        """(K, width) float64 of a field's values. InputError where one is not that many finite
        numbers."""
        try:
            column = np.array(values, np.float64).reshape(len(values), -1)
        except (ValueError, TypeError, OverflowError):  # the last of an int of 400 digits
            column = np.zeros((len(values), 0))
        if len(values) == 0:
            return np.zeros((0, width))
        if column.shape[1] != width or not (np.abs(column) <= LARGEST).all() or (
                field == "rotation" and not usable(column).all()):
            wanted = ("a quaternion" if field == "rotation" else
                      f"{width} finite numbers within {LARGEST:g}")
            raise InputError(f"{self.path(table)}: a {field} is not {wanted}; download it again")
        return column
