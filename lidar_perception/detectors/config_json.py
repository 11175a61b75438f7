"""Network configs from JSON: frozen dataclasses of numbers, strings, tuples and dataclasses."""

from __future__ import annotations

import dataclasses
import math
import types
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from lidar_perception.types import InputError

C = TypeVar("C")

MAX_LENGTH = 64  # maximum length of a tuple or string
MAX_NUMBER = 1 << 16  # well above any width, count or distance in metres


def parse_config(kind: type[C], content: Any, source: str) -> C:
    """Make a config of class `kind` from parsed JSON, the inverse of dataclasses.asdict.

    Args:
        source: name of the file, for the message.

    Raises:
        InputError: a value does not have the type of its field, or a field is unknown.
    """
    try:
        return _convert(kind, content, kind.__name__)
    except (TypeError, ValueError, ArithmeticError) as error:
        raise InputError(f"{source} has an invalid network config: {error}") from None


def _convert(kind: Any, value: Any, name: str) -> Any:
    """Convert a JSON value to the annotated type `kind`. ValueError if it has another type."""
    if isinstance(kind, type) and dataclasses.is_dataclass(kind) and isinstance(value, dict):
        hints = get_type_hints(kind)
        names = {f.name for f in dataclasses.fields(kind)}
        if unknown := sorted(set(value) - names):
            raise ValueError(f"unknown field {unknown[0][:40]!r}; the file is from a later version")
        return kind(**{key: _convert(hints[key], part, key) for key, part in value.items()})
    if get_origin(kind) is tuple and isinstance(value, list | tuple) and len(value) <= MAX_LENGTH:
        item_types = get_args(kind)
        if item_types[-1] is ...:
            return tuple(_convert(item_types[0], part, name) for part in value)
        if len(item_types) == len(value):
            return tuple(_convert(part, part_type, name) for part, part_type in zip(item_types, value))
    if kind is str and isinstance(value, str) and len(value) <= MAX_LENGTH:
        return value
    if kind is bool and isinstance(value, bool):
        return value
    if kind in (int, float) and isinstance(value, int | kind) and not isinstance(value, bool):
        if not math.isfinite(value) or abs(value) > MAX_NUMBER:
            raise ValueError(f"{name} is not finite or above {MAX_NUMBER}")
        return kind(value)
    type_name = str(kind) if isinstance(kind, types.GenericAlias) else kind.__name__
    raise ValueError(f"{name} is not of type {type_name}")
