"""Replays a bag through the graph of nodes, each a process of its own, and scores the result."""

from __future__ import annotations

import json
from pathlib import Path
from statistics import median

from lidar_perception.candidates.params import PipelineParams
from lidar_perception.data.bag import Bag
from lidar_perception.nodes.graph import (
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
from lidar_perception.nodes.main import use_large_shared_memory
from lidar_perception.param_fields import flatten
from lidar_perception.runs.terminal import errors, progress
from lidar_perception.tracking.ego import has_odometry
from lidar_perception.types import InputError
from lidar_perception.wire.topics import CAMERA_INFO, EXTRINSICS, ODOMETRY, TRUTH

TRACKS = f"/{TRACKER}/output/tracks"
START_TIMEOUT = 180.0   # seconds for all nodes to compile, come up and find each other
AHEAD = 2               # clouds at a time, so that one stage works while another does
SILENCE_TIMEOUT = 10.0  # seconds without a result after the last cloud


def replay(drive: Path, clouds: int, out: Path, params: PipelineParams, *, rate: float = 1.0,
           single: bool = False, record: bool = True, real_time: bool = False) -> dict:
    """Scores of a bag with `clouds` clouds, and how the run went: results, latency_ms (from the
    cloud's arrival in this process to its candidates'), memory_mb (proportional set size), slower
    (how many times slower than asked for it was), and poses: whence the tracker had them, the
    bag's odometry, KISS-ICP where there is none, or None where that is not installed either.

    A cloud is sent when those before have their candidates, so that none is lost on a slow
    machine; with real_time they come as from a sensor, whatever becomes of them.

    Leaves logs and, with record, the result bag in out. The nodes run on a private domain.
    """
    use_large_shared_memory()
    from lidar_perception.nodes.watch import Watch

    graph = graph_of(["candidates"], single, tracking=True)
    topics = {**result_topics(single), "tracks": TRACKS}
    domain = private_domain()
    scores = out / "logs" / "scores.json"
    evaluator_remap, evaluator_params = evaluation(scores.resolve(), single)
    recorded = [cloud_topic(single), *topics.values(), TRUTH, CAMERA_INFO, EXTRINSICS]
    with Bag(drive) as bag:
        poses = "odometry" if ODOMETRY in bag.topics else "kiss_icp" if has_odometry() else None
    tracker = {"ego.source": poses or "none",
               **({} if real_time else {"ego.max_wait": SILENCE_TIMEOUT})}
    with Processes(out / "logs", domain) as processes, Watch(domain, topics["final"]) as watch:
        for node, remap in graph.items():
            processes.start(node, remap, tracker if node == TRACKER else
                            {**flatten(params), "input.queue": AHEAD})
        processes.start("evaluator", evaluator_remap, evaluator_params)
        if record:
            processes.start("bag_recorder", {}, {"bag": str((out / "result").resolve()),
                                                 "topics": recorded})
        others: dict[str, set[str]] = {"bag_recorder": set()} if record else {}
        outputs = outputs_in_use({**graph, "evaluator": evaluator_remap})
        with errors.status("starting the nodes"):
            ready = watch.until(lambda: watch.connected(outputs | others),
                                START_TIMEOUT, processes.check)
        if not ready:
            raise InputError(f"the nodes did not find each other in {START_TIMEOUT:.0f} s: "
                             f"{list(watch.diagnostics) or 'none'} reported; see {out}/logs")
        # The watch hears the clouds too, as the tracker may, and the recorder the labels.
        rules = wait_for(single, points=2 + (poses == "kiss_icp"), truth=2 + record)
        rules += [f"{relative(topics['final'])}:={3 + record}"]  # watch, evaluator, tracker
        rules += [relative(ODOMETRY)] if poses == "odometry" else []
        processes.start("bag_player", {}, {"bag": str(drive.resolve()), "rate": rate,
                                           "wait_for": rules,
                                           "follow": [] if real_time else [topics["final"]],
                                           "ahead": AHEAD})
        with progress() as bar:
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
        for node in ("evaluator", TRACKER):
            watch.until(lambda n=node: int(watch.value_of(n, "frames") or 0) >= watch.frames,
                        SILENCE_TIMEOUT)
        memory = processes.memory_mb()
        codes = processes.stop(timeout=30)
    if failed := {node: code for node, code in codes.items() if code}:
        errors.print(f"[red]exit codes {failed}[/]; see {out}/logs")
    if watch.frames == 0:
        raise InputError(f"no cloud of {drive} gave a result; see {out}/logs")
    latencies = sorted(watch.latencies_ms) or [0.0]
    return {**json.loads(scores.read_text()), "clouds": clouds, "results": watch.frames,
            "latency_ms": {"median": median(latencies),
                           "p95": latencies[int(0.95 * (len(latencies) - 1))]},
            "slower": float(watch.value_of("bag_player", "slower") or 1.0),
            "memory_mb": sum(memory.values()), "memory_mb_by_node": memory, "poses": poses}
