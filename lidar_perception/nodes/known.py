"""The parameters of all nodes, and names that are of none of them."""

from __future__ import annotations

import importlib
from collections.abc import Iterable
from difflib import get_close_matches
from itertools import islice
from typing import Any

from lidar_perception.nodes import NODES
from lidar_perception.param_fields import collect_fields

ALIKE = 0.85  # 0..1, see difflib: a name is another one, misspelt
MOST = 200    # names that are looked at


def node_parameters(name: str) -> dict[str, Any]:
    """Name of each parameter of a node -> its dataclass field, with the node's default."""
    found: dict[str, Any] = {}
    for path in NODES[name][1:]:
        module, _, params = path.rpartition(".")
        made = getattr(importlib.import_module(f"lidar_perception.{module}"), params)()
        found |= collect_fields(made)
    return found


def misspelt(names: Iterable[str]) -> list[str]:
    """A line for each of these names of parameters that no node has, though it is in a group of
    theirs, or nearly one of their names. All others may be of other packages, whose parameters are
    in the same file."""
    if not (names := [*islice(names, MOST)]):
        return []
    known = {name for node in NODES for name in node_parameters(node)}
    groups = {name.partition(".")[0] for name in known if "." in name}
    lines = []
    for name in names:
        near = get_close_matches(name, known, 1, ALIKE)
        if name not in known and (near or (name.partition(".")[0] in groups and "." in name)):
            lines.append(f"no node has a parameter {name[:80]!r}, so it changes nothing"
                         + (f"; is '{near[0]}' meant?" if near else "; --help lists all"))
    return lines
