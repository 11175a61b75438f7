"""Clouds that are made to be hard: how time and memory of every stage grow with their points.

Each case runs one stage on one arrangement at two sizes. CPU time and memory may grow as n log n,
with a factor for caches and a busy machine that still tells it from n^2; what takes less than a
second at the larger size is fast enough. The local threshold of euclidean clustering is exact up to
a fixed number of distances (clustering/euclidean.py), so where it is used more seconds are allowed
before growth counts. Clouds of two million points need only come to an end.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from math import log
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
from numpy.random import Generator as Rng

from lidar_perception.campaign.case import FAILED, SURVIVED, Case, Outcome, generator
from lidar_perception.campaign.worker import memory_mb
from lidar_perception.candidates.configurations import BEST, CONFIGURATIONS
from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.pipeline import find_candidates
from lidar_perception.candidates.seed_sources import fixed_seed
from lidar_perception.candidates.seeds import load_seed
from lidar_perception.candidates.segmented import grounded_boxes
from lidar_perception.clustering.cluster import cluster
from lidar_perception.clustering.params import BOX_SHAPES
from lidar_perception.detectors.hybrid.candidates import RescoredCandidates
from lidar_perception.detectors.hybrid.proposals import ConfirmedProposals
from lidar_perception.detectors.open import LOAD, open_detector
from lidar_perception.detectors.pointnet.detector import load_pointnet_detector
from lidar_perception.ground.params import GROUND_METHODS
from lidar_perception.ground.segment import segment_ground
from lidar_perception.param_fields import with_values
from lidar_perception.types import SENSOR_HEIGHT, LidarFrame

TIMES, MANY = 4, 2_000_000
SLACK = 2.0            # over n log n; n^2 is at 3.5
FAST = 1.0             # seconds of CPU that nobody minds
LOCAL_FAST = 15.0      # where local thresholds are: what all of their exact distances take
SMALL = 400.0          # megabytes that nobody minds
BYTES_A_POINT = 4096.0


def _limits(rng: Rng, n: int) -> np.ndarray:
    """Dense walls just before and behind the ranges at which eps changes."""
    x = np.array([15.0, 30.0, 45.0])[rng.integers(3, size=n)] + rng.uniform(-0.2, 0.2, n)
    return np.column_stack([x, rng.uniform(-0.7, 0.7, n), rng.uniform(-1.7, 0.7, n)])


def _around(rng: Rng, n: int, radius: float, z: tuple[float, float]) -> np.ndarray:
    turn = rng.uniform(-np.pi, np.pi, n)
    return np.column_stack([radius * np.cos(turn), radius * np.sin(turn), rng.uniform(*z, n)])


def _groups(rng: Rng, n: int, size: int = 12) -> np.ndarray:
    """As many small clusters as points allow, a metre apart."""
    number = np.arange(n) // size
    side = max(1, int(np.ceil(np.sqrt(number[-1] + 1))))
    middle = np.column_stack([number % side - side / 2, number // side - side / 2,
                              np.full(n, -0.8)])
    return middle + rng.uniform(-0.05, 0.05, (n, 3))


def _street(rng: Rng, n: int) -> np.ndarray:
    flat = rng.uniform([-40, -20, -SENSOR_HEIGHT], [40, 20, -SENSOR_HEIGHT + 0.05], (n, 3))
    flat[:n // 3] = _groups(rng, n // 3, 300) + rng.uniform(0, 1, (n // 3, 1)) * [0, 0, 1]
    return flat


def _sphere(rng: Rng, n: int) -> np.ndarray:
    way = rng.normal(size=(n, 3))
    return 10.0 * way / np.linalg.norm(way, axis=1, keepdims=True)


ARRANGEMENTS: dict[str, Callable[[Rng, int], np.ndarray]] = {
    "equal points": lambda rng, n: np.full((n, 3), [8.0, 0.0, -1.0]),
    "a ball of 5 cm": lambda rng, n: rng.uniform(-0.025, 0.025, (n, 3)) + [8, 0, -1],
    "a line": lambda rng, n: np.linspace([2, 0, -1], [42, 0, -1], n),
    "band limits": _limits,
    "one ring": lambda rng, n: _around(rng, n, 12.0, (-1.7, -1.7)),
    "a round wall": lambda rng, n: _around(rng, n, 15.0, (-1.7, 2.0)),
    "walls": lambda rng, n: np.column_stack([
        rng.integers(5, 50, n), rng.uniform(-20, 20, n), rng.uniform(-1.7, 1, n)]),
    "a sphere": _sphere,
    "a cube of 1 m": lambda rng, n: rng.uniform(-0.5, 0.5, (n, 3)) + [8, 0, -1],
    "a cube of 100 m": lambda rng, n: rng.uniform(-50, 50, (n, 3)),
    "a plane": lambda rng, n: rng.uniform([-40, -40, -1.73], [40, 40, -1.72], (n, 3)),
    "small groups": _groups,
    "a street": _street,
    "all ranges": lambda rng, n: _sphere(rng, n) / 10 * np.exp(rng.uniform(-3, 11, (n, 1))),
}


def _clusterings() -> dict[str, dict[str, Any]]:
    own = {f"euclidean {t}": {"clustering.method": "euclidean",
                              "clustering.euclidean.threshold": t}
           for t in ("local", "global", "fixed")}
    return {"dbscan": {}, "dbscan joined": {"clustering.dbscan.join_bands": True}, **own}


CLUSTERINGS = _clusterings()
STAGES = [*(f"ground {method}" for method in GROUND_METHODS),
          *(f"clusters {name}" for name in CLUSTERINGS),
          *(f"boxes {shape}" for shape in BOX_SHAPES)]
# Each configuration with each clustering, and the grounds in turn: what a pipeline adds is how its
# stages follow each other, as each stage is tried by itself.
PIPELINES = [f"pipeline {config}, {GROUND_METHODS[(i + j) % len(GROUND_METHODS)]}, {clusters}"
             for i, config in enumerate(CONFIGURATIONS) for j, clusters in enumerate(CLUSTERINGS)]
NETWORKS = [*(f"network {name}" for name in LOAD), "network rescored", "network confirmed"]
LOCAL = ("euclidean local", *NETWORKS)  # PointNet's own clusters are of that kind
CASES = [(stage, arrangement, points) for stages, points in (
            (STAGES, 100_000), (PIPELINES, 50_000), (NETWORKS, 20_000), (STAGES, MANY))
         for stage, arrangement in product(stages, ARRANGEMENTS)]


def case_of(seed: int, number: int) -> Case | None:
    """Every stage with every arrangement once, in an order of the seed's."""
    if number >= len(CASES):
        return None
    order = np.random.default_rng(seed).permutation(len(CASES))
    stage, arrangement, points = CASES[order[number]]
    return Case("shapes", f"{stage}: {arrangement}, {points} points", seed, number,
                {"stage": stage, "arrangement": arrangement, "points": points})


