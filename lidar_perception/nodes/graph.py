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
from lidar_perception.wire.clouds import diagnose_packets, find_cloud_topics
from lidar_perception.wire.topics import CAMERA_INFO, EXTRINSICS, ODOMETRY, POINTS, TRUTH

Graph = Mapping[str, Mapping[str, str]]  # node -> its topic remappings


def relative_name(topic: str) -> str:
    """Return the topic without its leading slash, so that it follows the namespace of its node."""
    return topic.lstrip("/")


CAMERA = {"~/input/camera_info": relative_name(CAMERA_INFO), "~/input/extrinsics": relative_name(EXTRINSICS)}
TRUTH_INPUT = {"~/input/ground_truth": relative_name(TRUTH)}
CLOUDS = {"~/input/points": relative_name(POINTS)}
ODOMETRY_INPUT = {"~/input/odometry": relative_name(ODOMETRY)}
TRACKER = "tracker"
MAX_CORES_FOR_ONE_PROCESS = 4
SEPARATOR = "---"  # separates the arguments of nodes that share a process
FINAL = "final"  # name of a detector's last stage, whose boxes are the detections
CLUSTERED = {"~/input/points": "clustering/output/points"}

# Nodes for ground and clusters, shared by all detectors.
EXPERTS = {
    "ground_segmentation": {**CLOUDS, **CAMERA},
    "clustering": {"~/input/points": "ground_segmentation/output/points"},
}
# Detector -> its node downstream of EXPERTS.
DETECTOR_NODES = {
    "candidates": {"candidate_refinement": {**CLUSTERED, **TRUTH_INPUT}},
    "pointpillars": {"pointpillars_detector": CLUSTERED},
    "pointnet": {"pointnet_detector": CLUSTERED},
    "fused": {"fused_detector": CLUSTERED},
}
# Detector -> its standalone node, which computes ground and clusters itself.
SINGLE_PROCESS_NODES = {
    "candidates": {"perception": {**CLOUDS, **TRUTH_INPUT, **CAMERA}},
    "pointpillars": {"pointpillars_detector": CLOUDS},
    "pointnet": {"pointnet_detector": CLOUDS},
    "fused": {"fused_detector": CLOUDS},
}


# Detectors with a network, each with a parameter group of the same name.
NETWORKS = tuple(name for name, nodes in SINGLE_PROCESS_NODES.items() if f"{name}_detector" in nodes)


def build_graph(detectors: Sequence[str], single: bool = False, tracking: bool = False) -> dict[str, Mapping[str, str]]:
    """Return the nodes of one or several detectors, each node once.

    Args:
        detectors: names of detectors, keys of DETECTOR_NODES.
        single: each detector finds ground and clusters itself, in one process.
        tracking: add a tracker for each detector.

    Returns:
        {node: {its topic: remapped topic}}

    Raises:
        InputError: a detector is unknown.
    """
    for name in detectors:
        if name not in DETECTOR_NODES:
            raise InputError(f"detectors: '{name}' is unknown; choose from {', '.join(DETECTOR_NODES)}")
    parts = [(SINGLE_PROCESS_NODES if single else DETECTOR_NODES)[name] for name in detectors]
    if tracking:
        parts += [{tracker: _remap_tracker(name, single)} for tracker, name in find_trackers(detectors).items()]
    return {k: v for part in ([] if single else [EXPERTS]) + parts for k, v in part.items()}


def find_expert_range(detectors: Sequence[str], params: Mapping[str, Any]) -> str:
    """Return the parameter range of ground_segmentation: the range that all detectors have.

    Args:
        detectors: names of detectors.
        params: parameters of the detectors. Packaged weights see ahead with the range auto.

    Returns:
        ahead or around; all if a detector needs the whole cloud, has its own weights, or another
        range than the others.
    """
    ranges = set()
    for name in detectors:
        chosen = params.get(f"{name}.range", "auto")
        is_known = name in ("fused", "pointpillars") and not params.get(f"{name}.weights")
        ranges.add(("ahead" if chosen == "auto" else chosen) if is_known else "all")
    return ranges.pop() if len(ranges) == 1 else "all"


def find_trackers(detectors: Sequence[str]) -> dict[str, str]:
    """Return the detector of each tracker, by the name of the tracker."""
    return {f"{name}_{TRACKER}" if len(detectors) > 1 else TRACKER: name for name in detectors}


def _remap_tracker(detector: str, single: bool) -> dict[str, str]:
    detections = f"{find_result_node(detector, single)}/output/detections"
    return {"~/input/detections": detections, **CLOUDS, **ODOMETRY_INPUT}


