"""Reader of PLY files (Turk, 1994): ascii, binary_little_endian and binary_big_endian."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lidar_perception.data.pcd import (
    MAX_CLOUD_BYTES,
    MAX_HEADER_BYTES,
    parse_binary_points,
    parse_text_points,
    read_and_parse,
)

DTYPE_CODES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float32": "f4",
    "float64": "f8",
}
BYTE_ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
LIST_TYPE = "list"


def read_ply(path: Path) -> np.ndarray:
    """Read the vertices of a PLY file.

    Returns:
        (N,) structured array with the properties and types of the file, little-endian.

    Raises:
        InputError: the file is not a PLY file or is truncated; or the vertices, or in a binary file
            an element before them, have a list property.
    """
    return read_and_parse(path, _parse_vertices, "PLY")


def _parse_vertices(content: bytes) -> np.ndarray:
    if not content.startswith(b"ply"):
        raise ValueError("the first line is not 'ply'")
    order, is_text, start = "", False, 0
    elements: list[tuple[str, int, list[tuple[str, str]]]] = []
    while True:
        end = content.find(b"\n", start, MAX_HEADER_BYTES)
        if end < 0:
            raise ValueError("the line end_header is missing")
        words = content[start:end].decode("ascii", "replace").split()
        start = end + 1
        if words[:1] == ["format"]:
            order, is_text = BYTE_ORDERS[words[1]], words[1] == "ascii"
        elif words[:1] == ["element"]:
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"]:
            elements[-1][2].append((words[-1], words[1]))
        elif words[:1] == ["end_header"]:
            break
    if not order:
        raise ValueError("the line format is missing")
    data = content[start:]
    for name, element_count, properties in elements:
        if name != "vertex" and is_text:
            data = data.split(b"\n", element_count)[-1]
            continue
        if lists := [property_name for property_name, type_name in properties if type_name == LIST_TYPE]:
            raise ValueError(f"the property {lists[0]} of {name} elements is a list")
        layout = np.dtype([(property_name, order + DTYPE_CODES[type_name]) for property_name, type_name in properties])
        if not 0 <= element_count * layout.itemsize <= MAX_CLOUD_BYTES:
            raise ValueError(f"the number of points is invalid: {element_count}")
        if name == "vertex":
            parse = parse_text_points if is_text else parse_binary_points
            points = parse(data, layout, element_count)
            return points.astype(points.dtype.newbyteorder("<"))
        data = data[element_count * layout.itemsize :]
    raise ValueError("the element vertex is missing")
