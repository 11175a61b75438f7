"""The ground: a road that slopes, waves and falls to its curbs, side streets that cross it, and
beyond the curbs sidewalks, then grass.

It is a smooth relief in the world (x along the street, y left, z up, metres), raised by the height
of the curb beyond the curbs. A ray is above both the relief and the raised relief until it meets
the latter; there it is at its end, or from there on it meets a curb or the road.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from lidar_perception.simulation.hashing import uniform

ROAD, PARKING, SIDEWALK, GRASS = 40, 44, 48, 72  # SemanticKITTI
GRAIN = 0.25  # m between the bumps of a rough surface
PATCH = 10    # bumps from one rough patch to the next


class Ground(NamedTuple):
    """Metres; see the module. The relief is slope_x x + slope_y y
    + wave sin(2 pi x / wavelength) cos(2 pi y / wavelength), less the camber."""

    slope_x: float = 0.0
    slope_y: float = 0.0
    wave: float = 0.0
    wavelength: float = 25.0
    camber: float = 0.0       # fall per metre from the road's middle line to both curbs
    curb_left: float = 1e9    # y of the curbs
    curb_right: float = -1e9
    curb_height: float = 0.0
    walk: float = 1e9         # width of the sidewalk beyond each curb; grass beyond
    crossings: tuple[tuple[float, float], ...] = ()  # x intervals of side streets, without a curb
    parking: float = 0.0      # width of the parking strip inside each curb
    rough: float = 0.0        # greatest height of tufts of grass; a tenth of it on the road
    litter: float = 0.0       # likewise of what lies and grows on sidewalks and parking strips
    road: float = 0.3         # reflectances
    sidewalk: float = 0.4
    grass: float = 0.35


class GroundHits(NamedTuple):
    """Of N rays: range (N,) float64 m, inf where none; brightness and cosine of the incidence
    (N,) float64, 0 where none; semantic (N,) int32, 0 where none."""

    range: torch.Tensor
    brightness: torch.Tensor
    cosine: torch.Tensor
    semantic: torch.Tensor


def shine(reflectance, cosine):
    """Brightness, much softer than Lambert's law: on KITTI's scans the road has the same intensity
    at 20 m, where the rays graze it, as at 6 m."""
    return reflectance * (0.75 + 0.25 * cosine)


def ground_height(ground: Ground, x, y):
    """Height of the road, without curbs and roughness, at x, y in the world: arrays or tensors."""
    return _relief(ground, x, y)[0]


def surface_height(ground: Ground, x, y):
    """Height of what one stands on at x, y (arrays), without roughness: road, sidewalk, grass."""
    x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
    return ground_height(ground, x, y) + np.where(_raised(ground, x, y), ground.curb_height, 0.0)


def cast_ground(ground: Ground, start: torch.Tensor, way: torch.Tensor, max_range: float,
                only: torch.Tensor | None = None) -> GroundHits:
    """What N rays, start and way (3, N) float64 in the world, that start above the road meet of
    the ground within max_range; only (N,) bool: the rays to look at."""
    hits = GroundHits(torch.full_like(way[0], torch.inf), torch.zeros_like(way[0]),
                      torch.zeros_like(way[0]), torch.zeros_like(way[0], dtype=torch.int32))
    falls = way[2] - ground.slope_x * way[0] - ground.slope_y * way[1] < -1e-3
    falls = torch.nonzero(falls if only is None else falls & only)[:, 0]
    start, way = start[:, falls], way[:, falls]
    t = _meet(ground, start, way, 0.0, torch.zeros_like(start[0]), max_range)
    edge = torch.zeros_like(t)  # the cosine at a curb, where one is met
    if ground.curb_height:
        t, edge = _meet_raised(ground, start, way, t, max_range)
    near = torch.nonzero(t <= max_range)[:, 0]
    falls, start, way, t, edge = falls[near], start[:, near], way[:, near], t[near], edge[near]

    x, y = start[:2] + t * way[:2]
    _, slope_x, slope_y = _relief(ground, x, y)
    cosine = (slope_x * way[0] + slope_y * way[1] - way[2]).clip(1e-3, 1.0)
    semantic, reflectance = _surface(ground, x, y, edge > 0)
    if ground.rough or ground.litter:
        height = torch.where(semantic == GRASS, ground.rough, torch.where(
            semantic == ROAD, 0.1 * ground.rough, ground.litter))
        height = height * _bumps(x, y) * _bumps(x / PATCH, y / PATCH)
        # Tufts hide each other: a grazing ray meets one of those in its last metre.
        t = t - torch.where(edge > 0, 0.0, (height / cosine).clip(max=1.0))
    cosine = torch.where(edge > 0, edge, cosine)
    hits.range[falls], hits.cosine[falls] = t, cosine
    hits.brightness[falls] = shine(reflectance, cosine)
    hits.semantic[falls] = semantic
    return hits


def _relief(ground: Ground, x, y):
    """Height and slopes along x and y at x, y, without curbs: arrays or tensors."""
    m = torch if isinstance(x, torch.Tensor) else np
    middle, half = (ground.curb_left + ground.curb_right) / 2, (
        ground.curb_left - ground.curb_right) / 2
    height = ground.slope_x * x + ground.slope_y * y
    slope_x, slope_y = ground.slope_x + 0 * x, ground.slope_y + 0 * y
    if ground.camber:
        aside = y - middle
        height = height - ground.camber * abs(aside).clip(0.0, half)
        slope_y = slope_y - ground.camber * m.sign(aside) * (abs(aside) < half)
    if ground.wave:
        turns = 2 * np.pi / ground.wavelength
        a, b = turns * x, turns * y
        sin, cos = m.sin(a), m.cos(b)
        height = height + ground.wave * sin * cos
        slope_x = slope_x + ground.wave * turns * m.cos(a) * cos
        slope_y = slope_y - ground.wave * turns * sin * m.sin(b)
    return height, slope_x, slope_y


def _raised(ground: Ground, x, y):
    """Whether x, y lie beyond the curbs and in no side street."""
    raised = (y <= ground.curb_right) | (y >= ground.curb_left)
    for low, high in ground.crossings:
        raised = raised & ~((low < x) & (x < high))
    return raised


def _meet(ground: Ground, start: torch.Tensor, way: torch.Tensor, lift: float, t: torch.Tensor,
          max_range: float) -> torch.Tensor:
    """(N,) range of the relief raised by lift, searched from t by Newton's method; inf if none."""
    t, left = t.clone(), torch.arange(len(t), device=t.device)
    for _ in range(10):
        at, ahead = t[left], way[:, left]
        x, y, z = start[:, left] + at * ahead
        height, slope_x, slope_y = _relief(ground, x, y)
        gap = z - height - lift
        closing = slope_x * ahead[0] + slope_y * ahead[1] - ahead[2]
        t[left] = (at + gap / closing.clip(min=1e-4)).clip(0.0, 2 * max_range)
        left = left[gap.abs() > 1e-4]  # what is left after that step is far less
        if not len(left):
            break
    t[left] = torch.inf
    return t


