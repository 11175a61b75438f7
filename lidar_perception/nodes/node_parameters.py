"""Parameters of all nodes, and detection of misspelt parameter names."""

from __future__ import annotations

import importlib
from collections.abc import Iterable
from difflib import get_close_matches
from itertools import islice
from typing import Any

from lidar_perception.nodes import NODES
from lidar_perception.param_fields import collect_fields

MIN_SIMILARITY = 0.85  # difflib ratio (0 to 1) above which a name counts as a misspelling
MAX_NAMES = 200  # maximum number of names to check


def find_node_parameters(name: str) -> dict[str, Any]:
    """Return {parameter: dataclass field with the node's default} of a node.

    name: executable of the node.
    """
    fields: dict[str, Any] = {}
    for path in NODES[name][1:]:
        module, _, params = path.rpartition(".")
        defaults = getattr(importlib.import_module(f"lidar_perception.{module}"), params)()
        fields |= collect_fields(defaults)
    return fields


def describe_misspelt_parameters(names: Iterable[str]) -> list[str]:
    """Return a warning for each unknown name that resembles one of our parameters or is in our groups.

    Other unknown names are accepted, because other packages may have parameters in the same file.
    """
    if not (names := [*islice(names, MAX_NAMES)]):
        return []
    parameter_names = {name for node in NODES for name in find_node_parameters(node)}
    groups = {name.partition(".")[0] for name in parameter_names if "." in name}
    lines = []
    for name in names:
        matches = get_close_matches(name, parameter_names, 1, MIN_SIMILARITY)
        if name not in parameter_names and (matches or (name.partition(".")[0] in groups and "." in name)):
            lines.append(
                f"unknown parameter {name[:80]!r} is ignored"
                + (f"; did you mean '{matches[0]}'?" if matches else "; --help lists all")
            )
    return lines
