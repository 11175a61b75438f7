"""How a number is declared: a dataclass field with unit, range and text, checked when made.

params.py holds the numbers themselves. A group may hold further groups; their fields have dotted
names, such as ground.cloth.resolution.
"""

from __future__ import annotations

import copy
import dataclasses
import math
import reprlib
from collections.abc import Iterator, Mapping
from dataclasses import field, fields
from typing import Any

from lidar_perception.types import did_you_mean, valid_names

MAX_INT = 2**31 - 1
SHOWN = reprlib.Repr()  # of a value that is refused, as much as fits into a line
SHOWN.maxstring = SHOWN.maxother = SHOWN.maxlong = 80
SHOWN.maxlevel = 2


def param(default: Any, doc: str, *, unit: str = "", low: float | None = None,
          high: float | None = None, choices: tuple[str, ...] = (), fixed: bool = False) -> Any:
    """A dataclass field with what ROS, YAML, the command line and the docs need to know.

    low and high are inclusive; fixed parameters cannot change while a node runs. A default of
    type `type` stands for an empty list of it.
    """
    item = default if isinstance(default, type) else type(default[0]) if isinstance(
        default, tuple) else None
    default = () if isinstance(default, type) else default
    metadata = dict(doc=doc, unit=unit, low=low, high=high, choices=choices, fixed=fixed,
                    item=item)
    return field(default=default, metadata=metadata)


@dataclasses.dataclass(frozen=True)
class Params:
    """Base of all parameter groups: checks types and ranges on construction."""

    def __post_init__(self) -> None:
        for f in fields(self):
            if not isinstance(f.default, Params):
                object.__setattr__(self, f.name, _checked(f, getattr(self, f.name)))
        self.check()

    def check(self) -> None:
        """Conditions between fields; raise ValueError."""


def _checked(f: dataclasses.Field[Any], value: Any) -> Any:
    """value with the type of the field's default, or ValueError naming field, value and range."""
    default, limits = f.default, f.metadata
    if isinstance(default, tuple):
        if isinstance(value, str) or not hasattr(value, "__iter__"):
            raise ValueError(f"{f.name} = {SHOWN.repr(value)} must be a list of "
                             f"{limits['item'].__name__}")
        return tuple(_scalar(f, limits["item"], item) for item in value)
    value = _scalar(f, type(default), value)
    if limits["choices"] and value not in limits["choices"]:
        raise ValueError(f"{f.name} = {value!r} must be one of {', '.join(limits['choices'])}"
                         + did_you_mean(value, limits["choices"]))
    return value


def _scalar(f: dataclasses.Field[Any], kind: type[Any], value: Any) -> Any:
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value) if abs(value) < 2**63 else math.inf if value > 0 else -math.inf
    if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
        raise ValueError(f"{f.name} = {SHOWN.repr(value)} must be of type {kind.__name__}")
    low, high = f.metadata["low"], f.metadata["high"]
    if kind is float and math.isnan(value):
        raise ValueError(f"{f.name} is not a number (NaN)")
    if (low is not None and value < low) or (high is not None and value > high):
        bounds = f"{'-inf' if low is None else low} .. {'inf' if high is None else high}"
        unit = f" {f.metadata['unit']}" if f.metadata["unit"] else ""
        raise ValueError(f"{f.name} = {value} is outside {bounds}{unit}")
    return value


def _walk(params: Any, prefix: str = "") -> Iterator[tuple[str, Any, dataclasses.Field[Any]]]:
    """(dotted name, value, field) of every number in a group, or a dataclass of groups."""
    for f in fields(params):
        value = getattr(params, f.name)
        if dataclasses.is_dataclass(value):
            yield from _walk(value, f"{prefix}{f.name}.")
        else:
            yield prefix + f.name, value, f


def flatten(params: Any) -> dict[str, Any]:
    """{'clustering.dbscan.eps': (0.15, 0.3, 0.5), ...} of a group or a dataclass of groups."""
    return {name: value for name, value, _ in _walk(params)}


def parameter_fields(params: Any) -> dict[str, dataclasses.Field[Any]]:
    """{'clustering.dbscan.eps': Field, ...}: metadata, and params' values as defaults, named as in
    flatten."""
    return {name: _with_default(f, value) for name, value, f in _walk(params)}


def _with_default(f: dataclasses.Field[Any], value: Any) -> dataclasses.Field[Any]:
    if f.default == value:
        return f
    changed = copy.copy(f)
    changed.default = value
    return changed


def described(fields: Mapping[str, dataclasses.Field[Any]]) -> list[str]:
    """Return lines with name, default, unit and text of each field."""
    lines = []
    for name, f in fields.items():
        default = list(f.default) if isinstance(f.default, tuple) else f.default
        unit = f" {f.metadata['unit']}" if f.metadata["unit"] else ""
        lines += [f"  {name} (default {default!r}{unit})", f"      {f.metadata['doc']}"]
    return lines


def with_values(params: Any, values: Mapping[str, Any]) -> Any:
    """params with {'clustering.dbscan.min_samples': 5, ...} set; ValueError names what is unknown
    or wrong."""
    known = parameter_fields(params)
    if unknown := [name for name in values if name not in known]:
        raise ValueError(f"unknown parameter {unknown[0]!r}{valid_names(unknown[0], known)}")
    return _replaced(params, values, "")


def _replaced(params: Any, values: Mapping[str, Any], prefix: str) -> Any:
    """params with those of the dotted values set that lie under prefix."""
    changed = {}
    for f in fields(params):
        inner, name = getattr(params, f.name), prefix + f.name
        if dataclasses.is_dataclass(inner):
            changed[f.name] = _replaced(inner, values, f"{name}.")
        elif name in values:
            changed[f.name] = values[name]
    try:
        return dataclasses.replace(params, **changed)
    except ValueError as error:
        # Errors of inner groups have their whole name already.
        raise ValueError(f"{prefix}{error}") from None
