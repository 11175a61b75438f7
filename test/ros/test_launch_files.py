"""What the launch files start, with stand-ins for launch and launch_ros."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

from lidar_perception.nodes.graph import (
    POINTNET,
    POINTPILLARS,
    SINGLE,
    SINGLE_POINTNET,
    SINGLE_POINTPILLARS,
    STAGES,
)

ROOT = Path(__file__).resolve().parents[2]
SHARED = "lidar_perception.nodes.launching"
STAND_INS = {"launch": ["LaunchDescription"],
             "launch.actions": ["DeclareLaunchArgument", "OpaqueFunction"],
             "launch.substitutions": ["LaunchConfiguration"], "launch_ros": [],
             "launch_ros.actions": ["Node"]}


class Recorded(SimpleNamespace):
    """What a launch file asked for."""

    def __init__(self, *args, **options):
        super().__init__(args=args, **options)


@pytest.fixture
def launched(monkeypatch):
    """name of a launch file -> its arguments with their defaults, and a function that gives its
    nodes by name for arguments that are given."""
    for name, kinds in STAND_INS.items():
        module = ModuleType(name)
        for kind in kinds:
            setattr(module, kind, Recorded)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setitem(sys.modules, SHARED, None)  # forgotten again after the test
    del sys.modules[SHARED]

    def load(name):
        spec = importlib.util.spec_from_file_location(
            name, ROOT / "launch" / f"{name}.launch.py")
        file = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(file)
        described = file.generate_launch_description().args[0]
        arguments = {a.args[0]: a.default_value for a in described if hasattr(a, "default_value")}
        start = next(a.function for a in described if hasattr(a, "function"))

        def nodes(**given):
            assert set(given) <= set(arguments)
            context = SimpleNamespace(
                perform_substitution=lambda s: {**arguments, **given}[s.args[0]])
            return {n.executable: n for n in start(context)}
        return arguments, nodes
    return load


@pytest.mark.parametrize("name, graph, single", [
    ("perception", STAGES, SINGLE), ("pointpillars", POINTPILLARS, SINGLE_POINTPILLARS),
    ("pointnet", POINTNET, SINGLE_POINTNET)])
def test_a_launch_file_starts_its_graph_or_one_process(name, graph, single, launched):
    arguments, nodes = launched(name)
    config = str(ROOT / "config" / f"{name}.param.yaml")
    assert arguments["config"] == config and Path(config).is_file()
    started = nodes(points="/cloud", use_sim_time="true", log_level="debug")
    assert list(started) == list(graph) and list(nodes(single="true")) == list(single)
    assert ("~/input/points", "/cloud") in started["ground_segmentation"].remappings
    assert ("~/input/points", "/ground_segmentation/output/points") in (
        started["clustering"].remappings)
    for node in started.values():
        assert node.parameters[0] == config and node.parameters[1] == {"use_sim_time": True}
        assert node.ros_arguments == ["--log-level", "debug"]


@pytest.mark.parametrize("name, group", [("pointpillars", "detection"), ("pointnet", "pointnet")])
def test_weights_and_device_of_a_detector_are_arguments(name, group, launched):
    _, nodes = launched(name)
    given = nodes(weights="w.safetensors", device="cpu")[f"{name}_detector"].parameters[1]
    assert given == {f"{group}.weights": "w.safetensors", f"{group}.device": "cpu",
                     "use_sim_time": False}
