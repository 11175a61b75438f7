"""Intersection of rays with the ground."""

from dataclasses import replace

import numpy as np
import pytest
from numba import njit
from raycast_samples import FULL, OVER_ROAD, SENSOR, make_crowd

from experiments.realism.roughness import compute_roughness
from lidar_perception.simulation.raycast import cast_rays
from lidar_perception.simulation.sensor import HDL64E, make_rays
from lidar_perception.simulation.terrain import (
    Ground,
    cast_ground,
    compile_ground,
    compute_ground_height,
    compute_tuft_height,
)

pytestmark = pytest.mark.no_cover  # covered by other tests


def test_range_to_flat_ground_is_height_over_sine():
    plain = replace(SENSOR, lifts=())
    hits = cast_rays(make_crowd(0, 0), Ground(), OVER_ROAD, plain)
    sine = -np.sin(np.array(plain.elevations))
    expected = np.where(sine > 0, plain.height / np.where(sine > 0, sine, 1), np.inf)
    expected[expected > plain.max_range] = np.inf
    assert np.allclose(hits.range, expected[None], rtol=1e-9)
    assert (hits.owner == 0).all() and (hits.solid == -1).all()


def cast_on_ground(ground, position=(3.0, 0.4), sensor=None):
    sensor = sensor or replace(SENSOR, azimuth_step=np.radians(0.5))
    position = np.array([*position, compute_ground_height(ground, *position) + sensor.height])
    hits = cast_rays(make_crowd(0, 0), ground, position, sensor)
    is_hit = np.isfinite(hits.range)
    rays = make_rays(sensor)
    xyz = position + rays.origin + rays.direction * np.where(is_hit, hits.range, 0.0)[..., None]
    return xyz[is_hit], hits.semantic[is_hit], is_hit, hits


@pytest.mark.parametrize(
    "ground", [FULL, FULL._replace(crossings=()), FULL._replace(wave_height=0.0, camber=0.05), Ground(0.02, -0.03, 0.1)]
)
def test_hit_lies_on_the_ground_surface(ground):
    xyz, semantic, is_hit, _ = cast_on_ground(ground)
    x, y, z = xyz.T
    error = z - compute_ground_height(ground, x, y)
    edges = [np.abs(y - ground.curb_left), np.abs(y - ground.curb_right)]
    edges += [np.abs(x - end) for pair in ground.crossings for end in pair]
    curb = (np.min(edges, axis=0) < 1e-6) & (semantic == 48)
    assert np.abs(error[~curb]).max() < 2e-3
    assert np.abs(error[curb]).max(initial=0) <= ground.curb_height + 1e-6
    assert is_hit[:, -12:].mean() > 0.99
    if ground.curb_height:
        assert curb.sum() > 50 and (y > ground.curb_left).any() and (y < ground.curb_right).any()


def test_no_ray_passes_through_ground():
    _, _, is_hit, hits = cast_on_ground(FULL)
    sensor = replace(SENSOR, azimuth_step=np.radians(0.5))
    rays, start = make_rays(sensor), np.array([3.0, 0.4, compute_ground_height(FULL, 3.0, 0.4) + 1.7])
    for fraction in np.linspace(0.02, 0.995, 40):
        direction = rays.direction * (np.where(is_hit, hits.range, 0.0) * fraction)[..., None]
        x, y, z = ((start + rays.origin + direction)[is_hit]).T
        assert (z - compute_ground_height(FULL, x, y)).min() > -2e-3


def test_road_sidewalk_and_grass_have_separate_classes():
    xyz, semantic, _, _ = cast_on_ground(FULL, sensor=replace(SENSOR, azimuth_step=np.radians(0.25)))
    x, y, _ = xyz.T
    crossing = ((x > 8) & (x < 15)) | ((x > -30) & (x < -22))
    distance = np.maximum(y - 6, -4 - y)
    is_clear = (np.abs(distance) > 1e-3) & (np.abs(distance + 1.5) > 1e-3) & (np.abs(distance - 2) > 1e-3)
    for edge in (8, 15, -30, -22):
        is_clear &= np.abs(x - edge) > 1e-3
    expected = np.select([crossing, distance < -1.5, distance < 0, distance < 2], [40, 40, 44, 48], 72)
    assert np.array_equal(semantic[is_clear], expected[is_clear])
    assert set(np.unique(semantic)) == {40, 44, 48, 72}


