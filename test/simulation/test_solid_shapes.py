"""Sizes, parts and poses of scene objects."""

from functools import cache, partial

import numpy as np
import pytest

from lidar_perception.simulation.raycast import cast_rays
from lidar_perception.simulation.returns import make_returns
from lidar_perception.simulation.sensor import HDL64E, NO_MOTION
from lidar_perception.simulation.shapes import (
    buildings,
    cyclists,
    furniture,
    heavy_vehicles,
    people,
    vegetation,
    vehicles,
)
from lidar_perception.simulation.shapes.primitives import block, disc, rod
from lidar_perception.simulation.shapes.scene_object import SIZES, draw_size
from lidar_perception.simulation.shapes.vehicles import SIDE_GAP_M
from lidar_perception.simulation.solids import compute_extents, make_parts, place_parts
from lidar_perception.simulation.terrain import Ground
from lidar_perception.types import CLASSES

pytestmark = pytest.mark.no_cover  # covered by other tests

SEEDS = range(12)
LABELLED = {
    "walker": (partial(people.make_pedestrian, speed=1.3), 16),
    "child": (partial(people.make_pedestrian, speed=0.8, child=True), 16),
    "stander": (partial(people.make_pedestrian, speed=0.0), 16),
    "leaning": (partial(people.make_pedestrian, speed=0.0, lean=0.2), 16),
    "backpack": (partial(people.make_pedestrian, speed=1.2, carried="backpack"), 16),
    "sitting": (people.make_sitting_person, 18),
    "on bench": (partial(people.make_sitting_person, has_chair=False), 16),
    "cyclist": (cyclists.make_cyclist, 20),
    "motorcyclist": (cyclists.make_motorcyclist, 24),
    "car": (vehicles.make_car, 36),
    "parked": (partial(vehicles.make_car, driver=False), 36),
    "van": (vehicles.make_van, 34),
    "truck": (heavy_vehicles.make_truck, 32),
    "bus": (heavy_vehicles.make_bus, 32),
    "tram": (heavy_vehicles.make_tram, 32),
}
SCENERY = {
    **{
        f.__name__: (f, 8)
        for f in (
            furniture.make_pole,
            furniture.make_lamp,
            *furniture.PERSON_SIZED,
            cyclists.make_bicycle,
            cyclists.make_motorcycle,
            vegetation.make_tree,
            vegetation.make_conifer,
            vegetation.make_bush,
            vegetation.make_shrub,
        )
    },
    **{
        f.__name__: (partial(f, length=7.0), 8)
        for f in (furniture.make_fence, furniture.make_wall, vegetation.make_hedge)
    },
    "building": (partial(buildings.make_building, length=15.0, depth=10.0, storeys=4), 40),
    "cottage": (partial(buildings.make_building, length=6.0, depth=8.0, storeys=1), 40),
}
SEMANTICS = {10, 11, 15, 16, 18, 20, 30, 31, 32, 50, 51, 70, 71, 80, 81, 99}


def draw_parts(make, seed):
    """Return the parts of an object, labelled or not."""
    obj = make(np.random.default_rng(seed))
    return obj.parts(0.7) if hasattr(obj, "parts") else obj


def find_extents(parts):
    low, high = compute_extents(parts)
    return low.min(axis=0), high.max(axis=0)


def find_stride(obj):
    return 2 * obj.parts.keywords["build"].step


@pytest.mark.parametrize("name", [*LABELLED, *SCENERY])
def test_solids_of_every_shape_are_valid(name):
    make, max_count = {**LABELLED, **SCENERY}[name]
    for seed in SEEDS:
        parts = draw_parts(make, seed)
        assert 0 < len(parts) <= max_count
        assert np.isin(parts["kind"], (0, 1, 2)).all()
        assert set(parts["semantic"].tolist()) <= SEMANTICS
        for field in ("centre", "half_size", "pitch", "yaw"):
            assert np.isfinite(parts[field]).all(), field
        assert (parts["half_size"] > 0).all() and (parts["density"] > 0).all()
        assert (parts["reflectance"] >= 0).all() and (parts["reflectance"] <= 1).all()
        assert (parts["transmission"] >= 0).all() and (parts["transmission"] < 1).all()


@pytest.mark.parametrize("name", LABELLED)
def test_box_covers_body_of_labelled_object(name):
    make, _ = LABELLED[name]
    for seed in SEEDS:
        obj = make(np.random.default_rng(seed))
        assert obj.label in CLASSES
        low, high = compute_extents(obj.parts(0.0))
        is_body = np.abs((low + high)[:, 1] / 2) < obj.size[1] / 2  # without the mirrors
        low, high = low[is_body].min(axis=0), high[is_body].max(axis=0)
        length, width, height = obj.size
        width -= 2 * SIDE_GAP_M if name in ("car", "parked", "van") else 0.0
        if obj.label != "Pedestrian":
            assert np.allclose(low, (-length / 2, -width / 2, 0.0), atol=1e-6)
            assert np.allclose(high, (length / 2, width / 2, height), atol=1e-6)
        assert np.isclose(high[1] - low[1], width)
        assert (~is_body).sum() <= 2


