"""Declaration of parameters as dataclass fields with unit, range and description.

Values are checked on construction. Groups may be nested; the fields of inner groups have dotted
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

from lidar_perception.types import list_valid_names, suggest_name

MAX_INT = 2**31 - 1
SHORT_REPR = reprlib.Repr()  # formats invalid values for error messages of one line
SHORT_REPR.maxstring = SHORT_REPR.maxother = SHORT_REPR.maxlong = 80
SHORT_REPR.maxlevel = 2


def param(
    default: Any,
    doc: str,
    *,
    unit: str = "",
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] = (),
    fixed: bool = False,
) -> Any:
    """Declare a parameter: a dataclass field with metadata for ROS, YAML, command line and docs.

    Args:
        default: default value, or a type for an empty list with items of that type.
        doc: description, one or more sentences.
        low, high: inclusive limits.
        fixed: True if the parameter cannot change while a node runs.
    """
    item = default if isinstance(default, type) else type(default[0]) if isinstance(default, tuple) else None
    default = () if isinstance(default, type) else default
    metadata = dict(doc=doc, unit=unit, low=low, high=high, choices=choices, fixed=fixed, item=item)
    return field(default=default, metadata=metadata)


@dataclasses.dataclass(frozen=True)
class Params:
    """Base class of all parameter groups: checks types and ranges on construction."""

    def __post_init__(self) -> None:
        for f in fields(self):
            if not isinstance(f.default, Params):
                object.__setattr__(self, f.name, _check_value(f, getattr(self, f.name)))
        self.check()

    def check(self) -> None:
        """Check conditions that involve several fields; raise ValueError if one is violated."""


def _check_value(f: dataclasses.Field[Any], value: Any) -> Any:
    """Return the value, converted to the type of the field's default. Raises ValueError if invalid."""
    default, limits = f.default, f.metadata
    if isinstance(default, tuple):
        if isinstance(value, str) or not hasattr(value, "__iter__"):
            raise ValueError(f"{f.name} = {SHORT_REPR.repr(value)} must be a list of {limits['item'].__name__} values")
        return tuple(_check_scalar(f, limits["item"], item) for item in value)
    value = _check_scalar(f, type(default), value)
    if limits["choices"] and value not in limits["choices"]:
        raise ValueError(
            f"{f.name} = {value!r} must be one of {', '.join(limits['choices'])}"
            + suggest_name(value, limits["choices"])
        )
    return value


def _check_scalar(f: dataclasses.Field[Any], scalar_type: type[Any], value: Any) -> Any:
    if scalar_type is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value) if abs(value) < 2**63 else math.inf if value > 0 else -math.inf
    if not isinstance(value, scalar_type) or (scalar_type is int and isinstance(value, bool)):
        raise ValueError(f"{f.name} = {SHORT_REPR.repr(value)} must be of type {scalar_type.__name__}")
    low, high = f.metadata["low"], f.metadata["high"]
    if scalar_type is float and math.isnan(value):
        raise ValueError(f"{f.name} is not a number (NaN)")
    if (low is not None and value < low) or (high is not None and value > high):
        bounds = f"{'-inf' if low is None else low} .. {'inf' if high is None else high}"
        unit = f" {f.metadata['unit']}" if f.metadata["unit"] else ""
        raise ValueError(f"{f.name} = {value} is outside {bounds}{unit}")
    return value


def _walk_fields(params: Any, prefix: str = "") -> Iterator[tuple[str, Any, dataclasses.Field[Any]]]:
    """Yield (dotted name, value, field) for every parameter of a group or a dataclass of groups."""
    for f in fields(params):
        value = getattr(params, f.name)
        if dataclasses.is_dataclass(value):
            yield from _walk_fields(value, f"{prefix}{f.name}.")
        else:
            yield prefix + f.name, value, f


def flatten(params: Any) -> dict[str, Any]:
    """Return the parameters of a group, or a dataclass of groups, by dotted name.

    Example: {'clustering.dbscan.eps': (0.15, 0.3, 0.5), ...}.
    """
    return {name: value for name, value, _ in _walk_fields(params)}


def collect_fields(params: Any) -> dict[str, dataclasses.Field[Any]]:
    """Return the fields of all parameters by dotted name, with the values in `params` as defaults."""
    return {name: _with_default(f, value) for name, value, f in _walk_fields(params)}


def _with_default(f: dataclasses.Field[Any], value: Any) -> dataclasses.Field[Any]:
    if f.default == value:
        return f
    new_field = copy.copy(f)
    new_field.default = value
    return new_field


def describe_fields(fields: Mapping[str, dataclasses.Field[Any]]) -> list[str]:
    """Return lines of help text with the name, default, unit and description of each field."""
    lines = []
    for name, f in fields.items():
        default = list(f.default) if isinstance(f.default, tuple) else f.default
        unit = f" {f.metadata['unit']}" if f.metadata["unit"] else ""
        lines += [f"  {name} (default {default!r}{unit})", f"      {f.metadata['doc']}"]
    return lines


def with_values(params: Any, values: Mapping[str, Any]) -> Any:
    """Return a copy of params with other values, such as {'clustering.dbscan.min_samples': 5}.

    Raises:
        ValueError: a parameter is unknown, or a value is invalid.
    """
    valid_names = collect_fields(params)
    if unknown := [name for name in values if name not in valid_names]:
        raise ValueError(f"unknown parameter {unknown[0]!r}{list_valid_names(unknown[0], valid_names)}")
    return _replace_values(params, values, "")


def _replace_values(params: Any, values: Mapping[str, Any], prefix: str) -> Any:
    new_values = {}
    for f in fields(params):
        old_value, name = getattr(params, f.name), prefix + f.name
        if dataclasses.is_dataclass(old_value):
            new_values[f.name] = _replace_values(old_value, values, f"{name}.")
        elif name in values:
            new_values[f.name] = values[name]
    try:
        return dataclasses.replace(params, **new_values)
    except ValueError as error:
        # Errors of inner groups already have the full name.
        raise ValueError(f"{prefix}{error}") from None