def find_executable(node: str) -> str:
    """Return the executable of a node of a graph."""
    return TRACKER if node.endswith(f"_{TRACKER}") else node


def add_node_prefix(graph: Graph, prefix: str) -> dict[str, dict[str, str]]:
    """Return the graph with a prefix on the names of its nodes and of the topics between them."""

    def renamed(topic: str) -> str:
        return prefix + topic if topic.partition("/")[0] in graph else topic

    return {prefix + node: {a: renamed(b) for a, b in remap.items()} for node, remap in graph.items()}


STAGES, SINGLE = build_graph(["candidates"]), build_graph(["candidates"], single=True)
POINTPILLARS, POINTNET = build_graph(["pointpillars"]), build_graph(["pointnet"])


def find_result_node(detector: str, single: bool = False) -> str:
    """Return the node that publishes the detections of a detector."""
    (node,) = (SINGLE_PROCESS_NODES if single else DETECTOR_NODES)[detector]
    return node


def list_result_topics(single: bool = False, detector: str = "candidates") -> dict[str, str]:
    """Return the topic of detections by stage, without a namespace; networks have one stage."""
    node = find_result_node(detector, single)
    before = ("stage1", "stage2") if detector == "candidates" else ()
    return {**{stage: f"/{node}/debug/{stage}" for stage in before}, FINAL: f"/{node}/output/detections"}


def cloud_topic(single: bool = False, detector: str = "candidates") -> str:
    """Return the topic of the cloud that has all columns."""
    if not single:
        return "/clustering/output/points"
    if detector != "candidates":
        return POINTS
    return f"/{find_result_node(detector, single)}/output/points"


def list_stages(detectors: Sequence[str], single: bool = False) -> dict[str, str]:
    """Return the topic of detections of each stage of one detector, or of each of several."""
    if len(detectors) == 1:
        return list_result_topics(single, detectors[0])
    return {name: list_result_topics(single, name)[FINAL] for name in detectors}


def list_timing_topics(detectors: Sequence[str] = ("candidates",), single: bool = False) -> list[str]:
    """Return the topics with the times of the nodes, and of single steps of the candidates."""
    topics = [f"/{node}/debug/processing_time_ms" for node in build_graph(detectors, single)]
    if "candidates" in detectors:
        steps, last = (STEPS, "perception") if single else (STEPS[-3:], "candidate_refinement")
        topics += [f"/{last}/debug/{step}_ms" for step in steps]
    return topics


def configure_evaluator(
    file: Path | str, single: bool = False, detectors: Sequence[str] = ("candidates",)
) -> tuple[dict[str, str], dict[str, Any]]:
    """Return the remapping and the parameters of an evaluator of all stages.

    The candidates alone are scored as in the STM-CPA paper: pedestrians, and all labels. Networks
    see more than the labels, which are those of the camera image.
    """
    topics, only_candidates = list_stages(detectors, single), [*detectors] == ["candidates"]
    remap = (
        TRUTH_INPUT
        | ({} if only_candidates else CAMERA)
        | {f"~/input/{k}": relative_name(v) for k, v in topics.items()}
    )
    timing = [*map(relative_name, list_timing_topics(detectors, single))]
    return remap, {
        "stages": list(topics),
        "timing": timing,
        "file": str(file),
        **({"classes": [CLASSES[PEDESTRIAN]]} if only_candidates else {}),
    }


def runs_in_one_process(processes: str | bool | None) -> bool:
    """Return True if the nodes of a graph run in one process.

    One process takes less memory and CPU time, several use many cores better.

    Args:
        processes: one process for each node, "true" or "false"; "auto" or None: on a machine with
            more than MAX_CORES_FOR_ONE_PROCESS cores.
    """
    if processes in ("auto", None):
        return count_cores() <= MAX_CORES_FOR_ONE_PROCESS
    return processes in ("false", False)


def find_connected_outputs(graph: Graph) -> dict[str, set[str]]:
    """Return the topics of each node that another node of the graph subscribes to, without a
    namespace."""
    subscribed = {f"/{relative_name(topic)}" for remap in graph.values() for topic in remap.values()}
    return {node: {t for t in subscribed if t.startswith(f"/{node}/")} for node in graph}


def list_awaited_topics(
    detectors: Sequence[str] = ("candidates",), single: bool = False, points: int = 1, truth: int = 1
) -> list[str]:
    """Return the parameter wait_for of bag_player for a graph.

    It waits for subscribers of the clouds and of the labels, and for one subscriber of each result
    and of each topic between the nodes.

    Args:
        points: number of subscribers of the clouds.
        truth: number of subscribers of the labels, besides the seed input of the candidates.
    """
    between = sorted(set().union(*find_connected_outputs(build_graph(detectors, single)).values()))
    truth += "candidates" in detectors
    topics = [
        f"{POINTS}:={points}",
        f"{TRUTH}:={truth}",
        *between,
        *(topic for name in detectors for topic in list_result_topics(single, name).values()),
    ]
    return [*map(relative_name, topics)]


