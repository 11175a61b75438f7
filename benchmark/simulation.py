"""One scan of the simulator, stage by stage, and a batch on a GPU where there is one."""

from __future__ import annotations

from functools import partial
from time import perf_counter

import numpy as np
import torch

from benchmark.rows import measured, row
from benchmark.timing import Clock
from lidar_perception.runs.terminal import track
from lidar_perception.simulation.pairs import View
from lidar_perception.simulation.raycast import cast, cast_batch
from lidar_perception.simulation.returns import returns_of
from lidar_perception.simulation.scene import Moment, Scene, make_scene
from lidar_perception.simulation.sensor import HDL64E

MIN_ACTORS = 150  # near the sensor
BATCH = 16


def measure_simulation(streets: int, repeat: int) -> dict:
    """Full HDL-64E scans of the first `streets` streets with MIN_ACTORS things in sight."""
    title = "Simulator, HDL-64E"
    scenes = _busy(streets)
    first = scenes[0]
    clock = Clock(min(repeat, 3), _calls(*first))
    for scene, moment in track(scenes, title, len(scenes)):
        clock.time(_calls(scene, moment))
    ms = clock.medians()
    total = ms["scene"] + ms["cast"] + ms["returns"]
    rows = [row(f"({name})", ours_ms=ms[name]) for name in ("scene", "cast", "returns")]
    rows.append(row("(one scan)", ours_ms=total, value=total, unit="ms", target=700))
    if torch.cuda.is_available():
        each = _on_gpu(scenes)
        rows.append(row(f"(a scan in a batch of {BATCH}, GPU)", ours_ms=each, value=each,
                        unit="ms", target=20))
    else:
        rows.append(row("(GPU)", note="no GPU here"))
    points = [len(_calls(*each)["returns"]().xyz) for each in scenes]
    return measured(title, len(scenes), np.median(points), rows,
                    solids=float(np.median([len(m.solids) for _, m in scenes])))


def _busy(count: int) -> list[tuple[Scene, Moment]]:
    found, seed = [], 0
    while len(found) < count:
        scene = make_scene(seed)
        near = [a for a in scene.actors if np.hypot(a.x, a.y) < HDL64E.max_range]
        if len(near) >= MIN_ACTORS:
            found.append((scene, scene.at(0.0, HDL64E.height)))
        seed += 1
    return found


def _calls(scene: Scene, moment: Moment) -> dict:
    hits = cast(moment.solids, scene.ground, moment.position, HDL64E, moment.motion)
    return {"scene": partial(scene.at, 0.0, HDL64E.height),
            "cast": partial(cast, moment.solids, scene.ground, moment.position, HDL64E,
                            moment.motion),
            "returns": lambda: returns_of(hits, HDL64E, moment.motion, np.random.default_rng(0))}


def _on_gpu(scenes: list[tuple[Scene, Moment]]) -> float:
    views = [View(m.solids, s.ground, m.position, m.motion, i)
             for i, (s, m) in enumerate(scenes * BATCH)][:BATCH]
    cast_batch(views, HDL64E, "cuda")
    torch.cuda.synchronize()
    begin = perf_counter()
    cast_batch(views, HDL64E, "cuda")
    torch.cuda.synchronize()
    return 1e3 * (perf_counter() - begin) / BATCH
