"""Reader of PCD files of the Point Cloud Library, versions .5 to .7: ascii, binary and binary_compressed."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np

from lidar_perception.runs.files import check_regular
from lidar_perception.types import InputError

MAX_HEADER_BYTES = 1 << 16
MAX_CLOUD_BYTES = 2**31  # maximum size of the points that a header may declare
KIND_CODES = {"F": "f", "I": "i", "U": "u"}


def read_pcd(path: Path) -> np.ndarray:
    """Read the points of a PCD file.

    Returns:
        (N,) structured array with the fields and types of the file; a field with COUNT > 1 is an
        array. Fields named "_" (padding) and fields with COUNT 0 are left out. An integer field
        with fractional numbers in an ascii file becomes float32.

    Raises:
        InputError: the file is not a PCD file, or truncated.
    """
    return read_and_parse(path, _parse_points, "PCD")


def read_and_parse(path: Path, parse: Callable[[bytes], np.ndarray], format_name: str) -> np.ndarray:
    """Return parse(content of the file). Raises InputError if the file cannot be read or parsed."""
    try:
        content = check_regular(path).read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}; download it again") from None
    try:
        return parse(content.removeprefix(b"\xef\xbb\xbf"))
    except (ValueError, TypeError, OverflowError, LookupError, struct.error) as error:
        raise InputError(
            f"{path} is not a readable {format_name} file ({error}); save it again as binary {format_name}"
        ) from None


def _parse_points(content: bytes) -> np.ndarray:
    header, start = {}, 0
    while "DATA" not in header:
        end = content.find(b"\n", start, MAX_HEADER_BYTES)
        if end < 0:
            raise ValueError("the line DATA is missing")
        words = content[start:end].decode("ascii", "replace").split()
        start = end + 1
        if words and not words[0].startswith("#"):
            header[words[0].upper()] = words[1:]
    names = header.get("FIELDS") or header.get("COLUMNS")  # named COLUMNS up to version .5
    if not names:
        raise ValueError("the line FIELDS is missing")
    types, sizes, counts = (
        header.get(key, [default] * len(names)) for key, default in (("TYPE", "F"), ("SIZE", "4"), ("COUNT", "1"))
    )
    if not len(names) == len(types) == len(sizes) == len(counts):
        raise ValueError("FIELDS, TYPE, SIZE and COUNT differ in length")
    names = [name if name != "_" else f"_{i}" for i, name in enumerate(names)]
    layout = np.dtype(
        [
            (name, f"<{KIND_CODES[data_format[0].upper()]}{int(size)}", () if int(n) == 1 else (int(n),))
            for name, data_format, size, n in zip(names, types, sizes, counts)
        ]
    )
    point_count = int(
        header["POINTS"][0] if "POINTS" in header else int(header["WIDTH"][0]) * int(header.get("HEIGHT", ["1"])[0])
    )
    if not 0 <= point_count * layout.itemsize <= MAX_CLOUD_BYTES:
        raise ValueError(f"the number of points is invalid: {point_count}")
    data, data_format = content[start:], header["DATA"][0].lower()
    if data_format == "ascii":
        points = parse_text_points(data, layout, point_count)
    elif data_format == "binary":
        points = parse_binary_points(data, layout, point_count)
    elif data_format == "binary_compressed":
        points = _parse_compressed_points(data, layout, point_count)
    else:
        raise ValueError(f"unknown DATA format: {data_format}")
    data_fields = [name for name in names if not name.startswith("_") and layout[name].itemsize]
    return points if len(data_fields) == len(names) else points[data_fields]


def parse_binary_points(data: bytes, layout: np.dtype, point_count: int) -> np.ndarray:
    """Parse `point_count` records of type `layout`. Raises ValueError if the data are too short."""
    if len(data) < point_count * layout.itemsize:
        raise ValueError(f"it is truncated: {len(data)} of {point_count * layout.itemsize} bytes")
    return np.frombuffer(data, layout, point_count)


def parse_text_points(data: bytes, layout: np.dtype, point_count: int) -> np.ndarray:
    """Parse points written as text, one number after the other.

    Returns:
        (point_count,) structured array with the types of the layout. An integer field with
        fractional numbers becomes float32.

    Raises:
        ValueError: the text is too short, or a number does not fit its type.
    """
    width = sum(int(np.prod(layout[name].shape, dtype=int)) for name in layout.names or ())
    words = np.array(data.split())
    if len(words) < point_count * width:
        raise ValueError(f"it is truncated: {len(words)} of {point_count * width} numbers")
    rows = words[: point_count * width].reshape(point_count, width)
    columns, first_column = {}, 0
    for name in layout.names or ():
        shape = layout[name].shape
        field_width = int(np.prod(shape, dtype=int))
        columns[name] = _parse_numbers(
            rows[:, first_column : first_column + field_width], layout[name].base, name
        ).reshape((point_count, *shape))
        first_column += field_width
    points = np.empty(point_count, [(name, values.dtype, values.shape[1:]) for name, values in columns.items()])
    for name, values in columns.items():
        points[name] = values
    return points


def _parse_numbers(words: np.ndarray, dtype: np.dtype, name: str) -> np.ndarray:
    """Convert words to numbers of the given type, or to float32 if they have fractions."""
    if dtype.kind == "f":
        return words.astype("f8").astype(dtype)
    try:
        numbers = words.astype(dtype.kind + "8")  # float64 would lose the last digits of 64-bit times
    except ValueError:
        numbers = words.astype("f8")  # some programs write 12.000000 or 0.35 for a uint8
        if not np.array_equal(numbers, np.floor(numbers)):
            return numbers.astype("<f4")
    limits = np.iinfo(dtype)
    if numbers.size and not (limits.min <= numbers.min().item() and numbers.max().item() <= limits.max):
        raise ValueError(f"a number of the field '{name}' does not fit into {dtype}")
    return numbers.astype(dtype)


def _parse_compressed_points(data: bytes, layout: np.dtype, point_count: int) -> np.ndarray:
    """Parse binary_compressed data: one column after the other, compressed with LZF unless that makes them larger."""
    compressed_size, size = struct.unpack_from("<II", data)
    if size != point_count * layout.itemsize or len(data) < 8 + compressed_size:
        raise ValueError("it is truncated: the sizes of the compressed points do not match")
    content = data[8 : 8 + compressed_size]
    try:
        content = decompress_lzf(content, size)
    except (ValueError, IndexError):
        if compressed_size != size:
            raise
    points, offset = np.empty(point_count, layout), 0
    for name in layout.names or ():
        field = layout[name]
        if field.itemsize:
            points[name] = np.frombuffer(
                content, field.base, point_count * field.itemsize // field.base.itemsize, offset
            ).reshape((point_count, *field.shape))
        offset += point_count * field.itemsize
    return points


def decompress_lzf(data: bytes, size: int) -> bytes:
    """Decompress LZF data to `size` bytes. Raises ValueError if the result has another size.

    Each step of the loop copies a literal run, or repeats a run of earlier output.
    """
    out, i = bytearray(), 0
    while i < len(data):
        control = data[i]
        i += 1
        if control < 32:
            out += data[i : i + control + 1]
            i += control + 1
            continue
        length = control >> 5
        if length == 7:
            length += data[i]
            i += 1
        run_start = len(out) - ((control & 31) << 8 | data[i]) - 1
        i += 1
        if run_start < 0:
            raise ValueError("the compressed points are damaged")
        length += 2
        if len(out) - run_start >= length:
            out += out[run_start : run_start + length]
        else:  # the run overlaps its own output
            piece = bytes(out[run_start:])
            out += (piece * (length // len(piece) + 1))[:length]
        if len(out) > size:
            break
    if len(out) != size:
        raise ValueError("the compressed points are damaged")
    return bytes(out)