class Attempt:
    """Networks are loaded when they are first asked for."""

    def __init__(self, folder: Path):
        self.works: dict[str, Callable[[LidarFrame], Any]] = {}

    def __call__(self, case: Case) -> Outcome:
        stage, points = case.settings["stage"], case.settings["points"]
        if stage not in self.works:
            self.works[stage] = work_of(stage)
            self._cost(case, 2000)  # compiles, and fills caches
        if points == MANY:
            seconds, megabytes = self._cost(case, points)
            return _judged(case, [(seconds, megabytes)], points)
        costs = [self._cost(case, n) for n in (points, TIMES * points)]
        outcome = _judged(case, costs, TIMES * points)
        if outcome.verdict == FAILED:  # once more, as other processes may have been in the way
            costs = [min(a, b) for a, b in zip(costs, (
                self._cost(case, n) for n in (points, TIMES * points)))]
            outcome = _judged(case, costs, TIMES * points)
        return outcome

    def _cost(self, case: Case, points: int) -> tuple[float, float]:
        """CPU seconds, and megabytes at most."""
        rng = generator("shapes", case.seed, points)
        xyz = ARRANGEMENTS[case.settings["arrangement"]](rng, points).astype(np.float32)
        frame = LidarFrame.of(xyz, np.full(len(xyz), 0.3, np.float32))
        held, begin = memory_mb("VmRSS", reset=True), process_time()
        self.works[case.settings["stage"]](frame)
        return process_time() - begin, max(0.0, memory_mb("VmHWM") - held)


def _judged(case: Case, costs: list[tuple[float, float]], points: int) -> Outcome:
    seconds, megabytes = costs[-1]
    what = f"{case.settings['stage']}, {case.settings['arrangement']}"
    if megabytes > max(SMALL, BYTES_A_POINT * points / 2**20):
        return Outcome(FAILED, f"{what}: {megabytes:.0f} MB for {points} points")
    if len(costs) == 2:
        growth = TIMES * log(points) / log(points / TIMES) * SLACK
        before, held = costs[0]
        fast = LOCAL_FAST if any(word in case.settings["stage"] for word in LOCAL) else FAST
        if seconds > max(fast, growth * before):
            return Outcome(FAILED, f"{what}: {before:.2f} s for {points // TIMES} points, "
                           f"{seconds:.2f} s for {points}")
        if megabytes > max(SMALL, growth * held):
            return Outcome(FAILED, f"{what}: {held:.0f} MB for {points // TIMES} points, "
                           f"{megabytes:.0f} MB for {points}")
    return Outcome(SURVIVED)


def work_of(stage: str) -> Callable[[LidarFrame], Any]:
    """What a stage of STAGES, PIPELINES or NETWORKS does with a frame."""
    kind, _, name = stage.partition(" ")
    if kind == "ground":
        params = with_values(PipelineParams(), {"ground.method": name})
        return lambda frame: segment_ground(frame, params.ground)
    if kind == "clusters":
        params = with_values(PipelineParams(), CLUSTERINGS[name])
        return lambda frame: cluster(frame.xyz, params.clustering)
    if kind == "boxes":
        return lambda frame: grounded_boxes(
            frame.xyz, np.zeros(len(frame), bool),
            (1 + np.arange(len(frame)) // 500).astype(np.int32), name)
    template = fixed_seed(load_seed(""))
    if kind == "pipeline":
        config, ground, clusters = name.split(", ")
        values = {**CONFIGURATIONS[config], "view.enabled": False, "ground.method": ground,
                  **CLUSTERINGS[clusters]}
        params = with_values(PipelineParams(), values)
        return lambda frame: find_candidates(frame, template, None, params)
    if name == "rescored":
        return RescoredCandidates(load_pointnet_detector("", "auto"), template,
                                  pipeline=with_values(BEST, {"view.enabled": False}))
    if name == "confirmed":
        return ConfirmedProposals(open_detector("pointpillars"),
                                  load_pointnet_detector("", "auto"))
    return open_detector(name)
