"""PCD files (Point Cloud Library, versions .5 to .7): ascii, binary and binary_compressed."""

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
    """Read the points of a PCD file.

    Returns: (N,) structured array with the fields of the file, in their types; a field of several
    numbers is an array. Fields named "_" are padding and left out, and so are those of COUNT 0. An
    integer field whose text has fractions is float32.
    Raises: InputError for another kind of file, and for one that was cut.
    """
    try:
        content = regular(path).read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}; download it again") from None
    try:
        return _points(content.removeprefix(b"\xef\xbb\xbf"))
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
    names = header.get("FIELDS") or header.get("COLUMNS")  # COLUMNS up to version .5
    if not names:
        raise ValueError("it has no line FIELDS")
    types, sizes, counts = (header.get(key, [usual] * len(names)) for key, usual in (
        ("TYPE", "F"), ("SIZE", "4"), ("COUNT", "1")))
    if not len(names) == len(types) == len(sizes) == len(counts):
        raise ValueError("FIELDS, TYPE, SIZE and COUNT differ in length")
    names = [name if name != "_" else f"_{i}" for i, name in enumerate(names)]
    layout = np.dtype([
        (name, f"<{KINDS[kind[0].upper()]}{int(size)}", () if int(n) == 1 else (int(n),))
        for name, kind, size, n in zip(names, types, sizes, counts)])
    number = int(header["POINTS"][0] if "POINTS" in header else
                 int(header["WIDTH"][0]) * int(header.get("HEIGHT", ["1"])[0]))
    if not 0 <= number * layout.itemsize <= MAX_CLOUD:
        raise ValueError(f"it says {number} points")
    data, kind = content[start:], header["DATA"][0].lower()
    if kind == "ascii":
        points = points_of_text(data, layout, number)
    elif kind == "binary":
        points = points_of_bytes(data, layout, number)
    elif kind == "binary_compressed":
        points = _of_columns(data, layout, number)
    else:
        raise ValueError(f"DATA {kind} is not known")
    kept = [name for name in names if not name.startswith("_") and layout[name].itemsize]
    return points if len(kept) == len(names) else points[kept]


def points_of_bytes(data: bytes, layout: np.dtype, number: int) -> np.ndarray:
    """(number,) records of this dtype at the beginning of data. ValueError where it is shorter."""
    if len(data) < number * layout.itemsize:
        raise ValueError(f"it has {len(data)} bytes of {number * layout.itemsize}: it was cut")
    return np.frombuffer(data, layout, number)


def points_of_text(data: bytes, layout: np.dtype, number: int) -> np.ndarray:
    """(number,) structured array of the numbers in a text, point by point, in the types of the
    layout; a field of whole numbers whose text has fractions becomes float32. ValueError where the
    text is shorter, or a number does not fit its type."""
    width = sum(int(np.prod(layout[name].shape, dtype=int)) for name in layout.names or ())
    words = np.array(data.split())
    if len(words) < number * width:
        raise ValueError(f"it has {len(words)} numbers of {number * width}: it was cut")
    rows = words[:number * width].reshape(number, width)
    columns, at = {}, 0
    for name in layout.names or ():
        shape = layout[name].shape
        n = int(np.prod(shape, dtype=int))
        columns[name] = _numbers(rows[:, at:at + n], layout[name].base, name).reshape(
            (number, *shape))
        at += n
    points = np.empty(number, [(name, values.dtype, values.shape[1:])
                               for name, values in columns.items()])
    for name, values in columns.items():
        points[name] = values
    return points


def _numbers(words: np.ndarray, kind: np.dtype, name: str) -> np.ndarray:
    """The words as numbers of this type, or as float32 where they have fractions."""
    if kind.kind == "f":
        return words.astype("f8").astype(kind)
    try:
        read = words.astype(kind.kind + "8")  # so that 64-bit times keep their last digits
    except ValueError:
        read = words.astype("f8")  # writers have 12.000000, or 0.35, for a uint8, too
        if not np.array_equal(read, np.floor(read)):
            return read.astype("<f4")
    limits = np.iinfo(kind)
    if read.size and not limits.min <= read.min().item() <= read.max().item() <= limits.max:
        raise ValueError(f"a number of its field '{name}' does not fit into {kind}")
    return read.astype(kind)


def _of_columns(data: bytes, layout: np.dtype, number: int) -> np.ndarray:
    """binary_compressed: LZF, or plain where LZF saved nothing, and field by field instead of point
    by point."""
    packed, size = struct.unpack_from("<II", data)
    if size != number * layout.itemsize or len(data) < 8 + packed:
        raise ValueError("the sizes of its compressed points do not fit: it was cut")
    plain = data[8:8 + packed]
    try:
        plain = unpacked_lzf(plain, size)
    except (ValueError, IndexError):
        if packed != size:
            raise
    points, at = np.empty(number, layout), 0
    for name in layout.names or ():
        part = layout[name]
        if part.itemsize:
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
