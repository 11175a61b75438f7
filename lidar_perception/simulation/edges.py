"""Beams are wide: what comes back where a beam meets the edges of things.

Where a ray's neighbours on the grid meet other solids than it does, a second ray is cast, to a
random place in the beam's footprint. So it meets something else with a probability that is the
share of the footprint beyond the edge. A random share of the beam's energy then falls on what the
second ray meets; if both surfaces are within the length of the pulse, they give one return between
them, and the stronger one of the two otherwise.
"""

from __future__ import annotations

from typing import NamedTuple

import torch

from lidar_perception.simulation.hashing import uniform
from lidar_perception.simulation.pairs import CastScene

OUTLIER = 1  # SemanticKITTI's class of returns that are from no surface


class Met(NamedTuple):
    """What R rays meet: range m, brightness and cosine of the incidence float64; solid int64, -1
    where none; owner and semantic int32."""

    range: torch.Tensor
    brightness: torch.Tensor
    cosine: torch.Tensor
    solid: torch.Tensor
    owner: torch.Tensor
    semantic: torch.Tensor


def at_edges(solid: torch.Tensor) -> torch.Tensor:
    """(views, rings, columns) bool: a neighbour has another solid."""
    edge = torch.zeros_like(solid, dtype=torch.bool)
    other = solid != solid.roll(1, dims=2)
    edge |= other | other.roll(-1, dims=2)
    other = solid[:, 1:] != solid[:, :-1]
    edge[:, 1:] |= other
    edge[:, :-1] |= other
    return edge


def footprint(scene: CastScene, divergence: float) -> torch.Tensor:
    """(3, R) directions to a random place, uniform in the disc of each ray's beam."""
    x, y, z = scene.direction
    radius = divergence / 2 * torch.sqrt(uniform(3, scene.ray_salt))
    turn = 2 * torch.pi * uniform(4, scene.ray_salt)
    aside, up, level = radius * torch.cos(turn), radius * torch.sin(turn), torch.hypot(x, y)
    moved = torch.stack([x - aside * y / level - up * z * x / level,
                         y + aside * x / level - up * z * y / level, z + up * level])
    return moved / torch.linalg.norm(moved, dim=0)


def merged(scene: CastScene, one: Met, other: Met, pulse: float) -> Met:
    """What the beams report whose two rays meet one and other."""
    share = uniform(5, scene.ray_salt)  # of other
    first, second = one.brightness * (1 - share), other.brightness * share
    both = torch.isfinite(one.range) & torch.isfinite(other.range)
    between = both & ((one.range - other.range).abs() < pulse)
    # An empty ray has no power: 0 / inf.
    stronger = second / other.range ** 2 > first / one.range ** 2
    single = Met(*(torch.where(stronger, b, a) for a, b in zip(
        one._replace(brightness=first), other._replace(brightness=second))))
    mean = torch.where(both, one.range * (1 - share) + other.range * share, 0.0)
    mixed = Met(mean, first + second, one.cosine * (1 - share) + other.cosine * share,
                torch.where(share > 0.5, other.solid, one.solid),
                torch.where(one.owner == other.owner, one.owner, 0),
                torch.where(one.semantic == other.semantic, one.semantic, OUTLIER))
    result = (torch.where(between, a, b) for a, b in zip(mixed, single))
    return Met(*(torch.where(one.solid == other.solid, a, b) for a, b in zip(one, result)))
