"""Graphs of nodes with their topic remappings, and the processes that run them.

Launch files and the demo start their nodes from here.
"""

from __future__ import annotations

import fcntl
import os
import random
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from time import monotonic
from typing import Any

import yaml

from lidar_perception.candidates.params import STEPS
from lidar_perception.runs.machine import count_cores
from lidar_perception.types import CLASSES, PEDESTRIAN, InputError
from lidar_perception.wire.topics import CAMERA_INFO, EXTRINSICS, ODOMETRY, POINTS, TRUTH

Graph = Mapping[str, Mapping[str, str]]  # node -> its topic remappings


def make_relative(topic: str) -> str:
    """Remove the leading slash of a topic, so that the topic is in the namespace of its node."""
    return topic.lstrip("/")


CAMERA_INPUTS = {"~/input/camera_info": make_relative(CAMERA_INFO), "~/input/extrinsics": make_relative(EXTRINSICS)}
TRUTH_INPUT = {"~/input/ground_truth": make_relative(TRUTH)}
CLOUD_INPUT = {"~/input/points": make_relative(POINTS)}
CLUSTERED_CLOUD_INPUT = {"~/input/points": "clustering/output/points"}
ODOMETRY_INPUT = {"~/input/odometry": make_relative(ODOMETRY)}
TRACKER = "tracker"
MAX_CORES_FOR_ONE_PROCESS = 4
SEPARATOR = "---"  # separates the arguments of nodes that share a process
FINAL_STAGE = "final"  # name of a detector's last stage, whose boxes are the detections

# Nodes for ground and clusters, shared by all detectors.
EXPERTS = {
    "ground_segmentation": {**CLOUD_INPUT, **CAMERA_INPUTS},
    "clustering": {"~/input/points": "ground_segmentation/output/points"},
}
# Detector -> its node downstream of EXPERTS.
DETECTOR_NODES = {
    "candidates": {"candidate_refinement": {**CLUSTERED_CLOUD_INPUT, **TRUTH_INPUT}},
    "pointpillars": {"pointpillars_detector": CLUSTERED_CLOUD_INPUT},
    "pointnet": {"pointnet_detector": CLUSTERED_CLOUD_INPUT},
    "fused": {"fused_detector": CLUSTERED_CLOUD_INPUT},
}
# Detector -> its standalone node, which computes ground and clusters itself.
SINGLE_PROCESS_NODES = {
    "candidates": {"perception": {**CLOUD_INPUT, **TRUTH_INPUT, **CAMERA_INPUTS}},
    "pointpillars": {"pointpillars_detector": CLOUD_INPUT},
    "pointnet": {"pointnet_detector": CLOUD_INPUT},
    "fused": {"fused_detector": CLOUD_INPUT},
}
# Detectors with a network, each with a parameter group of the same name.
NETWORKS = tuple(name for name, nodes in SINGLE_PROCESS_NODES.items() if f"{name}_detector" in nodes)


def build_graph(detectors: Sequence[str], single: bool = False, tracking: bool = False) -> dict[str, Mapping[str, str]]:
    """Return {node: {topic: remapped topic}} for one or more detectors; nodes that they share appear once.

    Args:
        detectors: names of detectors, keys of DETECTOR_NODES.
        single: let each detector compute ground and clusters itself, in one process.
        tracking: add a tracker for each detector.

    Raises:
        InputError: a detector is unknown.
    """
    for name in detectors:
        if name not in DETECTOR_NODES:
            raise InputError(f"detectors: '{name}' is unknown; choose from {', '.join(DETECTOR_NODES)}")
    graphs = [] if single else [EXPERTS]
    graphs += [(SINGLE_PROCESS_NODES if single else DETECTOR_NODES)[name] for name in detectors]
    if tracking:
        graphs += [{tracker: _remap_tracker(name, single)} for tracker, name in find_trackers(detectors).items()]
    return {node: remap for graph in graphs for node, remap in graph.items()}