@pytest.mark.parametrize("name", ["walker", "child", "stander", "leaning", "backpack"])
def test_box_contains_pedestrian_during_the_entire_stride(name):
    make, _ = LABELLED[name]
    for seed in SEEDS:
        obj = make(np.random.default_rng(seed))
        hulls = [find_extents(obj.parts(x)) for x in np.linspace(0, find_stride(obj), 101)]
        low, high = np.array(hulls).transpose(1, 0, 2)
        assert np.abs(low[:, 2]).max() < 1e-9  # a foot is always on the ground
        assert high[:, 2].max() <= obj.size[2] + 0.002
        assert high[:, 2].max() > obj.size[2] - 0.005
        assert np.isclose(high[:, 1].max(), obj.size[1] / 2)
        if name not in ("stander", "leaning"):
            assert abs(low[:, 0].min() + obj.size[0] / 2) < 0.01
            assert abs(high[:, 0].max() - obj.size[0] / 2) < 0.01


def test_leaning_person_tilts_backwards_over_fixed_feet():
    upright, leaning = (people.make_pedestrian(np.random.default_rng(3), 0.0, lean=lean) for lean in (0.0, 0.2))
    before, after = upright.parts(0.0), leaning.parts(0.0)
    face, feet = 0, slice(-2, None)
    assert np.allclose(before["centre"][:, 1:], after["centre"][:, 1:])
    backwards = (before["centre"] - after["centre"])[:, 0]
    height = after["centre"][face, 2] - after["centre"][feet, 2].mean()
    assert backwards[face] - backwards[feet].mean() == pytest.approx(np.tan(0.2) * height)
    assert leaning.size[0] > upright.size[0] and leaning.size[1:] == upright.size[1:]
    # Thighs follow the tilt: their ends are still at the hips and the knees.
    axis = np.sin(after["pitch"]) * np.cos(after["yaw"]), np.cos(after["pitch"])
    thigh = after["half_size"][-6, 2] * np.array([axis[0][-6], axis[1][-6]])
    expected = (
        before["half_size"][-6, 2]
        * np.array([np.sin(before["pitch"]) * np.cos(before["yaw"]), np.cos(before["pitch"])])[:, -6]
    )
    expected[0] -= np.tan(0.2) * expected[1]
    assert np.allclose(np.abs(thigh), np.abs(expected), atol=0.02)


def test_some_cars_are_long_or_pick_ups():
    rng = np.random.default_rng(0)
    cars = [vehicles.make_car(rng) for _ in range(400)]
    lengths = np.array([car.size[0] for car in cars])
    assert 0.05 < (lengths > 4.85).mean() < 0.2 and lengths.max() < 6.0
    bed = vehicles.make_body((5.5, 1.95, 1.85), vehicles.PICK_UP, 0.3, 0.8)
    low, high = compute_extents(bed)
    is_above = (low[:, 0] < -1.5) & (high[:, 0] > -1.5) & (low[:, 1] < 0.0) & (high[:, 1] > 0.0)
    assert high[is_above, 2].max() < 0.45 * 1.85  # the floor of the bed, between its walls


def test_foot_on_the_ground_does_not_slide():
    for seed in SEEDS:
        obj = people.make_pedestrian(np.random.default_rng(seed), 1.3)
        distances = np.linspace(0, find_stride(obj), 401)
        feet = np.array([obj.parts(x)[-2:] for x in distances])
        tip = (
            feet["centre"][..., 0]
            + feet["half_size"][..., 0] * np.cos(feet["pitch"])
            + (distances[:, None] - feet["half_size"][..., 2] * np.sin(feet["pitch"]))
        )
        sole = np.array([compute_extents(f)[0][:, 2] for f in feet])
        is_standing = (sole[1:] < 1e-9) & (sole[:-1] < 1e-9)
        assert (is_standing.any(axis=1)).all()
        assert np.abs(np.diff(tip, axis=0)[is_standing]).max() < 1e-6
        assert 0.5 < is_standing.mean() < 0.7


def test_walk_repeats_after_stride_and_mirrors_after_step():
    obj = people.make_pedestrian(np.random.default_rng(3), 1.4)
    now, later = obj.parts(0.2), obj.parts(0.2 + find_stride(obj))
    assert np.allclose(now["centre"], later["centre"])
    low, high = compute_extents(now)
    low_step, _ = compute_extents(obj.parts(0.2 + find_stride(obj) / 2))
    assert np.allclose(np.sort(low[:, 0]), np.sort(low_step[:, 0]))
    assert np.allclose(np.sort(high[:, 1]), np.sort(-low_step[:, 1]))


