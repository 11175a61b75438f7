"""The graph of nodes: who listens to whom. Launch files and the demo start it from here."""

from __future__ import annotations

import fcntl
import os
import random
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from time import monotonic
from typing import Any

import yaml

from lidar_perception.candidates.params import STEPS
from lidar_perception.types import InputError
from lidar_perception.wire.clouds import diagnose_packets, find_cloud_topics
from lidar_perception.wire.topics import CAMERA_INFO, EXTRINSICS, ODOMETRY, POINTS, TRUTH

Graph = Mapping[str, Mapping[str, str]]  # node -> remapping of its topics


def relative(topic: str) -> str:
    """A name that goes along when its node is put into a namespace."""
    return topic.lstrip("/")


CAMERA = {"~/input/camera_info": relative(CAMERA_INFO), "~/input/extrinsics": relative(EXTRINSICS)}
TRUTH_IN = {"~/input/ground_truth": relative(TRUTH)}
CLOUDS = {"~/input/points": relative(POINTS)}
ODOMETRY_IN = {"~/input/odometry": relative(ODOMETRY)}
TRACKER = "tracker"
FINAL = "final"  # the last stage of a detector, whose boxes are its detections
CLUSTERED = {"~/input/points": "clustering/output/points"}

# Ground and clusters, once for all detectors ...
EXPERTS = {
    "ground_segmentation": {**CLOUDS, **CAMERA},
    "clustering": {"~/input/points": "ground_segmentation/output/points"},
}
# ... and those behind them: one process a stage, or alone, as each finds both itself.
BEHIND = {
    "candidates": {"candidate_refinement": {**CLUSTERED, **TRUTH_IN}},
    "pointpillars": {"pointpillars_detector": CLUSTERED},
    "pointnet": {"pointnet_detector": CLUSTERED},
    "fused": {"fused_detector": CLUSTERED},
}
ALONE = {
    "candidates": {"perception": {**CLOUDS, **TRUTH_IN, **CAMERA}},
    "pointpillars": {"pointpillars_detector": CLOUDS},
    "pointnet": {"pointnet_detector": CLOUDS},
    "fused": {"fused_detector": CLOUDS},
}


# The detectors with a network, whose names are those of their groups of parameters.
NETWORKS = tuple(name for name, nodes in ALONE.items() if f"{name}_detector" in nodes)


def graph_of(detectors: Sequence[str], single: bool = False,
             tracking: bool = False) -> dict[str, Mapping[str, str]]:
    """The nodes of one or several detectors, each started once; with tracking a tracker behind each
    detector. InputError for an unknown one."""
    for name in detectors:
        if name not in BEHIND:
            raise InputError(f"detectors: '{name}' is none of {', '.join(BEHIND)}")
    parts = [(ALONE if single else BEHIND)[name] for name in detectors]
    if tracking:
        parts += [{tracker: _tracker_of(name, single)}
                  for tracker, name in trackers_of(detectors).items()]
    return {k: v for part in ([] if single else [EXPERTS]) + parts for k, v in part.items()}


def trackers_of(detectors: Sequence[str]) -> dict[str, str]:
    """Name of each tracker -> its detector."""
    return {f"{name}_{TRACKER}" if len(detectors) > 1 else TRACKER: name for name in detectors}


def _tracker_of(detector: str, single: bool) -> dict[str, str]:
    found = f"{last_node(detector, single)}/output/detections"
    return {"~/input/detections": found, **CLOUDS, **ODOMETRY_IN}


def executable_of(node: str) -> str:
    """What is started under the name of a node of a graph."""
    return TRACKER if node.endswith(f"_{TRACKER}") else node


def prefixed(graph: Graph, prefix: str) -> dict[str, dict[str, str]]:
    """The same graph with prefix before the names of its nodes, and of the topics between them."""
    def renamed(topic: str) -> str:
        return prefix + topic if topic.partition("/")[0] in graph else topic
    return {prefix + node: {a: renamed(b) for a, b in remap.items()}
            for node, remap in graph.items()}


STAGES, SINGLE = graph_of(["candidates"]), graph_of(["candidates"], single=True)
POINTPILLARS, POINTNET = graph_of(["pointpillars"]), graph_of(["pointnet"])


def last_node(detector: str, single: bool = False) -> str:
    """The node that publishes what a detector finds."""
    node, = (ALONE if single else BEHIND)[detector]
    return node


def result_topics(single: bool = False, detector: str = "candidates") -> dict[str, str]:
    """Stage -> topic of its detections, without a namespace; the networks have one stage."""
    node = last_node(detector, single)
    before = ("stage1", "stage2") if detector == "candidates" else ()
    return {**{stage: f"/{node}/debug/{stage}" for stage in before},
            FINAL: f"/{node}/output/detections"}


def cloud_topic(single: bool = False, detector: str = "candidates") -> str:
    """The cloud with all columns that there are."""
    if not single:
        return "/clustering/output/points"
    return f"/{last_node(detector, True)}/output/points" if detector == "candidates" else POINTS


def timing_topics(single: bool = False) -> list[str]:
    """Times of the nodes, and of the steps that they take apart."""
    steps, last = (STEPS, "perception") if single else (STEPS[-3:], "candidate_refinement")
    return [*(f"/{node}/debug/processing_time_ms" for node in (SINGLE if single else STAGES)),
            *(f"/{last}/debug/{step}_ms" for step in steps)]


def evaluation(file: Path | str, single: bool = False) -> tuple[dict[str, str], dict[str, Any]]:
    """Remapping and parameters of an evaluator of all stages."""
    topics = result_topics(single)
    remap = TRUTH_IN | {f"~/input/{k}": relative(v) for k, v in topics.items()}
    return remap, {"stages": list(topics), "timing": [*map(relative, timing_topics(single))],
                   "file": str(file)}


