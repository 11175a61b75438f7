"""Configs of networks as JSON: frozen dataclasses of numbers, strings and tuples."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, TypeVar

from lidar_perception.types import InputError

C = TypeVar("C")


def config_of(kind: type[C], content: dict[str, Any], source: str,
              special: dict[str, Callable[[Any], Any]]) -> C:
    """The config that JSON describes: lists become tuples, fields with a function in special what
    it makes of them. InputError naming source and what does not fit."""
    known = {f.name for f in dataclasses.fields(kind)}
    try:
        if unknown := sorted(set(content) - known):
            raise ValueError(f"unknown field {unknown[0]!r}; it was made by a later version")
        values = {name: special[name](value) if name in special else
                  tuple(value) if isinstance(value, list) else value
                  for name, value in content.items()}
        return kind(**values)
    except (TypeError, ValueError, KeyError) as error:
        raise InputError(f"{source} describes no network: {error}") from None