def find_expert_params(detectors: Sequence[str], params: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parameters of ground_segmentation that follow from its detectors.

    Args:
        detectors: names of detectors.
        params: parameters of the detectors. With range auto, the packaged weights detect ahead.

    Returns:
        range: ahead or around if all detectors use that range; all if the ranges differ, or if a
            detector needs the full cloud or has its own weights.
        ground.patchwork.remove_reflections: False if all detectors ignore the intensity.
    """
    ranges = set()
    for name in detectors:
        detection_range = params.get(f"{name}.range", "auto")
        is_known = name in ("fused", "pointpillars") and not params.get(f"{name}.weights")
        ranges.add(("ahead" if detection_range == "auto" else detection_range) if is_known else "all")
    uses_intensity = any(name not in NETWORKS or params.get(f"{name}.use_intensity", True) for name in detectors)
    return {
        "range": ranges.pop() if len(ranges) == 1 else "all",
        **({} if uses_intensity else {"ground.patchwork.remove_reflections": False}),
    }


def find_trackers(detectors: Sequence[str]) -> dict[str, str]:
    """Return {tracker node: detector whose boxes it tracks}."""
    return {f"{name}_{TRACKER}" if len(detectors) > 1 else TRACKER: name for name in detectors}


def _remap_tracker(detector: str, single: bool) -> dict[str, str]:
    detections = f"{find_result_node(detector, single)}/output/detections"
    return {"~/input/detections": detections, **CLOUD_INPUT, **ODOMETRY_INPUT}


def find_executable(node: str) -> str:
    """Return the executable that runs a node of a graph."""
    return TRACKER if node.endswith(f"_{TRACKER}") else node


def add_node_prefix(graph: Graph, prefix: str) -> dict[str, dict[str, str]]:
    """Return the graph with a prefix on the names of its nodes and of the topics between them."""

    def add_prefix(topic: str) -> str:
        return prefix + topic if topic.partition("/")[0] in graph else topic

    return {prefix + node: {old: add_prefix(new) for old, new in remap.items()} for node, remap in graph.items()}


CANDIDATES_GRAPH = build_graph(["candidates"])
SINGLE_PROCESS_CANDIDATES = build_graph(["candidates"], single=True)


def find_result_node(detector: str, single: bool = False) -> str:
    """Return the node that publishes the detections of a detector."""
    (node,) = (SINGLE_PROCESS_NODES if single else DETECTOR_NODES)[detector]
    return node


def list_result_topics(single: bool = False, detector: str = "candidates") -> dict[str, str]:
    """Return {stage: topic of its detections}, without a namespace; networks have one stage."""
    node = find_result_node(detector, single)
    early_stages = ("stage1", "stage2") if detector == "candidates" else ()
    return {**{stage: f"/{node}/debug/{stage}" for stage in early_stages}, FINAL_STAGE: f"/{node}/output/detections"}


def find_result_cloud_topic(single: bool = False, detector: str = "candidates") -> str:
    """Return the topic of the clouds that have all columns that the graph adds."""
    if not single:
        return "/clustering/output/points"
    if detector != "candidates":
        return POINTS
    return f"/{find_result_node(detector, single)}/output/points"


def list_stages(detectors: Sequence[str], single: bool = False) -> dict[str, str]:
    """Return {stage: topic of its detections} for one detector; {detector: topic} for several."""
    if len(detectors) == 1:
        return list_result_topics(single, detectors[0])
    return {name: list_result_topics(single, name)[FINAL_STAGE] for name in detectors}


def list_timing_topics(detectors: Sequence[str] = ("candidates",), single: bool = False) -> list[str]:
    """Return the topics of the processing times of all nodes, and of the steps of the candidates."""
    topics = [f"/{node}/debug/processing_time_ms" for node in build_graph(detectors, single)]
    if "candidates" in detectors:
        steps = STEPS if single else STEPS[-3:]
        topics += [f"/{find_result_node('candidates', single)}/debug/{step}_ms" for step in steps]
    return topics


def configure_evaluator(
    file: Path | str, single: bool = False, detectors: Sequence[str] = ("candidates",)
) -> tuple[dict[str, str], dict[str, Any]]:
    """Return the remapping and the parameters of an evaluator that scores all stages.

    Candidates alone are scored as in the STM-CPA paper: only pedestrians, against all labels.
    Networks also detect objects outside the camera image, where there are no labels, so the
    evaluator gets the camera to ignore those.
    """
    topics, only_candidates = list_stages(detectors, single), [*detectors] == ["candidates"]
    remap = (
        TRUTH_INPUT
        | ({} if only_candidates else CAMERA_INPUTS)
        | {f"~/input/{k}": make_relative(v) for k, v in topics.items()}
    )
    timing = [*map(make_relative, list_timing_topics(detectors, single))]
    return remap, {
        "stages": list(topics),
        "timing": timing,
        "file": str(file),
        **({"classes": [CLASSES[PEDESTRIAN]]} if only_candidates else {}),
    }


def runs_in_one_process(processes: str | bool | None) -> bool:
    """Return True if the nodes of a graph run in one process.

    One process needs less memory and CPU time; several make better use of many cores.

    Args:
        processes: "true": one process per node; "false": one process for all nodes; "auto" or None:
            one process for all nodes on a machine with up to MAX_CORES_FOR_ONE_PROCESS cores.
    """
    if processes in ("auto", None):
        return count_cores() <= MAX_CORES_FOR_ONE_PROCESS
    return processes in ("false", False)


def find_connected_outputs(graph: Graph) -> dict[str, set[str]]:
    """Return {node: its outputs to which another node of the graph subscribes}, without a namespace."""
    inputs = {f"/{make_relative(topic)}" for remap in graph.values() for topic in remap.values()}
    return {node: {topic for topic in inputs if topic.startswith(f"/{node}/")} for node in graph}


def list_awaited_topics(
    detectors: Sequence[str] = ("candidates",), single: bool = False, points: int = 1, truth: int = 1
) -> list[str]:
    """Return the value of bag_player's parameter wait_for for a graph.

    The player then waits for the subscribers of the clouds and of the labels, and for one
    subscriber of each result and of each topic between the nodes.

    Args:
        points: number of subscribers of the clouds.
        truth: number of subscribers of the labels, besides the seed input of the candidates.
    """
    internal_topics = sorted(set().union(*find_connected_outputs(build_graph(detectors, single)).values()))
    truth += "candidates" in detectors
    topics = [
        f"{POINTS}:={points}",
        f"{TRUTH}:={truth}",
        *internal_topics,
        *(topic for name in detectors for topic in list_result_topics(single, name).values()),
    ]
    return [*map(make_relative, topics)]


_domain_locks: list[Any] = []  # lock files of the reserved domains, open until this process ends


def reserve_domain() -> int:
    """Reserve an unused ROS domain from 1 to 100 on this machine, until this process ends.

    The ports of higher domains may be in use as ephemeral ports of other programs.

    Raises:
        InputError: all domains are in use.
    """
    for domain in random.SystemRandom().sample(range(1, 101), 100):
        name = f"lidar_perception-{os.getuid()}-domain-{domain}.lock"
        lock = open(Path(tempfile.gettempdir()) / name, "w")
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                # Port of the first participant in the domain (RTPS 2.5, Section 9.6.2.3).
                probe.bind(("", 7410 + 250 * domain))
            except OSError:
                lock.close()
                continue
        _domain_locks.append(lock)
        return domain
    raise InputError("all ROS domains 1 to 100 are in use on this machine; stop other ROS processes")


class Processes:
    """Context manager for node processes, which end with it.

    Args:
        logs: folder for the parameters and the output of each process.
        domain: ROS domain, limited to this machine; None for that of the environment.

    Attributes:
        running: {name: Popen object} of all started processes.
    """

    def __init__(self, logs: Path, domain: int | None = None):
        self.logs = logs
        self.environment = dict(os.environ)
        if domain is not None:
            self.environment.update(ROS_DOMAIN_ID=str(domain), ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST")
        self.running: dict[str, Any] = {}
        self._shared_arguments: list[list[str]] | None = None  # arguments of the nodes in share_process()

    def __enter__(self) -> Processes:
        self.logs.mkdir(parents=True, exist_ok=True)
        return self

    def start(self, node: str, remap: Mapping[str, str], params: Mapping[str, Any], namespace: str = "") -> None:
        """Start a node of a graph. Its key in `running` is NODE, or NAMESPACE.NODE."""
        values = {k: list(v) if isinstance(v, tuple) else v for k, v in params.items()}
        values = {k: v for k, v in values.items() if v != []}  # an empty list has no type in YAML
        name = f"{namespace}.{node}" if namespace else node
        file = self.logs / f"{name}.param.yaml"
        file.write_text(yaml.safe_dump({"/**": {"ros__parameters": values}}))
        rules = {
            **remap,
            **({"__ns": f"/{namespace}"} if namespace else {}),
            **({"__node": node} if find_executable(node) != node else {}),
        }
        remapping = [word for rule in rules.items() for word in ("-r", ":=".join(rule))]
        arguments = [find_executable(node), "--ros-args", "--params-file", str(file), *remapping]
        if self._shared_arguments is None:
            self.run_node(name, arguments)
        else:
            self._shared_arguments.append(arguments)

    @contextmanager
    def share_process(self, name: str) -> Iterator[None]:
        """Run the nodes that are started inside the with block in one process of this name."""
        nodes: list[list[str]] = []
        self._shared_arguments = nodes
        yield
        self._shared_arguments = None
        self.run_node(name, [word for arguments in nodes for word in (SEPARATOR, *arguments)][1:])

    def run_node(self, name: str, arguments: Sequence[str]) -> None:
        """Start one of the executables of this package."""
        self.run(name, [sys.executable, "-m", "lidar_perception.nodes.main", *arguments])

    def run(self, name: str, command: Sequence[str]) -> None:
        """Start any program, with its output in NAME.log."""
        with open(self.logs / f"{name}.log", "w") as log:
            self.running[name] = subprocess.Popen(
                command, env=self.environment, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT
            )

    def check(self, *finite_nodes: str) -> None:
        """Raise InputError with the last log line of a node that has ended.

        finite_nodes: nodes that may have ended with exit code 0.
        """
        for node, process in self.running.items():
            code = process.poll()
            if code is not None and (node not in finite_nodes or code):
                lines = (self.logs / f"{node}.log").read_text().strip().splitlines() or ["no log"]
                raise InputError(f"{node} ended with code {code}: {lines[-1]} (log: {self.logs / node}.log)")

    def has_ended(self, node: str) -> bool:
        return self.running[node].poll() is not None

    def measure_memory_mb(self) -> dict[str, float]:
        """Return the proportional set size of each running process in MB; empty without /proc."""
        sizes = {}
        for node, process in self.running.items():
            try:
                lines = Path(f"/proc/{process.pid}/smaps_rollup").read_text().splitlines()
                sizes[node] = next(int(x.split()[1]) for x in lines if x.startswith("Pss:")) / 1024
            except (OSError, StopIteration):
                continue
        return sizes

    def measure_cpu_seconds(self) -> dict[str, float]:
        """Return the CPU time of each running process in seconds; empty without /proc."""
        seconds = {}
        for node, process in self.running.items():
            try:  # proc(5): fields 14 (utime) and 15 (stime); the text after the name starts with field 3
                fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
                seconds[node] = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
            except (OSError, IndexError):
                continue
        return seconds

    def stop(self, timeout: float = 5.0) -> dict[str, int]:
        """Send SIGINT to all processes, and SIGKILL after `timeout` seconds; return {name: exit code}."""
        for process in self.running.values():
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
        end = monotonic() + timeout
        for process in self.running.values():
            try:
                process.wait(max(0.1, end - monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        return {node: p.returncode for node, p in self.running.items()}

    def __exit__(self, *_: Any) -> None:
        self.stop()
