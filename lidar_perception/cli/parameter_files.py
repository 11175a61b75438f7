"""Reader of ROS parameter files for commands."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import Field
from itertools import count
from pathlib import Path
from typing import Any

import yaml

from lidar_perception.candidates.configurations import CONFIGURATIONS
from lidar_perception.nodes import NODES
from lidar_perception.nodes.node_parameters import describe_misspelt_parameters
from lidar_perception.runs.files import read_text, shorten_error
from lidar_perception.types import InputError, list_valid_names, suggest_name

MAX_BYTES, MAX_NAMES = 10**6, 10_000  # limits of a parameter file; YAML aliases turn few bytes into many names
ON_OFF = {"true": True, "yes": True, "on": True, "1": True, "false": False, "no": False, "off": False, "0": False}
MAX_DEPTH = 20  # maximum nesting of groups

Fields = Mapping[str, Field[Any]]


def read_parameters(
    path: Path, fields: Fields, nodes: Collection[str] | None = None
) -> tuple[dict[str, Any], list[str]]:
    """Read the values of a ROS parameter file, or of a named configuration of the candidates.

    Args:
        path: file, or a name of CONFIGURATIONS.
        fields: parameters to read, by dotted name; others are ignored.
        nodes: names of the nodes whose sections apply, in addition to sections for all nodes; None:
            all sections apply.

    Returns:
        {dotted name: value}, not validated, and a message for each name that may be misspelt.

    Raises:
        InputError: the file cannot be read, or a name in it is on the wrong level.
    """
    if str(path) in CONFIGURATIONS:
        configuration = CONFIGURATIONS[str(path)]
        if foreign_names := sorted(configuration.keys() - fields.keys()):
            raise InputError(
                f"the configuration {path} is for candidates, not {foreign_names[0]}; give a parameter file"
            )
        return dict(configuration), []
    content = _load_file(path)
    entry_count = count()
    values: dict[str, Any] = {}
    warnings: list[str] = []
    unknown_names: list[str] = []
    for node, section in content.items():
        if not (isinstance(section, dict) and isinstance(section.get("ros__parameters", ()), dict | None)):
            raise InputError(f"{path}: '{node}' has no ros__parameters; see config/ for examples")
        if nodes is not None and not _is_for_nodes(str(node), nodes):
            name = str(node).rpartition("/")[2]
            if name not in NODES and (suggestion := suggest_name(name, nodes)):
                warnings.append(f"unknown node {name[:80]!r}{suggestion}")
            continue
        for name, value in _iterate_dotted(path, section.get("ros__parameters") or {}, entry_count):
            if not isinstance(name, str):
                raise InputError(f"{path}: {name!r} is not a parameter name; quote it")
            if name in fields:
                values[name] = value
            elif any(k.startswith(f"{name}.") or name.startswith(f"{k}.") for k in fields):
                raise InputError(f"{path}: '{name}' is {_describe_wrong_level(name, fields)}")
            else:
                unknown_names.append(name)
    return values, [*warnings, *describe_misspelt_parameters(unknown_names)]


def _load_file(path: Path) -> dict[Any, Any]:
    if not path.exists():
        raise InputError(
            f"cannot read the parameter file {path}: file not found" + list_valid_names(str(path), CONFIGURATIONS)
        )
    try:
        content = yaml.safe_load(read_text(path, MAX_BYTES))
    except (yaml.YAMLError, ValueError, OverflowError, RecursionError) as error:
        raise InputError(f"cannot read the parameter file {path}: {shorten_error(error)}") from None
    if not isinstance(content, dict | None):
        raise InputError(f"{path} is not a parameter file; see config/ for examples")
    return content or {}


def _is_for_nodes(section: str, nodes: Collection[str]) -> bool:
    """Return True if a section applies to one of these nodes or to all nodes."""
    return section.rpartition("/")[2] in ("*", "**", *nodes)


def _describe_wrong_level(name: str, names: Iterable[str]) -> str:
    members = [k for k in names if k.startswith(f"{name}.")]
    return (
        f"a group, not a value; it contains {', '.join(members)}"
        if members
        else "nested in a parameter that is not a group"
    )


def _iterate_dotted(
    path: Path, section: dict, entry_count: Iterator[int], prefix: str = "", depth: int = 0
) -> Iterator[tuple[Any, Any]]:
    """Yield (dotted name, value); a name that is not a string is yielded unchanged.

    `entry_count` counts the entries of all groups, because YAML anchors can nest groups endlessly.
    """
    for key, value in section.items():
        if next(entry_count) >= MAX_NAMES or depth >= MAX_DEPTH:
            raise InputError(
                f"{path} is too large: at most {MAX_NAMES} parameters and {MAX_DEPTH} levels of nesting are supported"
            )
        if not isinstance(key, str):
            yield key, value
        elif isinstance(value, dict):
            yield from _iterate_dotted(path, value, entry_count, f"{prefix}{key}.", depth + 1)
        else:
            yield f"{prefix}{key}", value


def parse_value(name: str, f: Field[Any], text: str) -> Any:
    """Convert the text of a parameter to its type.

    Raises:
        InputError: The text has another type.
    """
    value_type = f.metadata["item"] or type(f.default)
    try:
        if not isinstance(f.default, tuple):
            return _parse_scalar(value_type, text)
        items = text.strip().removeprefix("[").removesuffix("]")
        return tuple(_parse_scalar(value_type, word.strip()) for word in items.split(",") if word.strip())
    except (ValueError, KeyError):
        expected = (
            "a list of numbers, e.g. 0.15,0.3"
            if isinstance(f.default, tuple)
            else {bool: "true or false", int: "a whole number", float: "a number"}[value_type]
        )
        raise InputError(f"--set {name}={text[:80]}: the value must be {expected}") from None


def _parse_scalar(value_type: type, text: str) -> Any:
    return ON_OFF[text.lower()] if value_type is bool else value_type(text)