def test_leg_segments_keep_their_length():
    """Thighs and shanks have the same length in every pose."""
    obj = people.make_pedestrian(np.random.default_rng(4), 1.4)
    height = obj.size[2]
    for x in np.linspace(0, find_stride(obj), 50):
        thigh, shank = (obj.parts(x)[[-6, -5]], obj.parts(x)[[-4, -3]])
        for row in (*thigh, *shank):
            assert 0.24 * height < 2 * row["half_size"][2] < 0.25 * height


def test_faster_walkers_take_longer_steps():
    lengths = [people.make_pedestrian(np.random.default_rng(1), speed).size[0] for speed in (0.5, 0.8, 1.1, 1.4)]
    assert (np.diff(lengths) > 0).all()


@pytest.mark.parametrize("carried", people.CARRIED[1:])
def test_baggage_does_not_change_width_or_height_of_box(carried):
    plain = people.make_pedestrian(np.random.default_rng(2), 1.2)
    pedestrian = people.make_pedestrian(np.random.default_rng(2), 1.2, carried=carried)
    assert len(pedestrian.parts(0.0)) > len(plain.parts(0.0))
    assert pedestrian.size[1:] == plain.size[1:]
    low, _ = find_extents(pedestrian.parts(0.3))
    assert abs(low[2]) < 1e-9


def test_wheels_stay_on_road_while_pedals_turn():
    for seed in SEEDS:
        obj = cyclists.make_cyclist(np.random.default_rng(seed))
        poses = [obj.parts(x) for x in np.linspace(0, 5, 41)]
        for parts in poses:
            assert np.allclose(compute_extents(parts[:2])[0][:, 2], 0.0, atol=1e-9)
            low, high = find_extents(parts)
            assert np.allclose(high - low, obj.size, atol=1e-6)
        assert not np.array_equal(poses[0]["centre"], poses[4]["centre"])


@pytest.mark.parametrize("style", ["HATCHBACK", "SEDAN", "ESTATE", "SUV", "MINIBUS", "PANEL_VAN", "PICK_UP"])
def test_vehicles_are_symmetric(style):
    parts = vehicles.make_body((4.2, 1.7, 1.6), getattr(vehicles, style), 0.3, 0.8, driver=False)
    low, high = compute_extents(parts)
    mirrored = np.stack([low[:, 0], -high[:, 1], low[:, 2], high[:, 0], -low[:, 1], high[:, 2]], 1)
    hulls = np.hstack([low, high])
    deviation = np.abs(mirrored[:, None] - hulls).max(axis=2).min(axis=1)
    assert deviation.max() < 1e-9


def test_beam_can_pass_through_windows_of_car():
    """In the windows of a car only pillars and seats are solid."""
    parts = vehicles.make_body((4.0, 1.65, 1.5), vehicles.HATCHBACK, 0.3, 0.85, driver=False)
    low, high = compute_extents(parts)
    x, z = -0.45, 1.25  # between the pillars in the middle and at the back, above the seats
    is_hit = (low[:, 0] < x) & (x < high[:, 0]) & (low[:, 2] < z) & (z < high[:, 2])
    assert (parts["transmission"][is_hit] > 0.5).all() and is_hit.sum() == 2


def scan_object(obj, distance, yaw, seed):
    """Return the points that an HDL-64E measures on an object at a distance ahead, with z above its bottom."""
    parts = obj.parts(0.4 * seed)
    position = np.tile([distance, 0.0, -1.73], (len(parts), 1))
    solids = place_parts(parts, position, np.full(len(parts), yaw), np.ones(len(parts)), np.zeros((len(parts), 3)))
    hits = cast_rays(solids, Ground(), np.array([0.0, 0.0, 1e4]), HDL64E, NO_MOTION, seed)
    xyz = make_returns(hits, HDL64E, NO_MOTION, np.random.default_rng(seed)).xyz
    return xyz + np.array([0.0, 0.0, 1.73])


def test_fraction_of_low_cyclist_points_matches_kitti():
    """46 % of the points of 10 KITTI cyclists are below 0.42 of their height."""
    fractions = []
    for seed in SEEDS:
        obj = cyclists.make_cyclist(np.random.default_rng(seed))
        heights = scan_object(obj, 20.0, 0.5 * seed, seed)[:, 2]
        fractions.append((heights[heights > 0.15] < 0.42 * obj.size[2]).mean())
    assert 0.40 < np.mean(fractions) < 0.52


