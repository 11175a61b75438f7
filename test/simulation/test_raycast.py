"""Ray casting of solids, foliage and glass."""

from dataclasses import replace

import numpy as np
import pytest
from raycast_samples import FULL, OVER_ROAD, SENSOR, make_crowd, make_solids

from lidar_perception.simulation import foliage
from lidar_perception.simulation.hashing import hash_uniform
from lidar_perception.simulation.raycast import cast_rays
from lidar_perception.simulation.returns import make_returns
from lidar_perception.simulation.sensor import NO_MOTION, Motion, make_generic_sensor, make_rays
from lidar_perception.simulation.solids import BOX, CYLINDER, ELLIPSOID
from lidar_perception.simulation.terrain import Ground

pytestmark = pytest.mark.no_cover  # covered by other tests

WIDE = replace(SENSOR, divergence=8e-3)
NO_GROUND = np.array([0.0, 0.0, 1e4])
DRIVE = Motion((12.0, -1.0, 0.2), 0.8, stamp=0.3)


def cast_by_brute_force(objects, sensor, motion=NO_MOTION):
    """Return range, solid (columns, rings) and reached, from tests of every solid with every ray."""
    rays = make_rays(sensor, motion)
    nearest = np.full(rays.direction.shape[:2], np.inf)
    solid, ray_counts = np.full(nearest.shape, -1), {}
    for i in range(len(objects)):
        centre = objects.centre[i] + objects.velocity[i] * rays.times[:, None, None]
        o = (rays.origin - centre) @ objects.axes[i] / objects.half_size[i]
        d = rays.direction @ objects.axes[i] / objects.half_size[i]
        o = np.broadcast_to(o, d.shape)
        with np.errstate(all="ignore"):
            slab = np.sort(np.stack([(-1 - o) / d, (1 - o) / d]), axis=0)
            flat = slice(0, 2) if objects.kind[i] == CYLINDER else slice(0, 3)
            a, b = (d[..., flat] ** 2).sum(-1), (o * d)[..., flat].sum(-1)
            root = np.sqrt(b * b - a * ((o[..., flat] ** 2).sum(-1) - 1))
            quadric = (-b - root) / a, (-b + root) / a
            if objects.kind[i] == BOX:
                enter, leave = slab[0].max(-1), slab[1].min(-1)
            elif objects.kind[i] == ELLIPSOID:
                enter, leave = quadric
            else:
                enter = np.maximum(quadric[0], slab[0][..., 2])
                leave = np.minimum(quadric[1], slab[1][..., 2])
        t = np.where((enter <= leave) & (enter > 0) & (enter <= sensor.max_range), enter, np.inf)
        owner = int(objects.owner[i])
        ray_counts[owner] = ray_counts.get(owner, False) | (t < np.inf)
        solid = np.where(t < nearest, i, solid)
        nearest = np.minimum(nearest, t)
    return nearest, solid, {k: v.sum() for k, v in ray_counts.items() if k}


def are_equal(one, other):
    return all(np.array_equal(a, b) for a, b in zip(one, other))


@pytest.mark.parametrize("motion", [NO_MOTION, DRIVE])
@pytest.mark.parametrize("seed", range(4))
def test_hits_equal_brute_force(seed, motion):
    objects = make_crowd(seed)
    for sensor in (SENSOR, replace(SENSOR, lifts=(), elevations=tuple(np.linspace(1.4, -1.4, 9)))):
        hits = cast_rays(objects, Ground(), NO_GROUND, sensor, motion)
        nearest, solid, ray_counts = cast_by_brute_force(objects, sensor, motion)
        assert (nearest < np.inf).sum() > 50
        assert np.allclose(hits.range, nearest, rtol=1e-9)
        assert np.array_equal(hits.solid, solid)
        assert np.array_equal(hits.owner, np.where(solid < 0, 0, objects.owner[solid]))
        assert {k: n for k, n in enumerate(hits.unoccluded_counts) if n} == {k: n for k, n in ray_counts.items() if n}


def make_foliage(seed):
    objects, rng = make_crowd(seed), np.random.default_rng(seed)
    return replace(
        objects,
        density=np.where(rng.random(60) < 0.4, 1.0, np.inf),
        transmission=np.where(rng.random(60) < 0.3, 0.5, 0.0),
    )


def test_hits_depend_on_seed_only():
    for seed, motion in ((0, NO_MOTION), (1, DRIVE)):
        scene = make_foliage(seed), FULL._replace(tuft_height=0.05), OVER_ROAD, WIDE, motion
        one = cast_rays(*scene, seed)
        assert are_equal(one, cast_rays(*scene, seed))
        for other in (9, -1, (1 << 90) + 5):
            assert not np.array_equal(cast_rays(*scene, other).range, one.range)


