"""Conversion of JSON to network configs: frozen dataclasses of numbers, strings, tuples and dataclasses."""

from __future__ import annotations

import dataclasses
import math
import types
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from lidar_perception.types import InputError

C = TypeVar("C")

MAX_LENGTH = 64  # maximum length of a tuple or string
MAX_NUMBER = 1 << 16  # well above any width, count or distance in metres


def parse_config(config_class: type[C], content: Any, source: str) -> C:
    """Make a config from parsed JSON, the inverse of dataclasses.asdict.

    Args:
        source: name of the file, for messages.

    Raises:
        InputError: a value does not have the type of its field, or a field is unknown.
    """
    try:
        return _convert(config_class, content, config_class.__name__)
    except (TypeError, ValueError, ArithmeticError) as error:
        raise InputError(f"{source} has an invalid network config: {error}") from None


def _convert(target_type: Any, value: Any, name: str) -> Any:
    """Convert a JSON value to an annotated type; raise ValueError if the types differ."""
    if isinstance(target_type, type) and dataclasses.is_dataclass(target_type) and isinstance(value, dict):
        hints = get_type_hints(target_type)
        field_names = {field.name for field in dataclasses.fields(target_type)}
        if unknown_names := sorted(set(value) - field_names):
            raise ValueError(f"unknown field {unknown_names[0][:40]!r}; the file is from a later version")
        return target_type(**{key: _convert(hints[key], item, key) for key, item in value.items()})
    if get_origin(target_type) is tuple and isinstance(value, list | tuple) and len(value) <= MAX_LENGTH:
        item_types = get_args(target_type)
        if item_types[-1] is ...:
            return tuple(_convert(item_types[0], item, name) for item in value)
        if len(item_types) == len(value):
            return tuple(_convert(item_type, item, name) for item_type, item in zip(item_types, value))
    if target_type is str and isinstance(value, str) and len(value) <= MAX_LENGTH:
        return value
    if target_type is bool and isinstance(value, bool):
        return value
    if target_type in (int, float) and isinstance(value, int | target_type) and not isinstance(value, bool):
        if not math.isfinite(value) or abs(value) > MAX_NUMBER:
            raise ValueError(f"{name} must be finite and at most {MAX_NUMBER}")
        return target_type(value)
    type_name = str(target_type) if isinstance(target_type, types.GenericAlias) else target_type.__name__
    raise ValueError(f"{name} is not of type {type_name}")