@pytest.mark.parametrize("distance, low, high", [(20.0, 0.22, 0.32), (33.0, 0.20, 0.32), (48.0, 0.08, 0.25)])
def test_points_seen_through_car_windows_decrease_with_range(distance, low, high):
    """In KITTI, 38, 31 and 16 % of the points are above 0.65 of the height for 22, 17 and 15 cars seen from
    behind at 12 to 25, 25 to 40 and 40 to 70 m. Their lower parts are often occluded."""
    fractions = []
    for seed in range(16):
        obj = vehicles.make_car(np.random.default_rng(seed))
        heights = scan_object(obj, distance, 0.0, seed)[:, 2] / obj.size[2]
        if (heights > 0.15).sum() >= 8:
            fractions.append((heights[heights > 0.15] > 0.65).mean())
    assert low < np.mean(fractions) < high


@cache
def scan_cars_from_front():
    """Return 24 cars with their points at a distance of 20 m."""
    cars = [vehicles.make_car(np.random.default_rng(seed)) for seed in range(24)]
    return [(car, scan_object(car, 20.0, np.pi + 0.05 * (seed % 5 - 2), seed)) for seed, car in enumerate(cars)]


@pytest.mark.parametrize(
    "zone, low, high", [((0.15, 0.35), 0.04, 0.10), ((0.35, 0.55), 0.12, 0.24), ((0.55, 0.65), 0.45, 0.75)]
)
def test_only_the_bumper_reaches_the_front_of_the_box(zone, low, high):
    """In three height zones of KITTI cars seen from the front (medians of 42 to 59 cars), a quarter of the points
    are within 0.07, 0.17 and 0.60 m of the front of the box."""
    depths = []
    for obj, points in scan_cars_from_front():
        x, y, z = points.T
        is_hit = (
            (np.abs(y) < 0.45 * obj.size[1]) & (z > zone[0] * obj.size[2]) & (z < zone[1] * obj.size[2]) & (x < 21.0)
        )
        depths.append(np.percentile(x[is_hit] - 20.0 + obj.size[0] / 2, 25))
    assert low < np.median(depths) < high


@pytest.mark.parametrize("length", [3.2, 3.8, 4.5])
def test_car_length_does_not_change_the_seats(length):
    parts = vehicles.make_body((length, 1.65, 1.5), vehicles.HATCHBACK, 0.3, 0.8, driver=False)
    seats = parts[np.isclose(parts["transmission"], 0.75)]
    assert len(seats) == 2 and np.ptp(seats["centre"][:, 0]) > 0.4


@pytest.mark.parametrize("label", SIZES)
def test_drawn_sizes_follow_the_size_table(label):
    rng = np.random.default_rng(0)
    sizes = np.array([draw_size(rng, label) for _ in range(4000)])
    mean, spread, correlation = SIZES[label]
    assert np.allclose(sizes.mean(axis=0), mean, atol=0.06 * np.array(spread))
    assert np.allclose(sizes.std(axis=0), spread, rtol=0.2)
    assert abs(np.corrcoef(sizes[:, 0], sizes[:, 2])[0, 1] - correlation) < 0.08
    assert (sizes > 0.2).all()


def test_size_table_agrees_with_labels(data):
    """The table agrees with the labels of the sample up to rounding."""
    rows = {}
    for path in (data / "kitti_object/training/label_2").glob("*.txt"):
        for line in path.read_text().splitlines():
            name, *rest = line.split()
            rows.setdefault((name, len(rows)), np.array(rest, float)[[9, 8, 7]])
    for line in (data / "kitti_tracking/training/label_02/0000.txt").read_text().splitlines():
        _, track, name, *rest = line.split()
        rows[name, "track", track] = np.array(rest, float)[[9, 8, 7]]
    for label, (mean, spread, _) in SIZES.items():
        sizes = np.array([size for key, size in rows.items() if key[0] == label])
        if label == "Person_sitting":
            assert not len(sizes)
            continue
        assert np.allclose(sizes.mean(axis=0), mean, rtol=0.01)
        assert np.allclose(sizes.std(axis=0), spread, atol=0.06)


@pytest.mark.parametrize("name", SCENERY)
def test_scenery_stands_on_the_ground(name):
    make, _ = SCENERY[name]
    for seed in SEEDS:
        low, high = find_extents(draw_parts(make, seed))
        assert low[2] <= 1e-9 < high[2]


def test_rods_discs_and_blocks_have_exact_extents():
    rows = [rod((0, 0, 0), (3, 4, 12), 1e-6, 0.3), disc((1, 2, 3), 0.5, 0.1, 0.3), block((1, -1, 2), (0, 1, 0), 0.3)]
    parts = make_parts(rows, 10)
    low, high = compute_extents(parts)
    assert np.allclose(low, [(0, 0, 0), (0.5, 1.9, 2.5), (0, -1, 0)], atol=1e-5)
    assert np.allclose(high, [(3, 4, 12), (1.5, 2.1, 3.5), (1, 1, 2)], atol=1e-5)
