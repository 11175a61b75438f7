"""Random small damage to bytes, text and messages.

Each function returns the damaged copy and a short description.
"""

from __future__ import annotations

import re
import struct
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype

from fuzz.case import pick
from lidar_perception.wire.codec import load_typestore, make_bag_message

INTEGERS = (0, 1, 255, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**64 - 1)
FLOATS = (0.0, -0.0, np.nan, np.inf, -np.inf, 5e-324, 1e-40, 1e38, -1e38, 1e308, 1e5, -1.0)
WORDS = (
    "nan",
    "-inf",
    "1e400",
    "-1",
    "0",
    "1e-320",
    "9" * 400,
    "",
    "null",
    "é",
    "\x00",
    "0x10",
    "1,5",
    "true",
    "[" * 5000,
    "{" * 5000,
    "-" * 30,
    "2147483648",
    "1e38",
)
TEXTS = ("", "x" * 70_000, "é\u202e", "a b", "/", "../..", "\n", "x", "intensity")


def mutate_bytes(data: bytes, rng: np.random.Generator) -> tuple[bytes, str]:
    """Apply 1 to 3 of: flip a bit, delete, insert, repeat or zero bytes, write a number, cut off;
    anywhere, or near either end, where headers and indices are."""
    changes = []
    for _ in range(int(rng.integers(1, 4))):
        data, change = _change_bytes(data, rng)
        changes.append(change)
    return data, ", ".join(changes)


def _change_bytes(data: bytes, rng: np.random.Generator) -> tuple[bytes, str]:
    size = len(data)
    low, high = pick(rng, ((0, size), (0, size), (0, min(size, 512)), (max(0, size - 4096), size)))
    at = int(rng.integers(low, high + 1))
    count = int(rng.integers(1, 1 + pick(rng, (1, 8, 64, 4096))))
    before, part, after = data[:at], data[at : at + count], data[at + count :]
    kind = pick(rng, ("flip", "flip", "delete", "insert", "repeat", "zero", "number", "number", "cut"))
    if kind == "flip":
        part = bytes([part[0] ^ 1 << int(rng.integers(8))]) + part[1:] if part else b""
    elif kind == "delete":
        part = b""
    elif kind == "insert":
        part = rng.bytes(count) + part
    elif kind == "repeat":
        part *= 2
    elif kind == "zero":
        part = bytes(len(part))
    elif kind == "number":
        number = struct.pack("<Q", pick(rng, (*INTEGERS, size, size + 1)))[: pick(rng, (1, 2, 4, 8))]
        part, after = number, (part + after)[len(number) :]
    else:
        part = after = b""
    return before + part + after, f"{kind} at {at} of {size}, {count} bytes"


def mutate_text(text: str, rng: np.random.Generator) -> tuple[str, str]:
    """Apply 1 to 3 of: replace, delete or copy a word, delete or double a line, insert a character,
    cut off."""
    changes = []
    for _ in range(int(rng.integers(1, 4))):
        spans = [m.span() for m in re.finditer(r"[\w.+-]+", text)] or [(0, 0)]
        begin, end = pick(rng, spans)
        kind = pick(rng, ("word", "word", "word", "number", "drop", "swap", "line", "no line", "character", "cut"))
        if kind == "word":
            word = pick(rng, WORDS)
            text = text[:begin] + word + text[end:]
            kind = f"{word[:12]!r} put at {begin}"
        elif kind == "number":
            number = float(rng.normal(0, 10.0 ** rng.integers(-3, 9)))
            text = f"{text[:begin]}{number!r}{text[end:]}"
        elif kind == "drop":
            text = text[:begin] + text[end:]
        elif kind == "swap":
            text = text[:begin] + text[slice(*pick(rng, spans))] + text[end:]
        elif kind in ("line", "no line"):
            lines = text.splitlines(keepends=True) or [""]
            i = int(rng.integers(len(lines)))
            text = "".join(lines[:i] + lines[i : i + 1] * (2 if kind == "line" else 0) + lines[i + 1 :])
        elif kind == "character":
            text = text[:begin] + pick(rng, "\x00\ufeff\r\t{}[]:,\"'#&*!|>%@`\u2028") + text[begin:]
        else:
            text = text[:begin]
        changes.append(kind)
    return text, ", ".join(changes)


def mutate_message(message: Any, rng: np.random.Generator) -> str:
    """Give one field of a message, at any depth, another value of its type. message: of rosbags'
    classes, changed in place."""
    name, kind = pick(rng, [field for field in load_typestore().fielddefs[message.__msgtype__][1]])
    (node, detail), value = kind, getattr(message, name)
    if node == Nodetype.NAME:
        return f"{name}.{mutate_message(value, rng)}"
    if node == Nodetype.BASE:
        setattr(message, name, _draw_value(detail[0], rng))
        return f"{name} = {str(getattr(message, name))[:20]}"
    element = detail[0]
    if element[0] == Nodetype.BASE and element[1][0] != "string":
        new_value, what = _change_array(value, rng, fixed=node == Nodetype.ARRAY)
        setattr(message, name, new_value)
        return f"{name}: {what}"
    return f"{name}: {_change_list(message, name, element, rng)}"


def _draw_value(kind: str, rng: np.random.Generator) -> Any:
    if kind == "string":
        return pick(rng, TEXTS)
    if kind == "bool":
        return bool(rng.integers(2))
    if kind.startswith("float"):
        with np.errstate(over="ignore"):
            return float(np.dtype(kind).type(pick(rng, FLOATS)))
    limits = np.iinfo(kind.replace("octet", "uint8").replace("byte", "uint8"))
    number = pick(rng, INTEGERS) if rng.random() < 0.7 else int(rng.integers(-20, 100))
    return int(min(max(number, limits.min), limits.max))


def _change_array(values: np.ndarray, rng: np.random.Generator, fixed: bool) -> tuple[np.ndarray, str]:
    values = np.array(values)
    if not fixed and rng.random() < 0.5:
        size = int(rng.integers(0, 2 * len(values) + 2))
        return np.resize(values, size) if len(values) else np.zeros(
            size, values.dtype
        ), f"{size} values of {len(values)}"
    if len(values):
        at = int(rng.integers(len(values)))
        values[at] = _draw_value(values.dtype.name, rng)
        return values, f"[{at}] = {values[at]}"
    return values, "none"


def _change_list(message: Any, name: str, element: tuple, rng: np.random.Generator) -> str:
    items = list(getattr(message, name))
    kind = what = pick(rng, ("inside", "inside", "drop", "double", "new"))
    if kind == "new" or not items:
        items.append("x" if element[0] == Nodetype.BASE else make_bag_message(element[1]))
    elif kind == "inside" and element[0] == Nodetype.NAME:
        at = int(rng.integers(len(items)))
        what = f"[{at}].{mutate_message(items[at], rng)}"
    elif kind == "inside":
        items[int(rng.integers(len(items)))] = pick(rng, TEXTS)
    elif kind == "drop":
        del items[int(rng.integers(len(items)))]
    else:
        items.append(pick(rng, items))
    setattr(message, name, items)
    return what
