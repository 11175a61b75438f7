"""Generate pages and parameter files from the code: python docs/generate.py

These are docs/reference/nodes/*.md and config/*.param.yaml, from parameters and node_pages.yaml, and
the tables of docs/explanation/papers.md. test/test_docs.py checks that they are up to date and list
the topics of the running nodes.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from lidar_perception import params
from lidar_perception.candidates.configurations import BEST_VALUES
from lidar_perception.nodes import NODES
from lidar_perception.nodes.graph import NETWORKS
from lidar_perception.nodes.node_parameters import find_node_parameters
from lidar_perception.param_fields import flatten

sys.path.insert(0, str(Path(__file__).parents[1]))  # experiments/ is not installed
from experiments.departures import DEPARTURES, MEASURED

ROOT = Path(__file__).parents[1]
CONFIG = ROOT / "config"
PAPERS = ROOT / "docs" / "explanation" / "papers.md"
BEST = CONFIG / "best.param.yaml"
FOLDER = ROOT / "docs" / "reference" / "nodes"
TEXTS = yaml.safe_load((ROOT / "docs" / "node_pages.yaml").read_text())
MAX_FIRST_PARAMETERS = 10  # of a page; the others are folded


class Topic(NamedTuple):
    """A row of a table of topics or services; several names are separated by commas."""

    names: str
    type: str
    text: str


def list_inputs(node: str) -> list[Topic]:
    """Return the topics to which a node subscribes with its default parameters."""
    return _expand_groups(TEXTS["nodes"][node]["inputs"])


def _list_robot_inputs(node: str) -> list[Topic]:
    """Return the topics to which a node subscribes if its parameters need the robot's motion or TF."""
    names = {topic.names for topic in list_inputs(node)}
    topics = _expand_groups(["robot"] if "base_frame" in find_node_parameters(node) else [])
    return [topic for topic in topics if topic.names not in names]


def list_outputs(node: str) -> list[Topic]:
    """Return the topics that a node publishes."""
    return _expand_groups([*TEXTS["nodes"][node]["outputs"], "always", *(["managed"] if _is_managed(node) else [])])


def _list_services(node: str) -> list[Topic]:
    return _expand_groups(["managed_services"] if _is_managed(node) else TEXTS["nodes"][node].get("services", []))


def _is_managed(node: str) -> bool:
    return "autostart" in find_node_parameters(node)


def _expand_groups(entries: Sequence[str | dict[str, dict[str, str]]]) -> list[Topic]:
    """Return the topics of entries, each of which is a topic or the name of a group."""
    topics: list[Topic] = []
    for entry in entries:
        if isinstance(entry, str):
            topics += _expand_groups(TEXTS["groups"][entry])
        else:
            topics += [Topic(names, row["type"], row.get("text", "")) for names, row in entry.items()]
    return topics


def make_page(node: str) -> str:
    """Return the reference page of a node."""
    lines = [
        f"# {node}",
        "",
        TEXTS["nodes"][node]["description"],
        "",
        f"    ros2 run lidar_perception {node}      # or: lidar-perception run {node}",
        "",
    ]
    tables = {
        "Subscribes": list_inputs(node) + _list_robot_inputs(node),
        "Publishes": list_outputs(node),
        "Services": _list_services(node),
    }
    for title, topics in tables.items():
        if topics:
            rows = [topic._replace(names=f"`{topic.names}`") for topic in topics]
            lines += [f"## {title}", "", *_make_table("| name | type | |", rows), ""]
    fields = find_node_parameters(node)
    if "tracking.enabled" in fields:
        lines += [
            "With `tracking.enabled` the node has the topics of the [tracker](tracker.md), "
            "too; a detector with a network then also tracks weak detections, with scores "
            "of at least `tracking.min_score`.",
            "",
        ]
    first = [key for key in TEXTS["first_parameters"] if key in fields] or [*fields]
    first = first[:MAX_FIRST_PARAMETERS]
    rest = [key for key in fields if key not in first]
    lines += ["## Parameters", "", *_make_parameter_table(fields, first)]
    if rest:
        summary = f"<summary>{len(rest)} more parameters</summary>"
        lines += ["", '<details markdown="1">', summary, "", *_make_parameter_table(fields, rest), "", "</details>"]
    return "\n".join(lines) + "\n"


