"""Rays on the ground."""

from dataclasses import replace

import numpy as np
import pytest
from numba import njit
from raycast_samples import FULL, OVER_ROAD, SENSOR, make_crowd

from experiments.realism.roughness import compute_roughness
from lidar_perception.simulation.raycast import cast_rays
from lidar_perception.simulation.sensor import HDL64E, make_rays
from lidar_perception.simulation.terrain import Ground, cast_ground, surface_height, to_compiled, tuft_height

pytestmark = pytest.mark.no_cover  # covered by other tests


def test_flat_ground_range_is_height_over_sine():
    plain = replace(SENSOR, lifts=())
    hits = cast_rays(make_crowd(0, 0), Ground(), OVER_ROAD, plain)
    sine = -np.sin(np.array(plain.elevations))
    expected = np.where(sine > 0, plain.height / np.where(sine > 0, sine, 1), np.inf)
    expected[expected > plain.max_range] = np.inf
    assert np.allclose(hits.range, expected[None], rtol=1e-9)
    assert (hits.owner == 0).all() and (hits.solid == -1).all()


def cast_on_ground(ground, position=(3.0, 0.4), sensor=None):
    sensor = sensor or replace(SENSOR, azimuth_step=np.radians(0.5))
    position = np.array([*position, surface_height(ground, *position) + sensor.height])
    hits = cast_rays(make_crowd(0, 0), ground, position, sensor)
    met = np.isfinite(hits.range)
    turn = make_rays(sensor)
    at = position + turn.origin + turn.direction * np.where(met, hits.range, 0.0)[..., None]
    return at[met], hits.semantic[met], met, hits


@pytest.mark.parametrize(
    "ground", [FULL, FULL._replace(crossings=()), FULL._replace(wave=0.0, camber=0.05), Ground(0.02, -0.03, 0.1)]
)
def test_hit_is_on_surface_of_ground(ground):
    at, semantic, met, _ = cast_on_ground(ground)
    x, y, z = at.T
    off = z - surface_height(ground, x, y)
    edges = [np.abs(y - ground.curb_left), np.abs(y - ground.curb_right)]
    edges += [np.abs(x - end) for pair in ground.crossings for end in pair]
    curb = (np.min(edges, axis=0) < 1e-6) & (semantic == 48)
    assert np.abs(off[~curb]).max() < 2e-3
    assert np.abs(off[curb]).max(initial=0) <= ground.curb_height + 1e-6
    assert met[:, -12:].mean() > 0.99
    if ground.curb_height:
        assert curb.sum() > 50 and (y > ground.curb_left).any() and (y < ground.curb_right).any()


def test_no_ray_passes_through_ground():
    _, _, met, hits = cast_on_ground(FULL)
    sensor = replace(SENSOR, azimuth_step=np.radians(0.5))
    turn, start = make_rays(sensor), np.array([3.0, 0.4, surface_height(FULL, 3.0, 0.4) + 1.7])
    for share in np.linspace(0.02, 0.995, 40):
        way = turn.direction * (np.where(met, hits.range, 0.0) * share)[..., None]
        x, y, z = ((start + turn.origin + way)[met]).T
        assert (z - surface_height(FULL, x, y)).min() > -2e-3


def test_road_sidewalk_and_grass_have_their_classes():
    at, semantic, _, _ = cast_on_ground(FULL, sensor=replace(SENSOR, azimuth_step=np.radians(0.25)))
    x, y, _ = at.T
    crossing = ((x > 8) & (x < 15)) | ((x > -30) & (x < -22))
    out = np.maximum(y - 6, -4 - y)
    sure = (np.abs(out) > 1e-3) & (np.abs(out + 1.5) > 1e-3) & (np.abs(out - 2) > 1e-3)
    for edge in (8, 15, -30, -22):
        sure &= np.abs(x - edge) > 1e-3
    expected = np.select([crossing, out < -1.5, out < 0, out < 2], [40, 40, 44, 48], 72)
    assert np.array_equal(semantic[sure], expected[sure])
    assert set(np.unique(semantic)) == {40, 44, 48, 72}


def test_rough_ground_is_bounded_and_constant():
    rough = FULL._replace(rough=0.08, litter=0.04)
    (at, semantic, _, _), (again, *_) = cast_on_ground(rough), cast_on_ground(rough)
    assert np.array_equal(at, again)
    off = at[:, 2] - surface_height(rough, at[:, 0], at[:, 1])
    for chosen, most in ((semantic == 72, 0.08), (semantic == 40, 0.008), (semantic == 44, 0.04)):
        near = chosen & (np.linalg.norm(at[:, :2], axis=1) < 20)
        assert off[near].min() > -0.01 and np.quantile(off[near], 0.99) < 1.3 * most
        assert off[near].std() > 0.1 * most
    # The same bumps from another viewpoint.
    assert np.isfinite(cast_on_ground(rough, (4.0, 0.4))[0]).all()


def test_grass_is_rough_and_hides_ground_behind():
    meadow = Ground(curb_left=2.0, curb_right=-2.0, walk=0.0, rough=0.6)
    at, _, met, hits = cast_on_ground(meadow, sensor=HDL64E)
    above = at[:, 2] - surface_height(meadow, at[:, 0], at[:, 1])
    assert -0.01 < above.min() and above.max() < 0.6
    wild = np.abs(at[:, 1]) > 8  # no tufts of the roadside reach there
    near, middle, far = compute_roughness(at[wild], np.array([8.0, 12.0, 18.0, 30.0]))
    assert 0.02 < min(near, middle, far) and max(near, middle, far) < 0.1
    _, _, _, smooth = cast_on_ground(meadow._replace(rough=0.0), sensor=HDL64E)
    assert (hits.range[met] <= smooth.range[met] + 1e-9).all()


@njit
def march_to_tufts(ground, start, way):
    """March along rays in steps of 5 mm and return the first range below the tufts."""
    t = 0.0
    while t < 30.0 and start[2] + t * way[2] >= tuft_height(ground, start[0] + t * way[0], start[1] + t * way[1], 0.0):
        t += 0.005
    return t


def test_tuft_hits_equal_slow_march():
    rng = np.random.default_rng(1)
    meadow = Ground(curb_left=2.0, curb_right=-2.0, walk=0.0, rough=0.5)
    yaw, down = rng.uniform(0.3, 2.8, 400), rng.uniform(0.06, 0.3, 400)
    ways = np.stack([np.cos(yaw) * np.cos(down), np.sin(yaw) * np.cos(down), -np.sin(down)], 1)
    ground, start = to_compiled(meadow), (0.0, 0.0, 1.7)
    off = np.abs(
        [
            cast_ground(ground, start, tuple(way), 60.0).range - march_to_tufts(ground, start, tuple(way))
            for way in ways.tolist()
        ]
    )
    # Steps are longer than tufts are wide, so some tufts are missed and a few are hit too early.
    assert np.quantile(off, 0.5) < 0.1 and np.quantile(off, 0.9) < 0.5


@pytest.mark.parametrize("height, least", [(0.3, 0.0), (0.02, -1e-9)])
def test_low_sensor_has_no_hits_at_its_origin(height, least):
    """The sensor is lower than the tufts of a meadow next to it and than bumps of the road."""
    meadow = Ground(curb_left=1.0, curb_right=-1.0, walk=0.0, rough=0.8)
    low = replace(SENSOR, height=height, lifts=())
    hits = cast_rays(make_crowd(0, 0), meadow, np.array([0.0, 0.0, height]), low)
    assert np.isfinite(hits.range).any() and hits.range.min() > least
