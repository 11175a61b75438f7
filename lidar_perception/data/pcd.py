"""PCD files (Point Cloud Library, version 0.7): ascii, binary and binary_compressed."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from lidar_perception.runs.files import regular
from lidar_perception.types import InputError

MAX_HEADER = 1 << 16  # bytes
MAX_CLOUD = 2**31     # bytes that a file may say its points have
KINDS = {"F": "f", "I": "i", "U": "u"}


def read_pcd(path: Path) -> np.ndarray:
    """(N,) structured array with the fields of the file, under their names and in their types; a
    field of several numbers is an array of them, those named "_" are padding and left out.
    InputError where it is no such file, or cut."""
    try:
        content = regular(path).read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}; download it again") from None
    try:
        return _points(content)
    except (ValueError, TypeError, OverflowError, LookupError, struct.error) as error:
        raise InputError(f"{path} is no PCD file that can be read ({error}); save it again as "
                         "binary PCD") from None


def _points(content: bytes) -> np.ndarray:
    header, start = {}, 0
    while "DATA" not in header:
        end = content.find(b"\n", start, MAX_HEADER)
        if end < 0:
            raise ValueError("it has no line DATA")
        words = content[start:end].decode("ascii", "replace").split()
        start = end + 1
        if words and not words[0].startswith("#"):
            header[words[0].upper()] = words[1:]
    names, types, sizes = header["FIELDS"], header["TYPE"], header["SIZE"]
    counts = [int(n) for n in header.get("COUNT", ["1"] * len(names))]
    if not len(names) == len(types) == len(sizes) == len(counts):
        raise ValueError("FIELDS, TYPE, SIZE and COUNT differ in length")
    names = [name if name != "_" else f"_{i}" for i, name in enumerate(names)]
    layout = np.dtype([(name, f"<{KINDS[kind]}{int(size)}", (n,) if n != 1 else ())
                       for name, kind, size, n in zip(names, types, sizes, counts)])
    number = int(header["POINTS"][0] if "POINTS" in header
                 else int(header["WIDTH"][0]) * int(header["HEIGHT"][0]))
    if not 0 <= number * layout.itemsize <= MAX_CLOUD:
        raise ValueError(f"it says {number} points")
    data, kind = content[start:], header["DATA"][0]
    if kind == "ascii":
        points = _of_text(data, layout, number)
    elif kind == "binary":
        points = _of_bytes(data, layout, number)
    elif kind == "binary_compressed":
        points = _of_columns(data, layout, number)
    else:
        raise ValueError(f"DATA {kind} is not known")
    kept = [name for name in names if not name.startswith("_")]
    return points if len(kept) == len(names) else points[kept]


def _of_bytes(data: bytes, layout: np.dtype, number: int) -> np.ndarray:
    if len(data) < number * layout.itemsize:
        raise ValueError(f"it has {len(data)} bytes of {number * layout.itemsize}: it was cut")
    return np.frombuffer(data, layout, number)


def _of_text(data: bytes, layout: np.dtype, number: int) -> np.ndarray:
    width = sum(int(np.prod(layout[name].shape, dtype=int)) for name in layout.names or ())
    words = np.array(data.split())
    if len(words) < number * width:
        raise ValueError(f"it has {len(words)} numbers of {number * width}: it was cut")
    rows = words[:number * width].reshape(number, width)
    points, at = np.empty(number, layout), 0
    for name in layout.names or ():
        n = int(np.prod(layout[name].shape, dtype=int))
        kind = layout[name].base
        # Whole numbers as such, so that 64-bit times keep their last digits.
        read = rows[:, at:at + n].astype(kind.kind + "8")
        if kind.kind != "f" and not np.array_equal(read, read.astype(kind)):
            raise ValueError(f"a number of its field '{name}' does not fit into {kind}")
        points[name] = read.reshape((number, *layout[name].shape))
        at += n
    return points


def _of_columns(data: bytes, layout: np.dtype, number: int) -> np.ndarray:
    """binary_compressed: LZF, and field by field instead of point by point."""
    packed, size = struct.unpack_from("<II", data)
    if size != number * layout.itemsize or len(data) < 8 + packed:
        raise ValueError("the sizes of its compressed points do not fit: it was cut")
    plain, points, at = unpacked_lzf(data[8:8 + packed], size), np.empty(number, layout), 0
    for name in layout.names or ():
        part = layout[name]
        points[name] = np.frombuffer(plain, part.base, number * part.itemsize
                                     // part.base.itemsize, at).reshape((number, *part.shape))
        at += number * part.itemsize
    return points


def unpacked_lzf(data: bytes, size: int) -> bytes:
    """The size bytes that LZF data stand for. Each step copies a literal run, or a run from
    before. ValueError where they do not make size bytes."""
    out, i = bytearray(), 0
    while i < len(data):
        control = data[i]
        i += 1
        if control < 32:
            out += data[i:i + control + 1]
            i += control + 1
            continue
        length = control >> 5
        if length == 7:
            length += data[i]
            i += 1
        back = len(out) - ((control & 31) << 8 | data[i]) - 1
        i += 1
        if back < 0:
            raise ValueError("its compressed points are damaged")
        length += 2
        if len(out) - back >= length:
            out += out[back:back + length]
        else:  # it overlaps with what it writes
            piece = bytes(out[back:])
            out += (piece * (length // len(piece) + 1))[:length]
        if len(out) > size:
            break
    if len(out) != size:
        raise ValueError("its compressed points are damaged")
    return bytes(out)
