"""Rays against solids, pair by pair, in torch.

All solids are unit shapes under a linear map; a ray is within a unit shape while it is within all
the slabs and quadrics that bound it (Kay and Kajiya, SIGGRAPH 1986).
Rays have one number each: view by view, in it beam by beam, in that column by column; so a solid's
window is one run of numbers per beam. Runs of about the same length make a tile.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch

from lidar_perception.simulation.foliage import through_leaves
from lidar_perception.simulation.hashing import mixed, signed, uniform
from lidar_perception.simulation.sensor import STILL, Motion, Sensor, rays
from lidar_perception.simulation.solids import BOX, CYLINDER, ELLIPSOID, Solids
from lidar_perception.simulation.terrain import Ground, shine
from lidar_perception.simulation.windows import windows

KINDS = (BOX, ELLIPSOID, CYLINDER)


class View(NamedTuple):
    """A scene to cast into: position (3,) m of the sensor in the world at the stamp, over the road;
    motion: of the sensor during the turn; seed, a whole number (its lowest 64 bits count): of what
    is left to chance."""

    solids: Solids
    ground: Ground
    position: np.ndarray
    motion: Motion = STILL
    seed: int = 0


class CastScene(NamedTuple):
    """P solids and R rays of all views as tensors, float64 where nothing is said.

    matrix (9, P): to the unit shape; offset (3, P): where that takes the frame's origin; drift
    (3, P): what it takes the sensor's velocity against the solid to; moving: whether that matters.
    kind (P,) int8; density, transmission, reflectance (P,); owner, semantic (P,) int32.
    direction (3, R); since (R,) s after the stamp; lift (R,) m over the sensor's origin; number
    (R,) int64: of the ray in its view. salt (P,) and ray_salt (R,) int64: of random numbers."""

    matrix: torch.Tensor
    offset: torch.Tensor
    drift: torch.Tensor
    moving: bool
    kind: torch.Tensor
    density: torch.Tensor
    transmission: torch.Tensor
    reflectance: torch.Tensor
    owner: torch.Tensor
    semantic: torch.Tensor
    direction: torch.Tensor
    since: torch.Tensor
    lift: torch.Tensor
    number: torch.Tensor
    salt: torch.Tensor
    ray_salt: torch.Tensor


class Runs(NamedTuple):
    """(M,) int64 each: solid, first ray and how many rays from there; sorted by their number."""

    solid: torch.Tensor
    first: torch.Tensor
    count: torch.Tensor


def scene_of(views: Sequence[View], sensor: Sensor, device: str) -> CastScene:
    """Everything about the views that their pairs need, on the device."""
    def tensor(parts, dtype=torch.float64):
        return torch.as_tensor(np.concatenate(parts), dtype=dtype, device=device)

    def of_solids(name, dtype=torch.float64):
        return tensor([getattr(view.solids, name) for view in views], dtype)

    turns = [rays(sensor, view.motion) for view in views]
    seeds = [mixed(torch.tensor(signed(view.seed))) for view in views]
    number = torch.arange(sensor.columns * sensor.rings).repeat(len(views)).to(device)
    to_unit = [np.swapaxes(v.solids.axes, 1, 2) / v.solids.half[:, :, None] for v in views]
    drift = [np.einsum("pij,pj->pi", m, np.asarray(v.motion.velocity) - v.solids.velocity)
             for m, v in zip(to_unit, views)]
    return CastScene(
        matrix=tensor([m.reshape(-1, 9) for m in to_unit]).T.contiguous(),
        offset=tensor([-np.einsum("pij,pj->pi", m, v.solids.centre)
                       for m, v in zip(to_unit, views)]).T.contiguous(),
        drift=tensor(drift).T.contiguous(), moving=any(d.any() for d in drift),
        kind=of_solids("kind", torch.int8), density=of_solids("density"),
        transmission=of_solids("transmission"), reflectance=of_solids("reflectance"),
        owner=of_solids("owner", torch.int32),
        semantic=tensor([v.solids.semantic.astype(np.int32) for v in views], torch.int32),
        direction=tensor([np.swapaxes(t.direction, 0, 1).reshape(-1, 3)
                          for t in turns]).T.contiguous(),
        since=tensor([np.tile(t.since, sensor.rings) for t in turns]),
        lift=tensor([np.repeat(sensor.origins()[:, 2], sensor.columns)] * len(views)),
        number=number,
        salt=torch.cat([(torch.arange(len(v.solids)) << 32) + seed
                        for v, seed in zip(views, seeds)]).to(device),
        ray_salt=torch.stack(seeds).repeat_interleave(sensor.columns * sensor.rings).to(device)
        + number)


def runs_of(views: Sequence[View], sensor: Sensor, device: str) -> Runs:
    """The runs of all solids, wide enough for rays within the sensor's divergence."""
    found, solids = [], 0
    for i, view in enumerate(views):
        first, count, beams = windows(view.solids, sensor, view.motion, sensor.divergence / 2)
        solid, ring = np.nonzero(beams)
        first, count = first[solid], count[solid]
        over = np.maximum(first + count - sensor.columns, 0)  # goes on at column 0
        start = (i * sensor.rings + ring) * sensor.columns
        found += [(solid + solids, start + first, count - over), (solid + solids, start, over)]
        solids += len(view.solids)
    solid, first, count = (np.concatenate(part) for part in zip(*found))
    order = np.argsort(-count, kind="stable")[:np.count_nonzero(count)]
    return Runs(*(torch.as_tensor(part[order], device=device) for part in (solid, first, count)))


