"""Arguments shared by all launch files, and one process for each node.

The parameters of a node come from the package's own file, then from the files that the user gives,
then from the other arguments; the later ones win.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Collection
from pathlib import Path
from typing import Any

import yaml
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription, LogInfo, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription
from lidar_perception.nodes import NODES
from lidar_perception.nodes.graph import (
    ALONE,
    BEHIND,
    EXPERTS,
    NETWORKS,
    ODOMETRY_IN,
    SINGLE,
    STAGES,
    TRACKER,
    executable_of,
    graph_of,
    prefixed,
    relative,
    trackers_of,
)
from lidar_perception.nodes.known import node_parameters
from lidar_perception.nodes.param_files import EVERY_NODE, is_for, read_sections, unknown_nodes
from lidar_perception.param_fields import flatten
from lidar_perception.params import ClusteringNodeParams, GroundNodeParams
from lidar_perception.types import InputError, unknown_name
from lidar_perception.wire.topics import ODOMETRY, POINTS

CONFIGS = {"candidates": "perception", "pointpillars": "pointpillars", "pointnet": "pointnet",
           "fused": "fused"}

OF_LAUNCH = ("launch-prefix", "launch-prefix-filter")  # arguments that launch itself takes
RESPAWN_DELAY = 2.0  # seconds, so that a node that cannot start does not fill the log

SWITCHES: dict[str, Any] = dict(default_value="false", choices=["true", "false"])
ARGUMENTS: dict[str, dict[str, Any]] = {
    "namespace": dict(default_value="", description="Of all nodes and topics, for one of several "
                      "sensors; /diagnostics, /tf and /clock stay outside."),
    "name_prefix": dict(default_value="", description="Before the name of each node."),
    "points": dict(default_value=relative(POINTS), description="The cloud's topic."),
    "reliability": dict(default_value="", description="auto, reliable or best_effort, for the "
                        "parameter input.reliability; empty: that of the parameter file."),
    "base_frame": dict(default_value="", description="Parameter base_frame: the mounting comes "
                       "from TF; empty: that of the parameter file."),
    "target_frame": dict(default_value="", description="Parameter target_frame: of the boxes that "
                         "go out; empty: that of the parameter file."),
    "deskew": dict(default_value="", choices=["", "off", "odometry", "tf"], description="Parameter "
                   "input.deskew: clouds are moved to their stamp; empty: that of the parameter "
                   "file."),
    "ahead": dict(default_value="", description="Parameter input.ahead: where the detectors look, "
                  "degrees from the clouds' x axis; empty: that of the parameter file."),
    "range": dict(default_value="", choices=["", "auto", "ahead", "around"],
                  description="Parameter range of fused and pointpillars: what they see; empty: "
                  "that of the parameter file."),
    "config": dict(default_value="", description="Parameter files of all nodes, with commas, on "
                   "top of config/*.param.yaml of each detector."),
    "experts": dict(default_value="", description="Of ground and clusters: the detector whose "
                    "config/*.param.yaml they take, empty: the first; or a parameter file on top "
                    "of all others."),
    "weights": dict(default_value="", description="Checkpoint of the network, with several "
                    "networks NAME=FILE,NAME=FILE; empty: that of the parameter file, or the one "
                    "that comes with the package."),
    "device": dict(default_value="", description="auto, cpu, cuda, cuda:N of the networks; empty: "
                   "that of the parameter file."),
    "tracking": dict(**SWITCHES, description="Tracks of what each detector finds: a tracker behind "
                     "each; with `single` in the detector's process."),
    "odometry": dict(default_value=relative(ODOMETRY), description="Topic of the odometry, for "
                     "the trackers and deskew."),
    "single": dict(**SWITCHES, description="Each detector in one process, which finds ground and "
                   "clusters itself."),
    "autostart": dict(default_value="true", choices=["true", "false"], description="false: a "
                      "lifecycle manager configures and activates the nodes."),
    "respawn": dict(**SWITCHES, description="Start a node again when it has ended, as after a "
                    "crash; with autostart:=false it is not configured then."),
    "rviz": dict(**SWITCHES, description="Start RViz with config/lidar_perception.rviz, in the "
                 "same namespace."),
    "rviz_frame": dict(default_value="", description="Fixed frame of RViz; empty: that of its "
                       "file, velodyne."),
    "use_sim_time": dict(default_value="", choices=["", "true", "false"], description="Take the "
                         "time from /clock; empty: that of the parameter file, else false."),
    "log_level": dict(default_value="info", description="debug, info, ..."),
}


def graph_launch(config_folder: Path, detectors: str) -> LaunchDescription:
    """Ground and clusters, once, and the detectors behind them: a list with commas, the default of
    the argument `detectors`. ARGUMENTS are the others."""
    given = given_arguments()

    def nodes(context: Any) -> list[Any]:
        refuse_unknown(given, context, ["detectors", *ARGUMENTS])
        value = {k: context.perform_substitution(LaunchConfiguration(k))
                 for k in ("detectors", *ARGUMENTS)}
        processes = started(value, config_folder)
        lines = [f"warning: {line}" for file in parameter_files(value["config"], value["experts"])
                 for line in unknown_nodes(file, _graph(value))]
        return [*(LogInfo(msg=line) for line in [*lines, *conflicts(value, config_folder)]),
                *processes]

    return LaunchDescription([
        DeclareLaunchArgument("detectors", default_value=detectors,
                              description=f"One or several of {','.join(BEHIND)}."),
        *(DeclareLaunchArgument(name, **what) for name, what in ARGUMENTS.items()),
        OpaqueFunction(function=nodes),
    ])


def given_arguments() -> list[Any]:
    """Return the names of the arguments that are given to the launch file that calls this, on the
    command line or by the file that includes it; text, or substitutions of launch.

    Only the IncludeLaunchDescription that loads the file knows them. In the context they are among
    the launch configurations of all other files.
    """
    frame: Any = sys._getframe()
    while frame is not None:
        action = frame.f_locals.get("self")
        if isinstance(action, IncludeLaunchDescription):
            return [name for name, _ in action.launch_arguments]
        frame = frame.f_back
    return []


def refuse_unknown(given: list[Any], context: Any, known: Collection[str]) -> None:
    """Raise InputError for the first name that is not an argument; it names the closest one."""
    for parts in given:
        name = "".join(part if isinstance(part, str) else context.perform_substitution(part)
                       for part in (parts if isinstance(parts, list | tuple) else [parts]))
        if name in known or name in OF_LAUNCH:
            continue
        if nodes := [node for node in NODES if name in node_parameters(node)]:
            raise InputError(f"'{name}' is not a launch argument but a parameter of "
                             f"{', '.join(nodes)}; set it in a parameter file, config:=FILE")
        raise unknown_name("launch argument", name, sorted(known))


def parameter_files(config: str, experts: str = "") -> list[str]:
    """Return the parameter files among the values of `config` and `experts`. InputError for one
    that does not exist."""
    files = [config] if Path(config).is_file() else [f for f in config.split(",") if f]
    if missing := [file for file in files if not Path(file).is_file()]:
        raise InputError(f"config: there is no parameter file {missing[0]}")
    if experts and experts not in CONFIGS:
        if not Path(experts).is_file():
            raise InputError(f"experts: there is no parameter file {experts}, nor a detector of "
                             f"that name ({', '.join(CONFIGS)})")
        files.append(experts)
    return files


def started(value: dict[str, str], config_folder: Path) -> list[Node]:
    """The nodes that the values of the arguments ask for."""
    graph, detectors, single = _graph(value), _detectors(value), value["single"] == "true"
    prefix, users = value["name_prefix"], parameter_files(value["config"])
    files = {node: [_own_file(name, config_folder), *users] for name in detectors
             for node in (ALONE if single else BEHIND)[name]}
    files |= {node: _expert_files(value, config_folder) for node in EXPERTS}
    files |= {node: [str(config_folder / f"{TRACKER}.param.yaml"), *users]
              for node in trackers_of(detectors)}
    topics = {relative(POINTS): value["points"], relative(ODOMETRY): value["odometry"]}
    viewer = [_viewer(value, config_folder)] if value["rviz"] == "true" else []
    return viewer + [Node(
        package="lidar_perception", executable=executable_of(node.removeprefix(prefix)), name=node,
        namespace=value["namespace"] or None, output="screen",
        parameters=with_arguments(files[node.removeprefix(prefix)], node,
                                  _given(value, node.removeprefix(prefix), detectors)),
        remappings=[(a, topics.get(b, b)) for a, b in {**remap, **ODOMETRY_IN}.items()],
        ros_arguments=["--log-level", value["log_level"]],
        respawn=value["respawn"] == "true", respawn_delay=RESPAWN_DELAY,
    ) for node, remap in graph.items()]


def _graph(value: dict[str, str]) -> dict[str, dict[str, str]]:
    # Whether a node wants odometry, its parameter file may say; it changes nothing for the others.
    detectors, single = _detectors(value), value["single"] == "true"
    tracking = value["tracking"] == "true" and not single
    return prefixed(graph_of(detectors, single, tracking), value["name_prefix"])


def with_arguments(files: list[str], node: str, given: dict[str, Any]) -> list[Any]:
    """Return the parameters of a node for launch: its files, and above them what arguments set."""
    # launch writes `given` under /**, where rcl prefers the sections that name the node.
    named = [section for file in files for section in read_sections(file)
             if section != EVERY_NODE and is_for(section, node)]
    if not given or not named:
        return [*files, *filter(None, [given])]
    with tempfile.NamedTemporaryFile("w", prefix="launch_params_", suffix=".yaml",
                                     delete=False) as file:
        yaml.safe_dump({section: {"ros__parameters": given} for section in named}, file)
    return [*files, given, file.name]


def conflicts(value: dict[str, str], config_folder: Path) -> list[str]:
    """What to say about the parameter file of ground and clusters: a line for each detector whose
    own file has other numbers; none where the user chose the file."""
    detectors, given = _detectors(value), value["experts"]
    if value["single"] == "true":
        return ["experts has no effect, as with single:=true each detector finds ground and "
                "clusters itself"] if given else []
    if given not in ("", *CONFIGS):
        return []
    chosen, users = given or detectors[0], parameter_files(value["config"])
    numbers = {name: _expert_numbers([_own_file(name, config_folder), *users])
               for name in (chosen, *detectors)}
    lines = []
    for name in detectors:
        others = [f"{key} {number}" for key, number in numbers[name].items()
                  if number != numbers[chosen][key]]
        if others:
            lines.append(f"ground and clusters are started with the numbers of {chosen}; those of "
                         f"{name} are others: {', '.join(others)}. experts:=NAME or experts:=FILE "
                         "chooses")
    return lines


def _own_file(detector: str, config_folder: Path) -> str:
    return str(config_folder / f"{CONFIGS[detector]}.param.yaml")


def _expert_files(value: dict[str, str], config_folder: Path) -> list[str]:
    """Return the parameter files of ground and clusters."""
    chosen = value["experts"] if value["experts"] in CONFIGS else _detectors(value)[0]
    return [_own_file(chosen, config_folder), *parameter_files(value["config"], value["experts"])]


def _expert_numbers(files: list[str]) -> dict[str, Any]:
    """Return the parameters of ground and clusters with these files."""
    known = {key: list(v) if isinstance(v, tuple) else v
             for group in (GroundNodeParams(), ClusteringNodeParams())
             for key, v in flatten(group).items() if key.startswith(("ground.", "clustering."))}
    given = {key: number for file in files for section, values in read_sections(file).items()
             if any(is_for(section, node) for node in EXPERTS) for key, number in values.items()}
    return known | {k: v for k, v in given.items() if k in known}


def _detectors(value: dict[str, str]) -> list[str]:
    detectors = [name.strip() for name in value["detectors"].split(",") if name.strip()]
    if not detectors:
        raise InputError(f"detectors is empty; give one or several of {','.join(BEHIND)}")
    return detectors


def _viewer(value: dict[str, str], config_folder: Path) -> Node:
    """RViz, its topics renamed as those of the nodes are."""
    file = config_folder / "lidar_perception.rviz"
    frame = ["-f", value["rviz_frame"]] if value["rviz_frame"] else []
    renamed = {topic: _shown(topic, value) for _, topic in rviz_topics(file)}
    return Node(
        package="rviz2", executable="rviz2", name=value["name_prefix"] + "rviz",
        namespace=value["namespace"] or None, arguments=["-d", str(file), *frame], output="screen",
        parameters=[{"use_sim_time": value["use_sim_time"] == "true"}],
        remappings=[(a, b) for a, b in renamed.items() if a != b])


def rviz_topics(file: Path) -> list[tuple[str, str]]:
    """(class, topic) of each display and tool of an RViz file that has a topic."""
    manager = yaml.safe_load(file.read_text())["Visualization Manager"]
    return [(each["Class"], each["Topic"]["Value"])
            for each in [*manager["Displays"], *manager["Tools"]] if "Topic" in each]


def _shown(topic: str, value: dict[str, str]) -> str:
    node, slash, rest = topic.partition("/")
    detectors, single = _detectors(value), value["single"] == "true"
    if topic == relative(POINTS):
        return value["points"]
    if node == TRACKER:  # of the first detector
        node = next(iter(ALONE[detectors[0]] if single else trackers_of(detectors)))
    elif single and node in STAGES:
        node = next(iter(SINGLE))
    ours = node in {*graph_of([*BEHIND]), *trackers_of(detectors), *SINGLE}
    return (value["name_prefix"] if ours else "") + node + slash + rest


def _given(value: dict[str, str], node: str, detectors: list[str]) -> dict[str, Any]:
    """Parameters that arguments set, above those of the file."""
    given: dict[str, Any] = {}
    if value["use_sim_time"]:
        given["use_sim_time"] = value["use_sim_time"] == "true"
    if value["tracking"] == value["single"] == "true":
        given["tracking.enabled"] = True
    if value["autostart"] == "false":
        given["autostart"] = False
    if value["reliability"]:
        given["input.reliability"] = value["reliability"]
    if value["deskew"]:
        given["input.deskew"] = value["deskew"]
    if value["ahead"]:
        given["input.ahead"] = _degrees(value["ahead"])
    given |= {name: value[name] for name in ("base_frame", "target_frame") if value[name]}
    detector = node.removesuffix("_detector")
    if detector in NETWORKS:
        weights = _weights(value["weights"], [d for d in detectors if d in NETWORKS])
        for name, chosen in (("weights", weights.get(detector)), ("device", value["device"])):
            if chosen:
                given[f"{detector}.{name}"] = chosen
        if value["range"] and detector != "pointnet":
            given[f"{detector}.range"] = value["range"]
    return given


def _degrees(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError(f"ahead:={text} is no number of degrees") from None


def _weights(text: str, networks: list[str]) -> dict[str, str]:
    """Network -> file, of FILE or NAME=FILE,NAME=FILE."""
    if not text:
        return {}
    if len(networks) == 1 and not text.startswith(f"{networks[0]}="):
        return {networks[0]: text}
    pairs = dict(part.partition("=")[::2] for part in text.split(","))
    if unknown := [name for name in pairs if name not in networks]:
        raise InputError(f"weights: '{unknown[0]}' is none of {', '.join(networks)}; with several "
                         "networks give NAME=FILE,NAME=FILE")
    return pairs