@pytest.mark.parametrize("motion", [NO_MOTION, DRIVE])
def test_joint_cast_gives_the_nearest_of_single_casts(motion):
    """Cast overlapping solids in high grass, most without an owner. Neither order nor skipping changes the
    result."""
    count, rng = 160, np.random.default_rng(0)
    objects = make_crowd(5, count)
    far = np.linalg.norm(objects.centre[:, :2], axis=1)[:, None]
    objects = replace(
        objects,
        centre=objects.centre * (5 + 0.3 * far) / far - [0, 0, 1],
        half_size=0.6 * objects.half_size,
        density=np.where(rng.random(count) < 0.3, 1.0, np.inf),
        owner=np.where(rng.random(count) < 0.7, 0, objects.owner).astype(np.int32),
    )
    ground = FULL._replace(tuft_height=0.8, litter_height=0.6, camber=0.03, curb_left=3.0, curb_right=-2.0)
    hits = cast_rays(objects, ground, OVER_ROAD, SENSOR, motion)
    nearest = cast_rays(objects.take(np.arange(0)), ground, OVER_ROAD, SENSOR, motion)._asdict()
    for i in range(count):
        # The other solids are out of reach, so that solid i keeps its index.
        single_solid = replace(objects, centre=np.where(np.arange(count)[:, None] == i, objects.centre, 1e4))
        is_hit = cast_rays(single_solid, Ground(), NO_GROUND, SENSOR, motion)
        nearer = is_hit.range < nearest["range"]
        assert (is_hit.solid[nearer] == i).all()
        for name in nearest.keys() - {"unoccluded_counts"}:
            nearest[name] = np.where(nearer, getattr(is_hit, name), nearest[name])
    assert len(np.unique(hits.solid)) > 80 and 0.1 < (hits.solid < 0).mean() < 0.9
    for name in nearest.keys() - {"unoccluded_counts"}:
        assert np.array_equal(getattr(hits, name), nearest[name]), name


def test_wall_is_flat_only_after_motion_compensation():
    wall = make_solids(BOX, (10, 0, 0), (1, 40, 8))
    exact = replace(SENSOR, range_noise=0.0, dropout=0.0)
    hits = cast_rays(wall, Ground(), NO_GROUND, exact, DRIVE)
    flat, raw = (
        make_returns(hits, exact, DRIVE, np.random.default_rng(0), compensated) for compensated in (True, False)
    )
    assert len(flat.xyz) > 1000 and np.abs(flat.xyz[:, 0] - 9).max() < 1e-5
    assert np.ptp(raw.xyz[:, 0]) > 0.1
    static_hits = cast_rays(wall, Ground(), NO_GROUND, exact)
    returns = make_returns(static_hits, exact, NO_MOTION, np.random.default_rng(0), False)
    assert np.ptp(returns.xyz[:, 0]) < 1e-5


@pytest.fixture
def even_leaves(monkeypatch):
    """Fill every cell of foliage with leaves."""
    monkeypatch.setattr(foliage, "LEAF_FRACTION", 1.0)


def test_leaf_clumps_do_not_change_during_a_drive():
    """Two casts with different random numbers hit leaves in the same cells, a fraction LEAF_FRACTION of all."""
    fine = make_generic_sensor(64, -8.0, 8.0, 0.1, 10.0, divergence=0.0)
    plant = make_solids(BOX, (12, 0, 0), (3, 3, 3), density=2.0)
    filled = []
    for seed in (1, 2):
        hits = cast_rays(plant, Ground(), NO_GROUND, fine, seed=seed)
        is_hit = np.isfinite(hits.range)
        xyz = fine.compute_directions()[is_hit] * hits.range[is_hit][:, None] - [12, 0, 0]
        filled.append({tuple(c) for c in np.floor(xyz / foliage.CELL_M).astype(int)})
        assert len(xyz) > 2000
    both = filled[0] & filled[1]
    assert len(both) > 0.6 * min(map(len, filled))
    front = {c for c in filled[0] | filled[1] if c[0] == -6}  # the first layer, 12 by 5 visible cells
    visible = {(-6, y, z) for y in range(-5, 5) for z in range(-2, 2)}
    assert 0.08 < len(front & visible) / len(visible) < 0.5


@pytest.mark.parametrize("kind", [BOX, ELLIPSOID, CYLINDER])
def test_foliage_stops_rays_after_mean_free_path(kind, even_leaves):
    fine = make_generic_sensor(32, -8.0, 8.0, 0.2, 10.0, divergence=0.0)
    thin, thick = (
        cast_rays(make_solids(kind, (12, 0, 0), (3, 3, 3), density=density), Ground(), NO_GROUND, fine, seed=5)
        for density in (np.inf, 0.7)
    )
    shell = np.isfinite(thin.range)
    path = thick.range[shell] - thin.range[shell]
    assert shell.sum() > 1000 and (path > 0).all()
    # In deep foliage, path lengths are exponentially distributed up to 2 m.
    middle = shell & (np.abs(fine.compute_directions()[..., 1]) < 0.1)
    path = (thick.range - np.where(shell, thin.range, 0))[middle]
    for depth in (0.5, 1.0, 2.0):
        assert abs((path > depth).mean() - np.exp(-0.7 * depth)) < 4 * 0.5 / np.sqrt(len(path))
    assert thick.unoccluded_counts[1] == np.isfinite(thick.range).sum() < thin.unoccluded_counts[1]


