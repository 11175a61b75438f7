"""Flags from the parameter dataclasses, and parameter files."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator
from itertools import count
from pathlib import Path
from typing import Any

import click
import yaml

from lidar_perception.candidates.configurations import CONFIGURATIONS
from lidar_perception.nodes.known import misspelt
from lidar_perception.param_fields import flatten, parameter_fields, with_values
from lidar_perception.runs.files import read_text, short
from lidar_perception.runs.terminal import errors
from lidar_perception.types import InputError

MAX_BYTES, MAX_NAMES = 10**6, 10_000  # of a parameter file; aliases in YAML make many of few bytes
MAX_DEPTH = 20  # groups in each other


class NumberList(click.ParamType):
    """Comma-separated numbers."""

    name = "numbers"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple:
        if isinstance(value, tuple):
            return value
        try:
            return tuple(float(v) for v in str(value).split(","))
        except ValueError:
            self.fail(f"{value!r} is not a list of numbers like 0.15,0.3", param, ctx)


def parameter_options(defaults: Any) -> Callable:
    """Decorator: one flag for each field, and --config. The function gets params=..."""

    def decorate(function: Callable) -> Callable:
        def wrapper(*args: Any, **kwargs: Any) -> Any:
            given = {name: value for name in parameter_fields(defaults)
                     if (value := kwargs.pop(_variable(name))) is not None}
            config = kwargs.pop("config")
            try:
                params = with_values(defaults, {**(read_config(config, defaults) if config else {}),
                                                **given})
            except ValueError as error:
                raise InputError(str(error)) from None
            return function(*args, params=params, **kwargs)

        wrapper.__name__, wrapper.__doc__ = function.__name__, function.__doc__
        setattr(wrapper, "__click_params__", getattr(function, "__click_params__", []))  # noqa: B010
        for name, f in reversed(parameter_fields(defaults).items()):
            wrapper = _option(name, f, defaults)(wrapper)
        named = [name for name, values in CONFIGURATIONS.items()
                 if values.keys() & parameter_fields(defaults).keys()]
        return click.option("--config", type=click.Path(path_type=Path), metavar="YAML|NAME",
                            help="ROS parameter file, as in config/"
                            + (f", or one of {', '.join(named)}." if named else "."))(wrapper)

    return decorate


def _variable(name: str) -> str:
    return name.replace(".", "_")


def _option(name: str, f: dataclasses.Field, defaults: Any) -> Callable:
    flag = "--" + name.replace(".", "-").replace("_", "-")
    meta, default = f.metadata, flatten(defaults)[name]
    unit = f" [{meta['unit']}]" if meta["unit"] else ""
    shown = (",".join(map(str, default)) if isinstance(default, tuple) else
             f"{default:.4g}" if isinstance(default, float) else default)
    kind: Any = NumberList() if isinstance(default, tuple) else type(default)
    if meta["choices"]:
        kind = click.Choice(meta["choices"])
    if isinstance(default, bool):
        return click.option(f"{flag}/--no-{flag[2:]}", _variable(name), default=None,
                            help=f"{meta['doc']} Default: {'on' if default else 'off'}.")
    return click.option(flag, _variable(name), type=kind, default=None,
                        help=f"{meta['doc']}{unit} Default: {'none' if shown == '' else shown}.")


def read_config(path: Path, params: Any) -> dict[str, Any]:
    """Values of a ROS parameter file for params, or of a named configuration; other nodes'
    parameters are left out."""
    if str(path) in CONFIGURATIONS:
        return {name: value for name, value in CONFIGURATIONS[str(path)].items()
                if name in parameter_fields(params)}
    try:
        content = yaml.safe_load(read_text(path, MAX_BYTES))
    except (yaml.YAMLError, ValueError, OverflowError, RecursionError) as error:
        raise InputError(f"cannot read the parameter file {path}: {short(error)}") from None
    if not isinstance(content, dict | None):
        raise InputError(f"{path} is no parameter file; see config/ for the form")
    known, values, visited = parameter_fields(params), {}, count()
    others = []
    for node, section in (content or {}).items():
        if not (isinstance(section, dict)
                and isinstance(section.get("ros__parameters", ()), dict | None)):
            raise InputError(f"{path}: '{node}' has no ros__parameters; see config/ for the form")
        for name, value in _dotted(path, section.get("ros__parameters") or {}, visited):
            if not isinstance(name, str):
                raise InputError(f"{path}: {name!r} is no name of a parameter; put it into quotes")
            if name in known:
                values[name] = value
            elif any(k.startswith(f"{name}.") or name.startswith(f"{k}.") for k in known):
                raise InputError(f"{path}: '{name}' is {_wrong_level(name, known)}")
            else:
                others.append(name)
    for line in misspelt(others):
        errors.print(f"{path}: {line}")
    return values


def _wrong_level(name: str, known: Iterable[str]) -> str:
    inner = [k for k in known if k.startswith(f"{name}.")]
    return (f"a group, not a value; it holds {', '.join(inner)}" if inner else
            "below a parameter that holds no others")


def _dotted(path: Path, section: dict, visited: Iterator[int], prefix: str = "",
            depth: int = 0) -> Iterator[tuple[Any, Any]]:
    """(dotted name, value); the name as it is where it is no text. visited counts all that is
    looked at, as groups may be empty, and may be in each other by their anchors."""
    for key, value in section.items():
        if next(visited) >= MAX_NAMES or depth >= MAX_DEPTH:
            raise InputError(f"{path} has more than {MAX_NAMES} parameters, or groups in more than "
                             f"{MAX_DEPTH} others")
        if not isinstance(key, str):
            yield key, value
        elif isinstance(value, dict):
            yield from _dotted(path, value, visited, f"{prefix}{key}.", depth + 1)
        else:
            yield f"{prefix}{key}", value
