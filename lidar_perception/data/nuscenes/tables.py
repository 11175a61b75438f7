"""Reader of nuScenes' tables, which are JSON lists of rows.

The tables of trainval have more than a gigabyte, of which LiDAR frames need one percent. Therefore
rows are decoded one by one, and only the required fields are kept.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from lidar_perception.data.nuscenes.boxes import are_valid_rotations
from lidar_perception.runs.files import check_regular, shorten_error
from lidar_perception.types import MAX_NUMBER, InputError

CHUNK_SIZE = 2**22  # characters read at a time; rows are shorter
SEPARATORS = " \t\r\n,"
MAX_TIME_US = 2**31 * 10**6  # maximum Unix time, limited by the seconds of a header
STRING_FIELDS = (
    "token sample_token instance_token scene_token sensor_token category_token ego_pose_token "
    "calibrated_sensor_token prev next name channel filename"
)
TYPE_BY_FIELD: dict[str, type] = {
    **dict.fromkeys(STRING_FIELDS.split(), str),
    "timestamp": int,
    "attribute_tokens": list,
}
PROBLEM_BY_TYPE = {str: "not a string", int: "not a time in microseconds", list: "not a list"}


class Tables:
    """The tables ROOT/VERSION/*.json. Raises InputError if the folder does not exist."""

    def __init__(self, root: str | Path, version: str):
        self.root, self.version = Path(root), version
        self.folder = self.root / version
        if not self.root.is_dir():
            raise InputError(f"{root} is not a folder; give the folder of a nuScenes download")
        if not version or not self.folder.is_dir():
            versions = sorted(path.parent.name for path in self.root.glob("*/sample_data.json"))
            raise InputError(
                f"{root} has no folder {version or 'without a name'}; "
                + (
                    f"its versions are: {', '.join(versions)}"
                    if versions
                    else "give the folder that holds v1.0-mini or v1.0-trainval, and samples"
                )
            )

    def get_path(self, table: str) -> Path:
        return self.folder / f"{table}.json"

    def read_rows(self, table: str, *fields: str) -> Iterator[tuple]:
        """Yield the values of two or more fields, row by row.

        Raises InputError if the table is missing or damaged, or if a field of a row is missing or
        has the wrong type.
        """
        typed_columns = [
            (column, TYPE_BY_FIELD[field]) for column, field in enumerate(fields) if field in TYPE_BY_FIELD
        ]
        for number, row in enumerate(self._decode_rows(table)):
            try:
                values = tuple([row[field] for field in fields])
            except (KeyError, TypeError):
                missing_field = next(f for f in fields if not isinstance(row, dict) or f not in row)
                raise InputError(
                    f"{self.get_path(table)}: row {number} has no {missing_field}, so it is not a table of nuScenes; "
                    "download it again"
                ) from None
            for column, type_ in typed_columns:
                if not isinstance(values[column], type_) or (type_ is int and not 0 <= values[column] < MAX_TIME_US):
                    raise InputError(
                        f"{self.get_path(table)}: row {number}: {fields[column]} is "
                        f"{PROBLEM_BY_TYPE[type_]}; download it again"
                    )
            yield values

    def _decode_rows(self, table: str) -> Iterator[Any]:
        path, decode = self.get_path(table), json.JSONDecoder().raw_decode
        try:
            with open(check_regular(path), encoding="utf-8-sig") as stream:
                text = stream.read(CHUNK_SIZE).lstrip()
                if text[:1] != "[":
                    raise InputError(f"{path} is not a list of rows; download the tables of {self.version} again")
                text, offset, at_end = text[1:], 0, False
                while True:
                    while offset < len(text) and text[offset] in SEPARATORS:
                        offset += 1
                    if offset < len(text) and text[offset] == "]":
                        return
                    try:
                        row, offset = decode(text, offset)
                        yield row
                        continue
                    except ValueError as error:  # the row ends in the next chunk, or is damaged
                        if at_end or len(text) - offset > 2 * CHUNK_SIZE:
                            raise InputError(
                                f"{path} is truncated or damaged ({error}); download the tables of {self.version} again"
                            ) from None
                    chunk = stream.read(CHUNK_SIZE)
                    text, offset, at_end = text[offset:] + chunk, 0, not chunk
        except OSError as error:
            raise InputError(
                f"cannot read the table {path}: {error.strerror}; unpack the metadata of {self.version} there"
            ) from None
        except (UnicodeDecodeError, RecursionError) as error:
            raise InputError(
                f"{path} is damaged ({shorten_error(error)}); download the tables of {self.version} again"
            ) from None

    def convert_numbers(self, table: str, field: str, values: list, width: int) -> np.ndarray:
        """Convert the values of a field to an array (K, width) float64.

        Raises InputError unless each value has `width` finite numbers.
        """
        try:
            column = np.array(values, np.float64).reshape(len(values), -1)
        except (ValueError, TypeError, OverflowError):  # OverflowError for an int of 400 digits
            column = np.zeros((len(values), 0))
        if len(values) == 0:
            return np.zeros((0, width))
        if (
            column.shape[1] != width
            or not (np.abs(column) <= MAX_NUMBER).all()
            or (field == "rotation" and not are_valid_rotations(column).all())
        ):
            requirement = "a quaternion" if field == "rotation" else f"{width} finite numbers within {MAX_NUMBER:g}"
            raise InputError(f"{self.get_path(table)}: a {field} is not {requirement}; download it again")
        return column
