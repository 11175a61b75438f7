"""Replay of a bag through a graph of nodes, with a recording of their results."""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

from rich.text import Text

from lidar_perception.data.bag import Bag
from lidar_perception.nodes.graph import (
    FINAL,
    TRACKER,
    Processes,
    build_graph,
    cloud_topic,
    configure_evaluator,
    find_connected_outputs,
    list_awaited_topics,
    list_result_topics,
    relative_name,
    reserve_domain,
)
from lidar_perception.nodes.shared_memory import use_large_shared_memory
from lidar_perception.param_fields import flatten
from lidar_perception.runs.terminal import errors, make_progress
from lidar_perception.tracking.ego import choose_recorded_source
from lidar_perception.types import InputError
from lidar_perception.wire.topics import CAMERA_INFO, EXTRINSICS, ODOMETRY, POINTS, TRUTH

TRACKS = f"/{TRACKER}/output/tracks"
START_TIMEOUT_S = 180.0   # for all nodes to compile, start and find each other
AHEAD = 2                 # clouds in flight, so that stages can work in parallel
SILENCE_TIMEOUT_S = 10.0  # without a result after the last cloud


def replay(drive: Path, clouds: int, out: Path, params: Any, *, detector: str = "candidates",
           rate: float = 1.0, single: bool = False, real_time: bool = False) -> dict:
    """Replay a bag through the graph of a detector and record the results.

    The nodes run on a private ROS domain. Logs and the result bag are left in `out`.

    Args:
        drive: the bag.
        clouds: number of clouds in the bag.
        out: folder for the results.
        params: parameters of the detector, a dataclass.
        detector: name of the detector, see graph.DETECTOR_NODES.
        rate: speed of the replay, 1.0 for real time.
        single: run the detector in one process.
        real_time: send clouds at the rate of the sensor. Otherwise a cloud is sent once the clouds
            before it have detections, so that none is lost on a slow machine.

    Returns:
        clouds, results (number of frames), latency_ms (median and p95 from the arrival of a cloud
        in this process to its detections), memory_mb (proportional set size), memory_mb_by_node,
        slower (slowdown of the replay against `rate`), poses (their source for the tracker, see
        choose_recorded_source), and for candidates the scores of the evaluator.

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
        node: (remap, settings) for node, remap in graph.items()}
    nodes[TRACKER] = graph[TRACKER], {
        "ego.source": "odometry" if poses == "recording" else poses,
        **({} if real_time else {"ego.max_wait": SILENCE_TIMEOUT_S})}
    if scored := detector == "candidates":
        nodes["evaluator"] = configure_evaluator(scores.resolve(), single)
    recorded = [cloud_topic(single, detector), *topics.values(), TRUTH, CAMERA_INFO, EXTRINSICS]
    nodes["bag_recorder"] = {}, {"bag": str((out / "result").resolve()), "topics": recorded}
    with (Processes(out / "logs", domain) as processes,
          GraphMonitor(domain, stages[FINAL]) as monitor):
        for node, (remap, values) in nodes.items():
            processes.start(node, remap, values)
        outputs = find_connected_outputs({node: remap for node, (remap, _) in nodes.items()})
        with errors.status("starting the nodes"):
            ready = monitor.spin_until(lambda: monitor.is_connected(outputs), START_TIMEOUT_S,
                                       processes.check)
        if not ready:
            raise InputError(f"the nodes did not find each other in {START_TIMEOUT_S:.0f} s: "
                             f"{list(monitor.diagnostics) or 'none'} reported; see {out}/logs")
        # Besides the graph, the monitor subscribes to the clouds, and the tracker and the recorder
        # may; the recorder also subscribes to the labels.
        cloud_subscribers = 2 + (poses == "kiss_icp") + (POINTS in recorded)
        rules = list_awaited_topics(single, cloud_subscribers, 1 + 2 * scored, detector)
        # The detections have four subscribers: monitor, recorder, tracker, evaluator.
        rules += [f"{relative_name(stages[FINAL])}:={3 + scored}"]
        rules += [relative_name(ODOMETRY)] if poses == "recording" else []
        processes.start("bag_player", {}, {"bag": str(drive.resolve()), "rate": rate,
                                           "wait_for": rules,
                                           "follow": [] if real_time else [stages[FINAL]],
                                           "ahead": AHEAD})
        with make_progress() as bar:
            task = bar.add_task("replaying", total=clouds)
            before = -1

            def finished() -> bool:
                bar.update(task, completed=monitor.frames)
                return monitor.frames >= clouds

            while not finished() and (monitor.frames != before
                                      or not processes.has_ended("bag_player")):
                before = monitor.frames
                monitor.spin_until(finished, SILENCE_TIMEOUT_S,
                                   lambda: processes.check("bag_player"))
        # Both lag behind the results by their own processing time.
        def caught_up(node: str) -> bool:
            return int(monitor.get_value(node, "frames") or 0) >= monitor.frames

        for node in {"evaluator", TRACKER} & nodes.keys():
            monitor.spin_until(partial(caught_up, node), SILENCE_TIMEOUT_S)
        memory = processes.memory_mb()
        codes = processes.stop(timeout=30)
    if failed := {node: code for node, code in codes.items() if code}:
        errors.print(Text(f"exit codes {failed}", "red") + f"; see {out}/logs")
    if monitor.frames == 0:
        raise InputError(f"no cloud of {drive} gave a result; see {out}/logs")
    latencies = sorted(monitor.latencies_ms) or [0.0]
    return {**(json.loads(scores.read_text()) if scored else {}),
            "clouds": clouds, "results": monitor.frames,
            "latency_ms": {"median": median(latencies),
                           "p95": latencies[int(0.95 * (len(latencies) - 1))]},
            "slower": float(monitor.get_value("bag_player", "slower") or 1.0),
            "memory_mb": sum(memory.values()), "memory_mb_by_node": memory, "poses": poses}