def test_bumps_are_bounded_and_the_same_in_every_scan():
    rough = FULL._replace(tuft_height=0.08, litter_height=0.04)
    (xyz, semantic, _, _), (second_xyz, *_) = cast_on_ground(rough), cast_on_ground(rough)
    assert np.array_equal(xyz, second_xyz)
    error = xyz[:, 2] - compute_ground_height(rough, xyz[:, 0], xyz[:, 1])
    for has_class, max_height in ((semantic == 72, 0.08), (semantic == 40, 0.008), (semantic == 44, 0.04)):
        near = has_class & (np.linalg.norm(xyz[:, :2], axis=1) < 20)
        assert error[near].min() > -0.01 and np.quantile(error[near], 0.99) < 1.3 * max_height
        assert error[near].std() > 0.1 * max_height
    # The same bumps from another viewpoint.
    assert np.isfinite(cast_on_ground(rough, (4.0, 0.4))[0]).all()


def test_grass_is_rough_and_stops_rays():
    meadow = Ground(curb_left=2.0, curb_right=-2.0, sidewalk_width=0.0, tuft_height=0.6)
    xyz, _, is_hit, hits = cast_on_ground(meadow, sensor=HDL64E)
    height = xyz[:, 2] - compute_ground_height(meadow, xyz[:, 0], xyz[:, 1])
    assert -0.01 < height.min() and height.max() < 0.6
    in_grass = np.abs(xyz[:, 1]) > 8  # no tufts of the roadside reach there
    near, middle, far = compute_roughness(xyz[in_grass], np.array([8.0, 12.0, 18.0, 30.0]))
    assert 0.02 < min(near, middle, far) and max(near, middle, far) < 0.1
    _, _, _, smooth = cast_on_ground(meadow._replace(tuft_height=0.0), sensor=HDL64E)
    assert (hits.range[is_hit] <= smooth.range[is_hit] + 1e-9).all()


@njit
def march_to_tufts(ground, start, direction):
    """March along rays in steps of 5 mm and return the first range below the tufts."""
    t = 0.0
    while t < 30.0 and start[2] + t * direction[2] >= compute_tuft_height(
        ground, start[0] + t * direction[0], start[1] + t * direction[1], 0.0
    ):
        t += 0.005
    return t


def test_grass_hits_agree_with_dense_ray_marching():
    rng = np.random.default_rng(1)
    meadow = Ground(curb_left=2.0, curb_right=-2.0, sidewalk_width=0.0, tuft_height=0.5)
    yaw, down = rng.uniform(0.3, 2.8, 400), rng.uniform(0.06, 0.3, 400)
    directions = np.stack([np.cos(yaw) * np.cos(down), np.sin(yaw) * np.cos(down), -np.sin(down)], 1)
    ground, start = compile_ground(meadow), (0.0, 0.0, 1.7)
    error = np.abs(
        [
            cast_ground(ground, start, tuple(direction), 60.0).range - march_to_tufts(ground, start, tuple(direction))
            for direction in directions.tolist()
        ]
    )
    # Steps are longer than tufts are wide, so some tufts are missed and a few are hit too early.
    assert np.quantile(error, 0.5) < 0.1 and np.quantile(error, 0.9) < 0.5


@pytest.mark.parametrize("height, min_range", [(0.3, 0.0), (0.02, -1e-9)])
def test_low_sensor_has_no_hits_at_its_origin(height, min_range):
    """The sensor is lower than the tufts of a meadow next to it and than bumps of the road."""
    meadow = Ground(curb_left=1.0, curb_right=-1.0, sidewalk_width=0.0, tuft_height=0.8)
    low = replace(SENSOR, height=height, lifts=())
    hits = cast_rays(make_crowd(0, 0), meadow, np.array([0.0, 0.0, height]), low)
    assert np.isfinite(hits.range).any() and hits.range.min() > min_range
