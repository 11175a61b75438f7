"""The ground: a road that slopes, waves and falls to its curbs, side streets that cross it, and
beyond the curbs sidewalks, then grass.

It is a smooth relief in the world (x along the street, y left, z up, metres), raised by the height
of the curb beyond the curbs. A ray is above both the relief and the raised relief until it meets
the latter; there it is at its end, or from there on it meets a curb or the road. Before that it may
meet what lies and grows there: bumps everywhere, tufts and litter in patches.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from lidar_perception.simulation.hashing import uniform
from lidar_perception.simulation.solids import RETROREFLECTOR

ROAD, PARKING, SIDEWALK, GRASS = 40, 44, 48, 72  # SemanticKITTI
GRAIN = 0.25  # m between the bumps of a rough surface
PATCH = 10    # bumps from one rough patch to the next
BARE, RISE = 0.45, 3.0  # share of the ground between the patches, about; how steep their edges are
EVEN, PAVED = 0.1, 0.06  # height of bumps there and on the road, of that of the patches
TUFTS_HIDE, TUFT_STEPS = 6.0, 8  # m of a grazing ray in which tufts are looked for, and steps


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
    rough: float = 0.0        # greatest height of tufts of grass; PAVED of it on the road
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
    at 20 m, where the rays graze it, as at 6 m. A retroreflector is as bright from anywhere."""
    return reflectance * (1 - 0.25 * (1 - cosine) * (reflectance < RETROREFLECTOR))


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
    if ground.rough or ground.litter:
        t = torch.where(edge > 0, t, _meet_tufts(ground, start, way, t, cosine))
    cosine = torch.where(edge > 0, edge, cosine)
    semantic, reflectance = _surface(ground, *(start[:2] + t * way[:2]), edge > 0)
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


def _meet_tufts(ground: Ground, start: torch.Tensor, way: torch.Tensor, t: torch.Tensor,
                cosine: torch.Tensor) -> torch.Tensor:
    """(N,) range of the first tuft or bump met before the ground at t, else t: looked for where a
    ray is low enough, from the sensor on, in TUFT_STEPS steps."""
    step = (max(ground.rough, ground.litter) / cosine).clip(max=TUFTS_HIDE) / TUFT_STEPS
    met, ends = t.clone(), start[1] + torch.stack([t, t - TUFT_STEPS * step]) * way[1]
    wayside = ((ends > ground.curb_left - ground.parking)
               | (ends < ground.curb_right + ground.parking)).any(0)
    left = torch.nonzero(wayside)[:, 0]  # the road itself is nowhere as high
    for k in range(TUFT_STEPS - 1, -1, -1):
        left = left if k else torch.nonzero(met == t)[:, 0]
        back = k * step[left]
        x, y = start[:2, left] + (t[left] - back) * way[:2, left]
        top = tufts(ground, x, y, back * cosine[left])
        above = top / cosine[left]  # the ray is as high so far before t
        hit = above > back
        found = left[hit]
        met[found] = t[found] - torch.minimum(above[hit], back[hit] + step[found])
        left = left[~hit]
    return met


def tufts(ground: Ground, x: torch.Tensor, y: torch.Tensor, least=0.0) -> torch.Tensor:
    """(N,) height of what grows and lies at x, y, in patches with nearly bare ground between;
    0 where it is surely not above least, a number or (N,)."""
    height = torch.zeros_like(x)
    patch = ((_bumps(x / PATCH, y / PATCH) - BARE) * RISE).clip(EVEN, 1.0)
    high = torch.nonzero(patch * max(ground.rough, ground.litter) > least)[:, 0]
    x, y, patch = x[high], y[high], patch[high]
    semantic, _ = _surface(ground, x, y, torch.zeros_like(x, dtype=torch.bool))
    paved = semantic == ROAD
    most = torch.where(paved | (semantic == GRASS), ground.rough, ground.litter)
    height[high] = torch.where(paved, PAVED, patch) * most * _bumps(x, y)
    return height


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
