"""Replays a bag through the graph of nodes, each a process of its own; records what they find."""

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
    cloud_topic,
    evaluation,
    graph_of,
    outputs_in_use,
    private_domain,
    relative,
    result_topics,
    wait_for,
)
from lidar_perception.nodes.shared_memory import use_large_shared_memory
from lidar_perception.param_fields import flatten
from lidar_perception.runs.terminal import errors, make_progress
from lidar_perception.tracking.ego import recorded_source
from lidar_perception.types import InputError
from lidar_perception.wire.topics import CAMERA_INFO, EXTRINSICS, ODOMETRY, POINTS, TRUTH

TRACKS = f"/{TRACKER}/output/tracks"
START_TIMEOUT = 180.0   # seconds for all nodes to compile, come up and find each other
AHEAD = 2               # clouds at a time, so that one stage works while another does
SILENCE_TIMEOUT = 10.0  # seconds without a result after the last cloud


def replay(drive: Path, clouds: int, out: Path, params: Any, *, detector: str = "candidates",
           rate: float = 1.0, single: bool = False, real_time: bool = False) -> dict:
    """How the run of a detector of the graph, with its params, over a bag of `clouds` clouds went:
    results, latency_ms (from the cloud's arrival in this process to its detections'), memory_mb
    (proportional set size), slower (how many times slower than asked for it was), and poses:
    whence the tracker had them, as recorded_source says. With the candidates also the evaluator's
    scores.

    A cloud is sent when those before have their detections, so that none is lost on a slow
    machine; with real_time they come as from a sensor, whatever becomes of them.

    Leaves logs and the result bag in out. The nodes run on a private domain.
    """
    use_large_shared_memory()
    from lidar_perception.nodes.watch import Watch

    graph = graph_of([detector], single, tracking=True)
    stages = result_topics(single, detector)
    topics = {**stages, "tracks": TRACKS}
    domain = private_domain()
    with Bag(drive) as bag:
        poses = recorded_source(ODOMETRY in bag.topics)
    scores = out / "logs" / "scores.json"
    settings = {**flatten(params), **({} if real_time else {"input.queue": AHEAD})}
    nodes: dict[str, tuple[Mapping[str, str], dict[str, Any]]] = {
        node: (remap, settings) for node, remap in graph.items()}
    nodes[TRACKER] = graph[TRACKER], {
        "ego.source": "odometry" if poses == "recording" else poses,
        **({} if real_time else {"ego.max_wait": SILENCE_TIMEOUT})}
    if scored := detector == "candidates":
        nodes["evaluator"] = evaluation(scores.resolve(), single)
    recorded = [cloud_topic(single, detector), *topics.values(), TRUTH, CAMERA_INFO, EXTRINSICS]
    nodes["bag_recorder"] = {}, {"bag": str((out / "result").resolve()), "topics": recorded}
    with Processes(out / "logs", domain) as processes, Watch(domain, stages[FINAL]) as watch:
        for node, (remap, values) in nodes.items():
            processes.start(node, remap, values)
        outputs = outputs_in_use({node: remap for node, (remap, _) in nodes.items()})
        with errors.status("starting the nodes"):
            ready = watch.until(lambda: watch.connected(outputs), START_TIMEOUT, processes.check)
        if not ready:
            raise InputError(f"the nodes did not find each other in {START_TIMEOUT:.0f} s: "
                             f"{list(watch.diagnostics) or 'none'} reported; see {out}/logs")
        # The watch hears the clouds too, as the tracker and the recorder may, and the recorder
        # the labels.
        clouds_heard = 2 + (poses == "kiss_icp") + (POINTS in recorded)
        rules = wait_for(single, clouds_heard, 1 + 2 * scored, detector)
        rules += [f"{relative(stages[FINAL])}:={3 + scored}"]  # watch, recorder, tracker, evaluator
        rules += [relative(ODOMETRY)] if poses == "recording" else []
        processes.start("bag_player", {}, {"bag": str(drive.resolve()), "rate": rate,
                                           "wait_for": rules,
                                           "follow": [] if real_time else [stages[FINAL]],
                                           "ahead": AHEAD})
        with make_progress() as bar:
            task = bar.add_task("replaying", total=clouds)
            before = -1

            def finished() -> bool:
                bar.update(task, completed=watch.frames)
                return watch.frames >= clouds

            while not finished() and (watch.frames != before
                                      or not processes.ended("bag_player")):
                before = watch.frames
                watch.until(finished, SILENCE_TIMEOUT, lambda: processes.check("bag_player"))
        # These are behind the results by as much as their own work takes.
        def caught_up(node: str) -> bool:
            return int(watch.value_of(node, "frames") or 0) >= watch.frames

        for node in {"evaluator", TRACKER} & nodes.keys():
            watch.until(partial(caught_up, node), SILENCE_TIMEOUT)
        memory = processes.memory_mb()
        codes = processes.stop(timeout=30)
    if failed := {node: code for node, code in codes.items() if code}:
        errors.print(Text(f"exit codes {failed}", "red") + f"; see {out}/logs")
    if watch.frames == 0:
        raise InputError(f"no cloud of {drive} gave a result; see {out}/logs")
    latencies = sorted(watch.latencies_ms) or [0.0]
    return {**(json.loads(scores.read_text()) if scored else {}),
            "clouds": clouds, "results": watch.frames,
            "latency_ms": {"median": median(latencies),
                           "p95": latencies[int(0.95 * (len(latencies) - 1))]},
            "slower": float(watch.value_of("bag_player", "slower") or 1.0),
            "memory_mb": sum(memory.values()), "memory_mb_by_node": memory, "poses": poses}