def test_ray_from_inside_a_solid_hits_only_foliage(even_leaves):
    inside = [
        cast_rays(make_solids(ELLIPSOID, (0.5, 0, 0), (4, 4, 4), density=density), Ground(), NO_GROUND, SENSOR).range
        for density in (np.inf, 1.0)
    ]
    assert not np.isfinite(inside[0]).any()
    assert abs((inside[1] < 1).mean() - (1 - np.exp(-1))) < 0.03 and inside[1].min() > 0


def test_glass_transmits_the_given_fraction_of_rays():
    panes = make_solids([BOX, BOX], [(8, 0, 0), (12, 0, 0)], (0.01, 3, 2), [1, 2], transmission=0.7)
    panes = replace(panes, transmission=np.array([0.7, 0.0]))
    fine = make_generic_sensor(32, -5.0, 5.0, 0.1, 10.0, divergence=0.0)
    hits = cast_rays(panes, Ground(), NO_GROUND, fine)
    front = np.abs(fine.compute_directions()[..., 1]) < 0.2
    front &= fine.compute_directions()[..., 0] > 0
    fraction = (hits.owner[front] == 2).mean()
    assert abs(fraction - 0.7) < 4 * 0.46 / np.sqrt(front.sum())
    assert set(np.unique(hits.owner[front])) == {1, 2}


def test_nearest_solid_is_hit_and_occluded_rays_are_counted():
    both = make_solids([BOX, BOX], [(9, 0, 0), (5, 0, 0)], (0.5, 0.5, 1.0), [2, 1])
    hits = cast_rays(both, Ground(), OVER_ROAD, SENSOR)
    hit_counts = np.bincount(hits.owner.ravel(), minlength=3)
    assert (hits.range[0][hits.owner[0] == 1] < 5.0).all()
    assert hit_counts[1] == hits.unoccluded_counts[1] and hit_counts[2] < 0.4 * hits.unoccluded_counts[2]


def test_beam_on_an_edge_returns_either_surface_or_a_mixture():
    near, far = (BOX, (5, 0, 0), (0.2, 1, 1)), (BOX, (5.7, 0, 0), (0.2, 9, 4))
    objects = make_solids(*zip(near, far), [1, 2])
    fine = make_generic_sensor(64, -10.0, 10.0, 0.2, 10.0, divergence=3e-3)
    exact = cast_rays(objects, Ground(), NO_GROUND, replace(fine, divergence=0.0))
    beams = cast_rays(objects, Ground(), NO_GROUND, fine)
    is_mixed = beams.owner == 0
    is_mixed &= np.isfinite(beams.range)
    low, high = exact.range[exact.owner > 0].min(), exact.range[exact.owner > 0].max()
    assert is_mixed.sum() > 10 and ((beams.range > low) & (beams.range < high))[is_mixed].all()
    unchanged = beams.range == exact.range
    assert 0.9 < unchanged[exact.owner > 0].mean() < 1
    x = (fine.compute_directions() * np.where(np.isfinite(beams.range), beams.range, 0)[..., None])[..., 0]
    assert (np.abs(x[beams.owner == 1] - 4.8) < 0.01).all()  # points with an owner are on its surface
    apart = cast_rays(replace(objects, centre=objects.centre + [[0, 0, 0], [3, 0, 0]]), Ground(), NO_GROUND, fine)
    assert (apart.owner[np.isfinite(apart.range)] > 0).all()  # too far apart for mixed returns
    assert np.array_equal(beams.unoccluded_counts, exact.unoccluded_counts)


def test_beam_on_single_surface_equals_ray():
    objects = make_solids(BOX, (8, 0, 0), (1, 200, 200))
    one, other = (cast_rays(objects, Ground(), NO_GROUND, s) for s in (SENSOR, WIDE))
    is_inner = np.isfinite(np.roll(one.range, 1, 0)) & np.isfinite(np.roll(one.range, -1, 0))
    assert np.array_equal(one.range[is_inner], other.range[is_inner])


def test_hashed_numbers_are_uniform_and_reproducible():
    def draw_numbers(seed, count=40_000):
        return np.array([hash_uniform(seed, np.uint64((7 << 32) + i)) for i in range(count)])

    u = draw_numbers(3)
    assert 0 < u.min() and u.max() < 1 and len(np.unique(u)) == len(u)
    assert np.abs(np.histogram(u, 20, (0, 1))[0] - 2000).max() < 5 * np.sqrt(2000)
    assert abs(np.corrcoef(u[1:], u[:-1])[0, 1]) < 0.02
    assert abs(np.corrcoef(u, draw_numbers(4))[0, 1]) < 0.02
    assert np.array_equal(draw_numbers(3, 9), u[:9])