def outputs_in_use(graph: Graph) -> dict[str, set[str]]:
    """Node -> those of its topics that another node of the graph listens to, without a
    namespace."""
    heard = {f"/{relative(topic)}" for remap in graph.values() for topic in remap.values()}
    return {node: {t for t in heard if t.startswith(f"/{node}/")} for node in graph}


def wait_for(single: bool = False, points: int = 1, truth: int = 2,
             detector: str = "candidates") -> list[str]:
    """bag_player's wait_for: subscribers of the clouds, of the labels (the seed input and an
    evaluator), and one of each topic between the nodes and of each result."""
    between = sorted(set().union(*outputs_in_use(graph_of([detector], single)).values()))
    topics = [f"{POINTS}:={points}", f"{TRUTH}:={truth}", *between,
              *result_topics(single, detector).values()]
    return [*map(relative, topics)]


def chosen_clouds(bag: str, types: Mapping[str, str], wanted: str = "") -> str:
    """The topic of a bag with clouds: the wanted one, or with '' the only one. InputError names
    those that there are."""
    clouds = find_cloud_topics(types)
    if wanted in clouds or (not wanted and len(clouds) == 1):
        return wanted or clouds[0]
    if not clouds:
        raise InputError(f"{bag} has no clouds: none of its topics is a sensor_msgs/PointCloud2"
                         f"{'; ' + problem if (problem := diagnose_packets(types)) else ''}")
    has = f"it has {', '.join(clouds)}"
    raise InputError(f"{bag} has no cloud on {wanted}; {has}" if wanted else
                     f"{bag}: give the topic of the clouds with points:=TOPIC; {has}")


_taken: list[Any] = []  # locks on the files of our domains, until this process ends


def private_domain() -> int:
    """A ROS domain that nobody on this machine uses: 1..100, as the ports of higher ones are also
    handed out to other programs. It stays this process's own while none of its nodes runs."""
    for domain in random.SystemRandom().sample(range(1, 101), 100):
        name = f"lidar_perception-{os.getuid()}-domain-{domain}.lock"
        lock = open(Path(tempfile.gettempdir()) / name, "w")
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                # Where the domain's first participant listens (RTPS 2.5, Section 9.6.2.3).
                probe.bind(("", 7410 + 250 * domain))
            except OSError:
                lock.close()
                continue
        _taken.append(lock)
        return domain
    raise InputError("all ROS domains 1..100 are in use on this machine")


class Processes:
    """Node processes with logs in a folder; a context manager that ends them with SIGINT."""

    def __init__(self, logs: Path, domain: int | None = None):
        self.logs = logs
        self.environment = dict(os.environ)
        if domain is not None:
            self.environment.update(ROS_DOMAIN_ID=str(domain),
                                    ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST")
        self.running: dict[str, Any] = {}  # as subprocess.Popen

    def __enter__(self) -> Processes:
        self.logs.mkdir(parents=True, exist_ok=True)
        return self

    def start(self, node: str, remap: Mapping[str, str], params: Mapping[str, Any],
              namespace: str = "") -> None:
        """Start a node of a graph; in a namespace it is called NAMESPACE.NODE here."""
        values = {k: list(v) if isinstance(v, tuple) else v for k, v in params.items()}
        values = {k: v for k, v in values.items() if v != []}  # an empty list has no type in YAML
        name = f"{namespace}.{node}" if namespace else node
        file = self.logs / f"{name}.param.yaml"
        file.write_text(yaml.safe_dump({"/**": {"ros__parameters": values}}))
        rules = {**remap, **({"__ns": f"/{namespace}"} if namespace else {}),
                 **({"__node": node} if executable_of(node) != node else {})}
        remapping = [word for rule in rules.items() for word in ("-r", ":=".join(rule))]
        self.run_node(name, [executable_of(node), "--ros-args", "--params-file", str(file),
                             *remapping])

    def run_node(self, name: str, arguments: Sequence[str]) -> None:
        """Start one of our executables."""
        self.run(name, [sys.executable, "-m", "lidar_perception.nodes.main", *arguments])

    def run(self, name: str, command: Sequence[str]) -> None:
        """Start any program; what it writes goes to the log."""
        with open(self.logs / f"{name}.log", "w") as log:
            self.running[name] = subprocess.Popen(
                command, env=self.environment, stdin=subprocess.DEVNULL, stdout=log,
                stderr=subprocess.STDOUT)

    def check(self, *finished: str) -> None:
        """InputError with the last line of its log, if a node other than `finished` has ended."""
        for node, process in self.running.items():
            code = process.poll()
            if code is not None and (node not in finished or code):
                lines = (self.logs / f"{node}.log").read_text().strip().splitlines() or ["no log"]
                raise InputError(f"{node} ended with code {code}: {lines[-1]} "
                                 f"(log: {self.logs / node}.log)")

    def ended(self, node: str) -> bool:
        return self.running[node].poll() is not None

    def memory_mb(self) -> dict[str, float]:
        """Proportional set size of each running node, in megabytes; empty where /proc is not."""
        sizes = {}
        for node, process in self.running.items():
            try:
                lines = Path(f"/proc/{process.pid}/smaps_rollup").read_text().splitlines()
                sizes[node] = next(int(x.split()[1]) for x in lines if x.startswith("Pss:")) / 1024
            except (OSError, StopIteration):
                continue
        return sizes

    def stop(self, timeout: float = 5.0) -> dict[str, int]:
        """SIGINT to all, SIGKILL after timeout seconds; returns the exit codes."""
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
