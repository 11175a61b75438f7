"""One simulated scan with its street, stage by stage."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from benchmark.rows import make_measurement, make_row
from benchmark.timing import Clock
from lidar_perception.runs.terminal import show_progress
from lidar_perception.simulation.raycast import cast_rays
from lidar_perception.simulation.returns import make_returns
from lidar_perception.simulation.scene import Scene, make_scene
from lidar_perception.simulation.sensor import HDL64E

MIN_ACTORS = 150  # near the sensor
TARGET_MS = 480   # 1000 scans, each of a street of its own, in four minutes on two cores
SHARED_SCANS = 10  # of one street, as `train --data-street-scans 10` draws them


def measure_simulation(streets: int, repeat: int) -> dict:
    """Measure full HDL-64E scans of the first `streets` streets with MIN_ACTORS visible objects."""
    title = "Simulator, HDL-64E"
    scenes = _busy(streets)
    first = _calls(*scenes[0])
    clock = Clock(min(repeat, 3), first)
    points, solids = [], []
    for seed, scene in show_progress(scenes, title, len(scenes)):
        calls = _calls(seed, scene)
        clock.time(calls)
        points.append(len(calls["returns"]().xyz))
        solids.append(len(calls["scene"]().solids))
    ms = clock.medians()
    total = sum(ms.values())
    rows = [make_row(f"({name})", ours_ms=ms[name]) for name in ms]
    rows.append(make_row("(one scan of a new street)", ours_ms=total, value=total, unit="ms",
                         target=TARGET_MS))
    shared = total - ms["street"] * (1 - 1 / SHARED_SCANS)
    rows.append(make_row(f"(one of {SHARED_SCANS} scans of a street)", ours_ms=shared, value=shared,
                         unit="ms"))
    return make_measurement(title, len(scenes), np.median(points), rows,
                            solids=float(np.median(solids)))


def _busy(count: int) -> list[tuple[int, Scene]]:
    found: list[tuple[int, Scene]] = []
    seed = 0
    while len(found) < count:
        scene = make_scene(seed)
        near = [a for a in scene.actors if np.hypot(a.x, a.y) < HDL64E.max_range]
        if len(near) >= MIN_ACTORS:
            found.append((seed, scene))
        seed += 1
    return found


def _calls(seed: int, scene: Scene) -> dict:
    moment = scene.at(0.0, HDL64E.height)
    hits = cast_rays(moment.solids, scene.ground, moment.position, HDL64E, moment.motion)
    return {"street": partial(make_scene, seed),
            "scene": lambda: replace(scene).at(0.0, HDL64E.height),  # with a table of its own
            "cast": partial(cast_rays, moment.solids, scene.ground, moment.position, HDL64E,
                            moment.motion),
            "returns": lambda: make_returns(hits, HDL64E, moment.motion, np.random.default_rng(0))}