def meetings(scene: CastScene, runs: Runs, chunk: int, only: torch.Tensor | None = None
             ) -> Iterator[tuple[torch.Tensor, torch.Tensor, torch.Tensor]]:
    """Batches of pairs that meet: solid (n,), ray (n,) int64 and range (n,) m; only (R,) bool:
    the rays to look at. At most chunk pairs, or one run, are looked at at a time."""
    kinds = scene.kind[runs.solid]
    for kind in KINDS:
        mine = torch.nonzero(kinds == kind)[:, 0]
        if len(mine):
            yield from _meetings(kind, scene, Runs(*(x[mine] for x in runs)), chunk, only)


def _meetings(kind, scene, runs, chunk, only):
    lengths, start = runs.count.cpu().numpy(), 0
    while start < len(lengths):
        end = start + max(1, chunk // int(lengths[start]))
        solid, first, count = (x[start:end, None] for x in runs)
        steps = torch.arange(int(lengths[start]), device=first.device)
        ray = first + steps
        start = end
        inside = steps < count
        ray = torch.where(inside, ray, first)
        lift = scene.lift[first]
        if only is not None:
            inside &= only[ray]
            row, column = torch.nonzero(inside, as_tuple=True)
            solid, lift, ray = solid[row, 0], lift[row, 0], ray[row, column]
            inside = torch.ones_like(ray, dtype=torch.bool)
        enter, leave = span(kind, *unit_rays(scene, solid, ray, lift))
        inside &= (enter <= leave) & (leave > 0)
        met = torch.nonzero(inside, as_tuple=True)
        solid, ray = solid[met[0]].reshape(-1), ray[met]
        enter, leave = enter[met], leave[met]
        t = stop(scene, solid, ray, enter, leave)
        met = torch.nonzero(t < leave)[:, 0]
        yield solid[met], ray[met], t[met]


def unit_rays(scene: CastScene, solid: torch.Tensor, ray: torch.Tensor, lift: torch.Tensor):
    """Start and direction, three tensors each, of rays in the frames of unit shapes; solid and
    lift must broadcast to ray."""
    m = scene.matrix[:, solid]
    x, y, z = (part[ray] for part in scene.direction)
    way = [m[i] * x + m[i + 1] * y + m[i + 2] * z for i in (0, 3, 6)]
    start = [scene.offset[i][solid] + m[3 * i + 2] * lift for i in range(3)]
    if scene.moving:
        since = scene.since[ray]
        start = [s + scene.drift[i][solid] * since for i, s in enumerate(start)]
    return start, way


def span(kind: int, start, way) -> tuple[torch.Tensor, torch.Tensor]:
    """Ranges at which rays enter and leave a unit shape; not enter <= leave where they miss. A ray
    exactly along a cylinder or on the face of a box is taken as a miss."""
    bounds = []
    for i in {BOX: (0, 1, 2), ELLIPSOID: (), CYLINDER: (2,)}[kind]:
        inverse = 1 / way[i]
        a, b = (-1 - start[i]) * inverse, (1 - start[i]) * inverse
        bounds.append((torch.minimum(a, b), torch.maximum(a, b)))
    if kind != BOX:
        start, way = (start, way) if kind == ELLIPSOID else (start[:2], way[:2])
        square = sum(w * w for w in way)
        middle = -sum(s * w for s, w in zip(start, way)) / square
        off = sum((s + middle * w) ** 2 for s, w in zip(start, way))  # from the axis or centre
        half = torch.sqrt((1 - off) / square)  # nan where it misses
        bounds.append((middle - half, middle + half))
    enter, leave = bounds[0]
    for a, b in bounds[1:]:
        enter, leave = torch.maximum(enter, a), torch.minimum(leave, b)
    return enter, leave


def stop(scene: CastScene, solid: torch.Tensor, ray: torch.Tensor, enter: torch.Tensor,
         leave: torch.Tensor) -> torch.Tensor:
    """(n,) range at which rays that pass through the solids' shapes are stopped; inf where they
    are not, as when they start within an opaque one."""
    t = torch.where(enter > 0, enter, torch.inf)
    leafy = torch.nonzero(scene.density[solid] < torch.inf)[:, 0]
    if len(leafy):
        s, r = solid[leafy], ray[leafy]
        m = scene.matrix[:, s]
        half = [1 / torch.sqrt(m[i] ** 2 + m[i + 1] ** 2 + m[i + 2] ** 2) for i in (0, 3, 6)]
        t[leafy] = through_leaves(
            *unit_rays(scene, s, r, scene.lift[r]), half, enter[leafy], leave[leafy],
            scene.density[s], plant=scene.reflectance[s].view(torch.int64),
            key=scene.salt[s] + scene.number[r])
    clear = scene.transmission[solid]
    glass = torch.nonzero(clear > 0)[:, 0]
    if len(glass):
        key = scene.salt[solid[glass]] + scene.number[ray[glass]]
        t[glass] = torch.where(uniform(2, key) < clear[glass], torch.inf, t[glass])
    return t


def shade(scene: CastScene, solid: torch.Tensor, ray: torch.Tensor
          ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Range, brightness and cosine of the incidence (n,) of pairs that meet."""
    far, cosine = torch.zeros_like(scene.lift[ray]), torch.zeros_like(scene.lift[ray])
    for kind in KINDS:
        mine = torch.nonzero(scene.kind[solid] == kind)[:, 0]
        s, r = solid[mine], ray[mine]
        start, way = unit_rays(scene, s, r, scene.lift[r])
        enter, leave = span(kind, start, way)
        far[mine] = stop(scene, s, r, enter, leave)
        unit = _normal(kind, [o + enter * d for o, d in zip(start, way)])
        m = scene.matrix[:, s]
        out = [m[i] * unit[0] + m[3 + i] * unit[1] + m[6 + i] * unit[2] for i in range(3)]
        along = sum(o * d for o, d in zip(out, scene.direction[:, r])).abs()
        cosine[mine] = along / torch.sqrt(sum(o * o for o in out))
    brightness = shine(scene.reflectance[solid], cosine)
    # Leaves face anywhere: so much the neighbours of vegetation's points differ on SemanticKITTI.
    leaf = torch.nonzero(scene.density[solid] < torch.inf)[:, 0]
    solid, key = solid[leaf], scene.salt[solid[leaf]] + scene.number[ray[leaf]]
    brightness[leaf] = shine(scene.reflectance[solid], 0.5) * (0.5 + uniform(6, key))
    cosine[leaf] = 1.0
    return far, brightness, cosine


def _normal(kind: int, point: list[torch.Tensor]) -> list[torch.Tensor]:
    """Outward direction of the unit shape at a point of its surface, three tensors each."""
    x, y, z = point
    if kind == ELLIPSOID:
        return point
    if kind == CYLINDER:
        cap = z * z > x * x + y * y
        return [torch.where(cap, 0.0, x), torch.where(cap, 0.0, y), torch.where(cap, z, 0.0)]
    face = torch.stack([p.abs() for p in point]).argmax(dim=0)
    return [torch.where(face == i, p, 0.0) for i, p in enumerate(point)]
