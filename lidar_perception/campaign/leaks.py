"""The same frames again and again through every node and every detector: memory must not grow."""

from __future__ import annotations

import gc
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np

from lidar_perception.campaign.case import FAILED, SKIPPED, SURVIVED, Case, Outcome
from lidar_perception.campaign.good import CLOUD, STAMP, cloud, good, markers, street
from lidar_perception.campaign.messages import TRIED, Tried
from lidar_perception.campaign.shapes import NETWORKS, work_of
from lidar_perception.campaign.worker import memory_mb
from lidar_perception.nodes.graph import private_domain
from lidar_perception.nodes.runtime import MARKERS
from lidar_perception.nodes.watch import leave, new_context
from lidar_perception.types import LidarFrame
from lidar_perception.wire.codec import encode

FRAMES = 3000
SECONDS = 900.0      # of one case, however few frames that are
SETTLED = 0.3        # of the frames: from here on memory must be flat
LEAST = 100          # frames; fewer say nothing
GROWTH_MB = 20.0
PERIOD = 100_000_000  # ns
CASES = [*((f"node {node}", variant) for node, (_, _, variants) in TRIED.items()
           for variant in range(len(variants))),
         *((stage, 0) for stage in (
             "pipeline paper, threshold, dbscan", "pipeline best, cloth, euclidean local",
             "pipeline best, patchwork, dbscan joined", *NETWORKS))]


def case_of(seed: int, number: int) -> Case | None:
    """Each node in each of its settings, then each detector."""
    if number >= len(CASES):
        return None
    what, variant = CASES[number]
    return Case("leaks", f"{what}, {variant}", seed, number, {"what": what, "variant": variant})


class Attempt:
    """Each case makes its own node or detector; what it leaves behind counts for the next."""

    def __init__(self, folder: Path):
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"

    def __call__(self, case: Case) -> Outcome:
        kind, _, name = case.settings["what"].partition(" ")
        if kind == "node":
            context = new_context(private_domain())
            tried = Tried(name, context)
            tried.set(TRIED[name][2][case.settings["variant"]])
            try:
                return _repeated(case.name, partial(_frame_of_node, tried))
            finally:
                leave(context, tried.node)
        work = work_of(case.settings["what"])
        frames = [LidarFrame.of(street(i), np.full(len(street(i)), 0.3, np.float32))
                  for i in range(20)]
        return _repeated(case.name, lambda i: work(frames[i % len(frames)]))


def _frame_of_node(tried: Tried, number: int) -> None:
    """Every input gets its message, with the stamp of a sensor at 10 Hz."""
    stamp = STAMP + number * PERIOD
    for topic, kind in reversed(tried.inputs.items()):  # the cloud last, which is the first
        data = (encode(cloud("columns", stamp)) if kind == CLOUD else
                markers(topic == "input/ground_truth", stamp) if kind == MARKERS else good(kind))
        tried.deliver(topic, data)


def _repeated(what: str, work: Callable[[int], Any]) -> Outcome:
    end, settled, number = monotonic() + SECONDS, 0.0, 0
    started = monotonic()
    while number < FRAMES and monotonic() < end:
        work(number)
        number += 1
        share = max(number / FRAMES, (monotonic() - started) / SECONDS)
        if not settled and share >= SETTLED:
            gc.collect()
            settled = memory_mb("VmRSS")
    if number < LEAST:
        return Outcome(SKIPPED, f"{what}: {number} frames in {SECONDS:g} s are too few to tell")
    gc.collect()
    growth = memory_mb("VmRSS") - settled
    if growth > GROWTH_MB:
        return Outcome(FAILED, f"{what}: {growth:.0f} MB more after {number} frames than after "
                       f"{SETTLED:.0%} of them")
    return Outcome(SURVIVED, what, {"frames": number, "growth_mb": round(growth, 1)})
