"""Replay of a bag through a graph of nodes, with a recording of their results."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from time import process_time
from typing import Any

from rich.text import Text

from lidar_perception.data.bag import Bag
from lidar_perception.nodes.graph import (
    FINAL_STAGE,
    TRACKER,
    Processes,
    build_graph,
    configure_evaluator,
    find_connected_outputs,
    find_expert_params,
    find_result_cloud_topic,
    list_awaited_topics,
    list_result_topics,
    make_relative,
    reserve_domain,
    runs_in_one_process,
)
from lidar_perception.nodes.shared_memory import use_large_shared_memory
from lidar_perception.param_fields import flatten
from lidar_perception.runs.terminal import errors, make_progress
from lidar_perception.tracking.ego import choose_recorded_source
from lidar_perception.types import InputError
from lidar_perception.wire.topics import CAMERA_INFO, EXTRINSICS, ODOMETRY, POINTS, TRUTH

GRAPH = "graph"  # name of the process that runs the nodes of a graph
TRACKS = f"/{TRACKER}/output/tracks"
START_TIMEOUT_S = 180.0  # time for all nodes to compile, start and discover each other
AHEAD = 2  # number of clouds in flight; two keep several stages busy
SILENCE_TIMEOUT_S = 10.0  # the replay ends if no result arrives for this long after the last cloud


def replay(
    drive: Path,
    clouds: int,
    out: Path,
    params: Any,
    *,
    detector: str = "candidates",
    rate: float = 1.0,
    single: bool = False,
    real_time: bool = False,
    processes: bool | None = None,
) -> dict:
    """Replay a bag through the graph of a detector and record the results.

    The nodes run on a private ROS domain. Logs and the result bag are left in `out`.

    Args:
        drive: the bag.
        clouds: number of clouds in the bag.
        out: folder for the results.
        params: parameters of the detector, a dataclass.
        detector: name of the detector, see graph.DETECTOR_NODES.
        rate: speed of the replay, 1.0 for real time.
        single: run the detector in one node that also computes ground and clusters.
        real_time: send clouds at the rate of the sensor. Otherwise a cloud is sent once the previous
            clouds have detections, so that none is lost on a slow machine.
        processes: True: start one process per node; False: start one process for all nodes of the
            graph; None: see runs_in_one_process().

    Returns:
        clouds, results (number of frames), latency_ms (median and p95 from sending a cloud to
        receiving its tracks in the player), memory_mb (proportional set size),
        memory_mb_by_process, cpu_ms_by_process (CPU time per cloud), stage_ms (median time of each
        node per cloud), one_process, slower (duration of the replay divided by its duration at
        `rate`), poses (source of the tracker's poses, see choose_recorded_source), and for
        candidates the scores of the evaluator.

    Raises:
        InputError: the nodes do not connect, or there is no result.
    """
    use_large_shared_memory()
    from lidar_perception.nodes.external_node import GraphMonitor

    graph = build_graph([detector], single, tracking=True)
    stages = list_result_topics(single, detector)
    topics = {**stages, "tracks": TRACKS}
    domain = reserve_domain()
    with Bag(drive) as bag:
        poses = choose_recorded_source(ODOMETRY in bag.topics)
    scores = out / "logs" / "scores.json"
    settings = {**flatten(params), **({} if real_time else {"input.queue": AHEAD})}
    nodes: dict[str, tuple[Mapping[str, str], dict[str, Any]]] = {
        node: (remap, settings) for node, remap in graph.items()
    }
    if "ground_segmentation" in graph:
        nodes["ground_segmentation"] = (
            graph["ground_segmentation"],
            settings | find_expert_params([detector], settings),
        )
    nodes[TRACKER] = (
        graph[TRACKER],
        {
            "ego.source": "odometry" if poses == "recording" else poses,
            **({} if real_time else {"ego.max_wait": SILENCE_TIMEOUT_S}),
        },
    )
    if has_scores := detector == "candidates":
        nodes["evaluator"] = configure_evaluator(scores.resolve(), single)
    recorded_topics = [find_result_cloud_topic(single, detector), *topics.values(), TRUTH, CAMERA_INFO, EXTRINSICS]
    nodes["bag_recorder"] = {}, {"bag": str((out / "result").resolve()), "topics": recorded_topics}
    one_process = runs_in_one_process(processes)
    with Processes(out / "logs", domain) as node_processes, GraphMonitor(domain, stages[FINAL_STAGE]) as monitor:
        with node_processes.share_process(GRAPH) if one_process else nullcontext():
            for node in (*graph, "bag_recorder"):
                node_processes.start(node, *nodes[node])
        if has_scores:
            node_processes.start("evaluator", *nodes["evaluator"])
        outputs = find_connected_outputs({node: remap for node, (remap, _) in nodes.items()})
        with errors.status("starting the nodes"):
            is_ready = monitor.spin_until(lambda: monitor.is_connected(outputs), START_TIMEOUT_S, node_processes.check)
        if not is_ready:
            raise InputError(
                f"the nodes have not connected within {START_TIMEOUT_S:.0f} s (started: "
                f"{', '.join(monitor.diagnostics) or 'none'}); see {out}/logs"
            )
        # Besides the graph, the tracker and the recorder may subscribe to the clouds; the recorder
        # also subscribes to the labels.
        cloud_subscribers = 1 + (poses == "kiss_icp") + (POINTS in recorded_topics)
        rules = list_awaited_topics([detector], single, cloud_subscribers, 1 + has_scores)
        # The detections have four subscribers: monitor, recorder, tracker, evaluator.
        rules += [f"{make_relative(stages[FINAL_STAGE])}:={3 + has_scores}"]
        rules += [make_relative(ODOMETRY)] if poses == "recording" else []
        first, last = CpuTimes(), CpuTimes()  # CPU times at the first and the last result
        node_processes.start(
            "bag_player",
            {},
            {
                "bag": str(drive.resolve()),
                "rate": rate,
                "wait_for": rules,
                "follow": [TRACKS],
                "ahead": 0 if real_time else AHEAD,
            },
        )
        memory: dict[str, float] = {}
        with make_progress() as bar:
            task = bar.add_task("replaying", total=clouds)
            previous_frames = -1

            def is_finished() -> bool:
                bar.update(task, completed=monitor.frames)
                if monitor.frames > last.frames:
                    last.read(monitor.frames, node_processes)
                    if not first.frames:
                        first.read(monitor.frames, node_processes)
                if 2 * monitor.frames > clouds and not memory:
                    memory.update(node_processes.measure_memory_mb())
                return monitor.frames >= clouds

            while not is_finished() and (
                monitor.frames != previous_frames or not node_processes.has_ended("bag_player")
            ):
                previous_frames = monitor.frames
                monitor.spin_until(is_finished, SILENCE_TIMEOUT_S, lambda: node_processes.check("bag_player"))

        # The tracker and the evaluator lag behind the detections by their own processing time.
        def has_caught_up(node: str) -> bool:
            return int(monitor.get_value(node, "frames") or 0) >= monitor.frames

        for node in {"evaluator", TRACKER} & nodes.keys():
            monitor.spin_until(partial(has_caught_up, node), SILENCE_TIMEOUT_S)
        memory = memory or node_processes.measure_memory_mb()  # most clouds may have been dropped
        stage_ms = {node: float(ms) for node in graph if (ms := monitor.get_value(node, "processing_ms_median"))}
        codes = node_processes.stop(timeout=30)
    if failures := [f"{node} (exit code {code})" for node, code in codes.items() if code]:
        errors.print(Text(f"nodes failed: {', '.join(failures)}", "red") + f"; see {out}/logs")
    if monitor.frames == 0:
        raise InputError(f"{drive}: no cloud produced a result; see {out}/logs")
    return {
        **(json.loads(scores.read_text()) if has_scores else {}),
        "clouds": clouds,
        "results": monitor.frames,
        "latency_ms": {
            name: float(monitor.get_value("bag_player", f"latency_ms_{name}") or 0.0) for name in ("median", "p95")
        },
        "cpu_ms_by_process": last.compute_ms_per_frame(first),
        "stage_ms": stage_ms,
        "one_process": one_process,
        "slower": float(monitor.get_value("bag_player", "slower") or 1.0),
        "memory_mb": sum(memory.values()),
        "memory_mb_by_process": memory,
        "poses": poses,
    }


class CpuTimes:
    """CPU times of the processes of a replay, and of this process as "watch"."""

    def __init__(self) -> None:
        self.frames, self.seconds = 0, dict[str, float]()

    def read(self, frames: int, processes: Processes) -> None:
        """Read the times when `frames` results have arrived; processes that have ended keep theirs."""
        self.frames = frames
        self.seconds.update(processes.measure_cpu_seconds(), watch=process_time())

    def compute_ms_per_frame(self, earlier: CpuTimes) -> dict[str, float]:
        """Return {process: CPU time per result since an earlier reading, in ms}."""
        frames = max(self.frames - earlier.frames, 1)
        return {
            name: 1e3 * (seconds - earlier.seconds.get(name, 0.0)) / frames for name, seconds in self.seconds.items()
        }
