"""ROS parameter files: reading, and matching of sections to nodes."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from itertools import count, islice
from pathlib import Path
from typing import Any

import yaml

from lidar_perception.nodes import NODES
from lidar_perception.runs.files import read_text, shorten_error
from lidar_perception.types import InputError, find_closest_name

MAX_BYTES = 10**6
MAX_KEYS = 10_000  # ends the reading of a group that contains itself through a YAML anchor
MAX_LINES = 20  # maximum number of warnings for one file
EVERY_NODE = "/**"


def read_sections(path: str | Path) -> dict[str, dict[str, Any]]:
    """Read a parameter file.

    Returns:
        {name of a node, or pattern such as "/**/tracker": {dotted parameter: value}}

    Raises:
        InputError: the file cannot be read, or is not YAML of this form.
    """
    try:
        content = yaml.safe_load(read_text(path, MAX_BYTES)) or {}
    except (yaml.YAMLError, ValueError, OverflowError, RecursionError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"cannot read the parameter file {path}: {shorten_error(error)}") from None
    if not isinstance(content, dict):
        raise InputError(f"{path} is not a ROS parameter file; see config/ for examples")
    entry_counter = count()
    sections: dict[str, dict[str, Any]] = {}
    for node, group in _iterate_leaves(path, content, entry_counter, "/", stop="ros__parameters"):
        values = group if isinstance(group, dict) else {}
        leaves = dict(_iterate_leaves(path, values, entry_counter, "."))
        sections[node] = {**sections.get(node, {}), **leaves}
    return sections


def _iterate_leaves(
    path: str | Path,
    group: dict,
    entry_counter: Iterator[int],
    separator: str,
    prefix: str = "",
    stop: str | None = None,
) -> Iterator[tuple[str, Any]]:
    """Yield (joined name, value) of each leaf, or of each key `stop`."""
    for key, value in group.items():
        if next(entry_counter) >= MAX_KEYS:
            raise InputError(f"{path} has more than {MAX_KEYS} entries")
        if key == stop:
            yield prefix.removesuffix(separator), value
        elif isinstance(value, dict):
            yield from _iterate_leaves(path, value, entry_counter, separator, f"{prefix}{key}{separator}", stop)
        elif stop is None:
            yield f"{prefix}{key}", value


def is_for(section: str, node: str) -> bool:
    """Return True if a section applies to nodes of this name in some namespace."""
    return section.rpartition("/")[2] in ("*", "**", node)


def describe_unknown_nodes(path: str | Path, nodes: Collection[str], only_similar: bool = False) -> list[str]:
    """Return a warning for each section of a parameter file that applies to no node.

    Sections for other nodes of this package, with or without a prefix, are accepted, because several
    graphs may share a file.

    Args:
        nodes: names of the nodes that are started with the file.
        only_similar: only report names whose closest match is one of `nodes`.
    """
    lines = []
    for section in read_sections(path):
        name = section.rpartition("/")[2]
        if any(is_for(section, node) for node in nodes) or name.endswith(tuple(NODES)):
            continue
        guess = find_closest_name(name, [*nodes, *NODES])
        if guess in nodes or not only_similar:
            lines.append(
                f"{path}: unknown node {name[:80]!r}; its parameters are ignored"
                + (f"; did you mean {guess!r}?" if guess else "")
            )
    return [*islice(lines, MAX_LINES)]