def _meet_raised(ground: Ground, start: torch.Tensor, way: torch.Tensor, low: torch.Tensor,
                 max_range: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Range with the curbs, given that of the relief, and the cosine where a curb is met, else 0
    (N,)."""
    high = _meet(ground, start, way, ground.curb_height, low.clip(max=max_range), max_range)
    x, y = start[:2] + torch.where(high < torch.inf, high, 0.0) * way[:2]
    on_top = _raised(ground, x, y) & (high < torch.inf)
    t, edge = torch.where(on_top, high, low), torch.zeros_like(low)
    lines = [(1, ground.curb_left), (1, ground.curb_right)]
    lines += [(0, end) for crossing in ground.crossings for end in crossing]
    for axis, line in lines:
        at = (line - start[axis]) / way[axis]
        x, y = start[:2] + (at + 1e-4) * way[:2]  # a hair beyond
        meets = (high < at) & (at < t) & ~on_top & _raised(ground, x, y)
        t, edge = torch.where(meets, at, t), torch.where(meets, way[axis].abs(), edge)
    return t, edge


def _surface(ground: Ground, x: torch.Tensor, y: torch.Tensor,
             curb: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Class and reflectance (N,) of the ground at x, y; curb (N,) bool: of the curb itself."""
    raised = _raised(ground, x, y)
    beyond = torch.maximum(y - ground.curb_left, ground.curb_right - y)
    crossed = torch.zeros_like(raised)
    for low, high in ground.crossings:
        crossed |= (low < x) & (x < high)
    semantic = torch.where(beyond < -ground.parking, ROAD, PARKING)
    semantic = torch.where(crossed, ROAD, semantic)
    semantic = torch.where(raised, torch.where(beyond < ground.walk, SIDEWALK, GRASS), semantic)
    semantic = torch.where(curb, SIDEWALK, semantic)
    reflectance = torch.where(semantic == SIDEWALK, ground.sidewalk,
                              torch.where(semantic == GRASS, ground.grass, ground.road))
    return semantic.to(torch.int32), reflectance.to(x)


def _bumps(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """0 .. 1 at x, y: value noise, the same at a place for ever."""
    x, y = x / GRAIN, y / GRAIN
    left, low = x.floor(), y.floor()
    place = (left.long() << 32) + low.long()
    a, b = x - left, y - low
    a, b = a * a * (3 - 2 * a), b * b * (3 - 2 * b)
    corner = [[uniform(0, place + (i << 32) + j) for j in (0, 1)] for i in (0, 1)]
    return ((corner[0][0] * (1 - b) + corner[0][1] * b) * (1 - a)
            + (corner[1][0] * (1 - b) + corner[1][1] * b) * a)
