"""What the rays of a turn meet first, in torch: the same code on a CPU and a GPU.

The nearest of all pairs of solid and ray that meet is kept per ray as in a depth buffer. Beams at
the edges of things are cast once more, into their footprint: see edges.py.
Solids are in the sensor's frame at the stamp; the ground is in the world, whose axes are parallel.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
import torch

from lidar_perception.simulation.edges import Met, at_edges, footprint, merged
from lidar_perception.simulation.pairs import (
    CastScene,
    Runs,
    View,
    meetings,
    runs_of,
    scene_of,
    shade,
)
from lidar_perception.simulation.sensor import STILL, Motion, Sensor
from lidar_perception.simulation.solids import Solids
from lidar_perception.simulation.terrain import Ground, GroundHits, cast_ground

CHUNK = 1 << 15  # pairs at a time: what they need stays within a CPU's cache
GPU_CHUNK = 1 << 22  # about 1 GB
NO_SOLID = (1 << 31) - 1


class Hits(NamedTuple):
    """What each ray meets first, without noise: (columns, rings) arrays. range float64 m, inf
    where nothing; brightness float64 0..1; cosine float64: of the incidence, 0 where nothing; owner
    int32, 0 where no object; semantic uint16, 0
    where nothing, 1 (outlier) for a return from between two things, see edges.py; solid int32, an
    index into the solids, -1 where none. reached[k] rays would meet object k if it were alone."""

    range: np.ndarray
    brightness: np.ndarray
    cosine: np.ndarray
    owner: np.ndarray
    semantic: np.ndarray
    solid: np.ndarray
    reached: np.ndarray


def cast(solids: Solids, ground: Ground, position: np.ndarray, sensor: Sensor,
         motion: Motion = STILL, seed: int = 0, device: str = "cpu",
         chunk: int | None = None) -> Hits:
    """Cast all rays of one turn, see View and cast_batch."""
    return cast_batch([View(solids, ground, position, motion, seed)], sensor, device, chunk)[0]


def cast_batch(views: Sequence[View], sensor: Sensor, device: str = "cpu",
               chunk: int | None = None) -> list[Hits]:
    """Cast one turn in each of several scenes. Not many more than chunk pairs of solid and ray are
    looked at at a time, which bounds the memory but changes no result: that depends on the view
    and the device alone."""
    if not views:
        return []
    chunk = chunk or (CHUNK if torch.device(device).type == "cpu" else GPU_CHUNK)
    with _one_thread():
        scene, runs = scene_of(views, sensor, device), runs_of(views, sensor, device)
        met, reached = _first(views, scene, runs, sensor, chunk)
        if sensor.divergence:
            grid = met.solid.reshape(len(views), sensor.rings, sensor.columns)
            edge = at_edges(grid).reshape(-1)
            aside = scene._replace(direction=footprint(scene, sensor.divergence))
            other, _ = _first(views, aside, runs, sensor, chunk, edge)
            met = Met(*(torch.where(edge, new, old)
                        for new, old in zip(merged(scene, met, other, sensor.pulse), met)))
        return _unpacked(views, sensor, met, reached)


@contextmanager
def _one_thread() -> Iterator[None]:
    """torch with one thread: the arrays are small, and two that wait for each other take up to ten
    times as long where other programs run as well. Cast scenes in processes of their own instead.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _first(views: Sequence[View], scene: CastScene, runs: Runs, sensor: Sensor, chunk: int,
           only: torch.Tensor | None = None) -> tuple[Met, list[np.ndarray]]:
    """What all rays meet, or those of only (R,) bool; and how many rays meet each view's owners."""
    ground = _grounds(views, scene, sensor, only)
    keys = _key(ground.range, torch.full_like(scene.number, NO_SOLID))
    rays, pairs = len(keys), []
    for solid, ray, t in meetings(scene, runs, chunk, only):
        near = torch.nonzero(t <= sensor.max_range)[:, 0]
        solid, ray, t = solid[near], ray[near], t[near]
        keys.scatter_reduce_(0, ray, _key(t, solid), "amin")
        owner = scene.owner[solid].to(torch.int64)
        owned = torch.nonzero(owner)[:, 0]
        pairs.append(owner[owned] * rays + ray[owned])
    once = torch.unique(torch.cat(pairs)) if pairs else keys[:0]
    owner, view = once // rays, once % rays // (rays // len(views))
    reached = [torch.bincount(owner[view == i]).cpu().numpy() for i in range(len(views))]
    return _met(scene, ground, keys & NO_SOLID), reached


def _key(t: torch.Tensor, solid: torch.Tensor) -> torch.Tensor:
    """int64 that is lower for a nearer hit, and of hits closer than float32 tells for a lower
    solid, so that the order of the hits does not matter."""
    return (t.to(torch.float32).view(torch.int32).to(torch.int64) << 32) + solid


def _grounds(views: Sequence[View], scene: CastScene, sensor: Sensor,
             only: torch.Tensor | None) -> GroundHits:
    """What the rays meet of their view's ground."""
    found, size = [], scene.direction.shape[1] // len(views)
    for i, view in enumerate(views):
        mine = slice(i * size, (i + 1) * size)
        position = torch.as_tensor(np.asarray(view.position, np.float64)).to(scene.lift.device)
        start = scene.since[mine] * torch.as_tensor(view.motion.velocity).to(position)[:, None]
        start = start + position[:, None]
        start[2] += scene.lift[mine]
        found.append(cast_ground(view.ground, start, scene.direction[:, mine], sensor.max_range,
                                 None if only is None else only[mine]))
    return GroundHits(*(torch.cat(part) for part in zip(*found)))


def _met(scene: CastScene, ground: GroundHits, solid: torch.Tensor) -> Met:
    """Everything about the solids (R,) that are nearest, or else the ground."""
    met = Met(ground.range, ground.brightness, ground.cosine,
              torch.where(solid == NO_SOLID, -1, solid), torch.zeros_like(ground.semantic),
              ground.semantic)
    lit = torch.nonzero(met.solid >= 0)[:, 0]
    solid = solid[lit]
    met.range[lit], met.brightness[lit], met.cosine[lit] = shade(scene, solid, lit)
    met.owner[lit], met.semantic[lit] = scene.owner[solid], scene.semantic[solid]
    return met


def _unpacked(views: Sequence[View], sensor: Sensor, met: Met,
              reached: list[np.ndarray]) -> list[Hits]:
    shape, first, hits = (len(views), sensor.rings, sensor.columns), 0, []
    grids = [np.swapaxes(part.cpu().numpy().reshape(shape), 1, 2) for part in met]
    for i, (view, count) in enumerate(zip(views, reached)):
        far, brightness, cosine, solid, owner, semantic = (
            np.ascontiguousarray(grid[i]) for grid in grids)
        most = max(int(view.solids.owner.max(initial=0)), 0) + 1
        hits.append(Hits(far, brightness, cosine, owner, semantic.astype(np.uint16),
                         np.where(solid < 0, -1, solid - first).astype(np.int32),
                         np.pad(count, (0, most - len(count)))))
        first += len(view.solids)
    return hits
