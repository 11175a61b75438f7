"""Beams through leaves, which hang in clumps with gaps between them."""

from __future__ import annotations

import torch

from lidar_perception.simulation.hashing import mixed, uniform

# Cells so many metres wide, of which this share holds all the leaves. With leaves everywhere a
# crown is one cluster for DBSCAN; KITTI's fall into many. STEPS: within so many either a leaf is
# met or the beam is taken to pass.
CLUMP, FILLED, STEPS = 0.5, 0.25, 12

Triple = list[torch.Tensor]


def through_leaves(start: Triple, way: Triple, half: Triple, enter: torch.Tensor,
                   leave: torch.Tensor, density: torch.Tensor, plant: torch.Tensor,
                   key: torch.Tensor) -> torch.Tensor:
    """(n,) range in metres at which leaves stop rays, inf where they pass: delta tracking (Woodcock
    et al., 1965) through a grid of full and empty cells.

    start, way: three tensors (n,) each, rays in the frames of unit shapes; half: the half sizes of
    these, m; enter, leave: ranges, m; density: mean, 1/m. plant (n,) int64: the same for all rays
    of a plant, and all along a drive; key (n,) int64: of the random numbers of a pair.
    """
    met = torch.full_like(enter, torch.inf)
    t, pair = enter.clip(min=0.0), torch.arange(len(enter), device=enter.device)
    cells = [h / CLUMP for h in half]
    for step in range(STEPS):
        t = t - torch.log(uniform(10 + step, key)) * FILLED / density
        cell = plant
        for s, w, c in zip(start, way, cells):
            cell = mixed(cell + torch.floor((s + t * w) * c).to(torch.int64))
        inside = t < leave
        stops = (uniform(1, cell) < FILLED) & inside
        met[pair[stops]] = t[stops]
        on = torch.nonzero(inside & ~stops)[:, 0]
        t, leave, density, plant, key, pair = (
            x[on] for x in (t, leave, density, plant, key, pair))
        start, way, cells = ([x[on] for x in v] for v in (start, way, cells))
    return met