def choose_cloud_topic(bag: str, types: Mapping[str, str], wanted: str = "") -> str:
    """Return the cloud topic of a bag: the wanted one, or the only one if wanted is empty.

    Raises:
        InputError: there is no such topic, or there are several; the message lists them.
    """
    clouds = find_cloud_topics(types)
    if wanted in clouds or (not wanted and len(clouds) == 1):
        return wanted or clouds[0]
    if not clouds:
        raise InputError(
            f"{bag} has no clouds: none of its topics is a sensor_msgs/PointCloud2"
            f"{'; ' + problem if (problem := diagnose_packets(types)) else ''}"
        )
    has = f"it has {', '.join(clouds)}"
    raise InputError(
        f"{bag} has no cloud on {wanted}; {has}"
        if wanted
        else f"{bag}: give the topic of the clouds with points:=TOPIC; {has}"
    )


_domain_locks: list[Any] = []  # lock files of our domains, held open until this process ends


def reserve_domain() -> int:
    """Reserve an unused ROS domain from 1 to 100 on this machine, until this process ends.

    The ports of higher domains are ephemeral ports of other programs.

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
    """Context manager for node processes that log to a folder; it ends them with SIGINT."""

    def __init__(self, logs: Path, domain: int | None = None):
        self.logs = logs
        self.environment = dict(os.environ)
        if domain is not None:
            self.environment.update(ROS_DOMAIN_ID=str(domain), ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST")
        self.running: dict[str, Any] = {}  # Popen objects of the running processes
        self._gathered: list[list[str]] | None = None  # node arguments collected by together()

    def __enter__(self) -> Processes:
        self.logs.mkdir(parents=True, exist_ok=True)
        return self

    def start(self, node: str, remap: Mapping[str, str], params: Mapping[str, Any], namespace: str = "") -> None:
        """Start a node of a graph; with a namespace its key in `running` is NAMESPACE.NODE."""
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
        if self._gathered is None:
            self.run_node(name, arguments)
        else:
            self._gathered.append(arguments)

    @contextmanager
    def together(self, name: str) -> Iterator[None]:
        """Start the nodes for which start() is called inside in one process of this name."""
        parts: list[list[str]] = []
        self._gathered = parts
        yield
        self._gathered = None
        self.run_node(name, [word for part in parts for word in (SEPARATOR, *part)][1:])

    def run_node(self, name: str, arguments: Sequence[str]) -> None:
        """Start one of the executables of this package."""
        self.run(name, [sys.executable, "-m", "lidar_perception.nodes.main", *arguments])

    def run(self, name: str, command: Sequence[str]) -> None:
        """Start any program with its output in the log file."""
        with open(self.logs / f"{name}.log", "w") as log:
            self.running[name] = subprocess.Popen(
                command, env=self.environment, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT
            )

    def check(self, *finished: str) -> None:
        """Raise InputError with the last log line if a node that is not in `finished` has ended."""
        for node, process in self.running.items():
            code = process.poll()
            if code is not None and (node not in finished or code):
                lines = (self.logs / f"{node}.log").read_text().strip().splitlines() or ["no log"]
                raise InputError(f"{node} ended with code {code}: {lines[-1]} (log: {self.logs / node}.log)")

    def has_ended(self, node: str) -> bool:
        return self.running[node].poll() is not None

    def memory_mb(self) -> dict[str, float]:
        """Return the proportional set size of each running node in MB; empty without /proc."""
        sizes = {}
        for node, process in self.running.items():
            try:
                lines = Path(f"/proc/{process.pid}/smaps_rollup").read_text().splitlines()
                sizes[node] = next(int(x.split()[1]) for x in lines if x.startswith("Pss:")) / 1024
            except (OSError, StopIteration):
                continue
        return sizes

    def cpu_seconds(self) -> dict[str, float]:
        """Return the CPU time of each running process; empty without /proc."""
        seconds = {}
        for node, process in self.running.items():
            try:  # proc(5): fields 14 (utime) and 15 (stime); the text after the name starts with field 3
                fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
                seconds[node] = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
            except (OSError, IndexError):
                continue
        return seconds

    def stop(self, timeout: float = 5.0) -> dict[str, int]:
        """Send SIGINT to all processes, SIGKILL after timeout seconds; return the exit codes."""
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
