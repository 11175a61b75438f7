"""Conversion of launch arguments to parameter files, parameters and topics of nodes."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import yaml

from lidar_perception.nodes.graph import DETECTOR_NODES, NETWORKS
from lidar_perception.nodes.param_files import EVERY_NODE, is_for, read_sections
from lidar_perception.types import InputError

CONFIGS = {"candidates": "perception", "pointpillars": "pointpillars", "pointnet": "pointnet", "fused": "fused"}


def list_parameter_files(config: str) -> list[str]:
    """Return the files in the launch argument `config`. Raises InputError if one does not exist."""
    files = [config] if Path(config).is_file() else [f for f in config.split(",") if f]
    if missing_files := [file for file in files if not Path(file).is_file()]:
        raise InputError(f"config: parameter file not found: {missing_files[0]}")
    return files


def add_arguments(files: list[str], node: str, values: dict[str, Any]) -> list[Any]:
    """Return the `parameters` of a launch node: its files, overridden by these values."""
    # launch writes the values under /**, but rcl prefers sections that name the node.
    node_sections = [
        section for file in files for section in read_sections(file) if section != EVERY_NODE and is_for(section, node)
    ]
    if not values or not node_sections:
        return [*files, *filter(None, [values])]
    return [*files, values, write_section(*node_sections, values=values)]


def write_section(*names: str, values: dict[str, Any]) -> str:
    """Write a parameter file with these values in each section; return its path."""
    with tempfile.NamedTemporaryFile("w", prefix="launch_params_", suffix=".yaml", delete=False) as file:
        yaml.safe_dump({name: {"ros__parameters": values} for name in names}, file)
    return file.name


def split_detectors(text: str) -> list[str]:
    """Return the names in a comma-separated list; raise InputError if it is empty."""
    detectors = [name.strip() for name in text.split(",") if name.strip()]
    if not detectors:
        raise InputError(f"detectors is empty; choose one or more of {', '.join(DETECTOR_NODES)}")
    return detectors


def list_argument_parameters(value: dict[str, str], node: str, detectors: list[str]) -> dict[str, Any]:
    """Return the parameters of a node that are set by launch arguments."""
    params: dict[str, Any] = {}
    if value["use_sim_time"]:
        params["use_sim_time"] = value["use_sim_time"] == "true"
    if value["tracking"] == value["single"] == "true":
        params["tracking.enabled"] = True
    if value["autostart"] == "false":
        params["autostart"] = False
    if value["reliability"]:
        params["input.reliability"] = value["reliability"]
    if value["deskew"]:
        params["input.deskew"] = value["deskew"]
    if value["ahead"]:
        params["input.ahead"] = _parse_degrees(value["ahead"])
    params |= {name: value[name] for name in ("base_frame", "target_frame") if value[name]}
    detector = node.removesuffix("_detector")
    if detector in NETWORKS:
        weights = _parse_weights(value["weights"], [d for d in detectors if d in NETWORKS])
        for name, text in (("weights", weights.get(detector)), ("device", value["device"])):
            if text:
                params[f"{detector}.{name}"] = text
        if value["range"] and detector != "pointnet":
            params[f"{detector}.range"] = value["range"]
    return params


def _parse_degrees(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError(f"ahead:={text} is not a number; give an angle in degrees") from None


def _parse_weights(text: str, networks: list[str]) -> dict[str, str]:
    """Parse FILE, or NAME=FILE,NAME=FILE, to {network: file}."""
    if not text:
        return {}
    if len(networks) == 1 and not text.startswith(f"{networks[0]}="):
        return {networks[0]: text}
    pairs = dict(part.partition("=")[::2] for part in text.split(","))
    if unknown_names := [name for name in pairs if name not in networks]:
        raise InputError(
            f"weights: '{unknown_names[0]}' is not one of {', '.join(networks)}; "
            "for several networks use NAME=FILE,NAME=FILE"
        )
    return pairs