def _make_table(header: str, rows: Sequence[Sequence[str]]) -> list[str]:
    return [header, "|---" * (header.count("|") - 1) + "|", *("| " + " | ".join(row) + " |" for row in rows)]


def _make_parameter_table(fields: dict[str, Any], keys: list[str]) -> list[str]:
    rows = []
    for key in keys:
        field = fields[key]
        text = field.metadata["doc"] + (" Fixed at start." if field.metadata["fixed"] else "")
        rows.append((f"`{key}`", _format_default(field), _format_range(field), text))
    return _make_table("| name | default | range | |", rows)


def _format_default(field: Any) -> str:
    value, unit = field.default, f" {field.metadata['unit']}" if field.metadata["unit"] else ""
    if isinstance(value, tuple):
        return ", ".join(map(str, value)) + unit if value else "empty"
    return (str(value).lower() if isinstance(value, bool) else str(value) or "empty") + unit


def _format_range(field: Any) -> str:
    low, high, choices = (field.metadata[k] for k in ("low", "high", "choices"))
    if choices:
        return ", ".join(choices)
    if low is None and high is None:
        return ""
    return f"{'' if low is None else f'{low:g}'} .. {'' if high is None else f'{high:g}'}"


def update_papers_page() -> str:
    """Return the page of the papers with new tables between its marks."""
    measured = [row._replace(command=f"`{row.command}`") for row in MEASURED]
    header = "| paper, place | the paper | here | option for the paper's reading |"
    text = _replace_table(PAPERS.read_text(), "departures", header, DEPARTURES)
    return _replace_table(text, "measured", "| paper, place | what | command | data |", measured)


def _replace_table(text: str, mark: str, header: str, rows: Sequence[Sequence[str]]) -> str:
    """Return the text of a page with a new table between the two lines with a mark."""
    start, end = f"<!-- {mark}: made by docs/generate.py -->\n", f"<!-- end of {mark} -->\n"
    before, start_mark, rest = text.partition(start)
    _, end_mark, after = rest.partition(end)
    if not (start_mark and end_mark):
        raise ValueError(f"the page needs the lines {start!r} and {end!r}")
    table = "\n".join(_make_table(header, rows))
    return f"{before}{start}\n{table}\n\n{end}{after}"


def make_best_file() -> str:
    """Return the parameter file of the configuration `best`, for nodes."""
    return _make_parameter_file(
        "The configuration `best` (lidar_perception/candidates/configurations.py), for nodes", BEST_VALUES
    )


def make_detector_params(network: str) -> Any:
    """Return the default parameters of a detector."""
    module, _, name = NODES[f"{network}_detector"][1].rpartition(".")
    return getattr(importlib.import_module(f"lidar_perception.{module}"), name)()


def find_config_file(network: str) -> Path:
    """Return the path of the parameter file of a detector's graph."""
    return CONFIG / f"{network}.param.yaml"


def make_config_file(network: str) -> str:
    """Return the parameter file of a detector's graph: its parameters for the ground and cluster nodes."""
    shared = (params.GroundNodeParams(), params.ClusteringNodeParams())
    defaults = {key: value for group in shared for key, value in flatten(group).items()}
    values = {
        key: value
        for key, value in flatten(make_detector_params(network)).items()
        if key in defaults and value != defaults[key]
    }
    return _make_parameter_file(
        f"Ground and clusters as in detectors/{network}/params.py, for ground_segmentation and clustering", values
    )


def _make_parameter_file(title: str, values: dict[str, Any]) -> str:
    tree: dict[str, Any] = {}
    for key, value in values.items():
        *groups, name = key.split(".")
        node = tree
        for group in groups:
            node = node.setdefault(group, {})
        node[name] = list(value) if isinstance(value, tuple) else value
    return (
        f"# {title}; made by docs/generate.py.\n"
        "# All parameters, with units, ranges and defaults: docs/reference/nodes/.\n"
        + yaml.safe_dump({"/**": {"ros__parameters": tree}}, sort_keys=False)
    )


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for name in NODES:
        (FOLDER / f"{name}.md").write_text(make_page(name))
    PAPERS.write_text(update_papers_page())
    BEST.write_text(make_best_file())
    for name in NETWORKS:
        find_config_file(name).write_text(make_config_file(name))
