"""Configs of networks as JSON: frozen dataclasses of numbers, strings, tuples and dataclasses."""

from __future__ import annotations

import dataclasses
import math
import types
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from lidar_perception.types import InputError

C = TypeVar("C")

MOST = 64          # elements of a tuple
LARGEST = 1 << 16  # of any number: far beyond every width, count and metre of a network


def config_of(kind: type[C], content: Any, source: str) -> C:
    """The inverse of dataclasses.asdict after a trip through JSON: each value must be of its
    field's type. InputError naming source and what does not fit."""
    try:
        return _as(kind, content, kind.__name__)
    except (TypeError, ValueError, ArithmeticError) as error:
        raise InputError(f"{source} describes no network: {error}") from None


def _as(kind: Any, value: Any, name: str) -> Any:
    """value as a kind, a type or tuple[...]. ValueError naming what does not fit."""
    if isinstance(kind, type) and dataclasses.is_dataclass(kind) and isinstance(value, dict):
        hints = get_type_hints(kind)
        known = {f.name for f in dataclasses.fields(kind)}
        if unknown := sorted(set(value) - known):
            raise ValueError(f"unknown field {unknown[0][:40]!r}; it was made by a later version")
        return kind(**{key: _as(hints[key], part, key) for key, part in value.items()})
    if get_origin(kind) is tuple and isinstance(value, list | tuple) and len(value) <= MOST:
        parts = get_args(kind)
        if parts[-1] is ...:
            return tuple(_as(parts[0], part, name) for part in value)
        if len(parts) == len(value):
            return tuple(_as(part, own, name) for part, own in zip(parts, value))
    if kind is str and isinstance(value, str) and len(value) <= MOST:
        return value
    if kind is bool and isinstance(value, bool):
        return value
    if kind in (int, float) and isinstance(value, int | kind) and not isinstance(value, bool):
        if not math.isfinite(value) or abs(value) > LARGEST:
            raise ValueError(f"{name} is not a number up to {LARGEST}")
        return kind(value)
    wanted = str(kind) if isinstance(kind, types.GenericAlias) else kind.__name__
    raise ValueError(f"{name} is not of type {wanted}")
