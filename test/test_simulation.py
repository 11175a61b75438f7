"""Laws of the simulated drive."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from lidar_perception.geometry import box_corners, points_in_box
from lidar_perception.simulation.drive import drive, truth
from lidar_perception.simulation.raycast import BOX, CYLINDER, ELLIPSOID, Solids, cast, measure
from lidar_perception.simulation.scene import make_scene
from lidar_perception.simulation.sensor import HDL64E, Sensor
from lidar_perception.simulation.terrain import Ground, surface_height
from lidar_perception.types import CLASSES, PEDESTRIAN

COARSE = replace(HDL64E, azimuth_step=float(np.radians(0.5)))
EXACT = replace(COARSE, range_noise=0.0, dropout=0.0)
street = cache(make_scene)
OVER_ROAD = np.array([0.0, 0.0, HDL64E.height])


def solids(*rows, axes=None):
    """Solids of rows (kind, centre, half, owner), upright unless axes (P, 3, 3) are given."""
    kind, centre, half, owner = (np.array(column) for column in zip(*rows))
    axes = np.broadcast_to(np.eye(3), (len(rows), 3, 3)) if axes is None else axes
    return Solids(kind, centre.astype(float), half.astype(float), axes, np.full(len(rows), 0.5),
                  owner)


NOTHING = Solids(np.zeros(0, int), np.zeros((0, 3)), np.ones((0, 3)), np.zeros((0, 3, 3)),
                 np.zeros(0), np.zeros(0, int))


def scan(seed, t, sensor=COARSE):
    """Hits, and the measured xyz and owner, of one moment of street(seed)."""
    scene = street(seed)
    moment = scene.at(t, sensor.height)
    hits = cast(moment.solids, scene.ground, moment.position, sensor)
    xyz, _, owner = measure(hits, sensor, np.random.default_rng(0))
    return scene, moment, hits, xyz, owner


def test_same_seed_same_bytes():
    def content(seed):
        return [(f.xyz.tobytes(), f.intensity.tobytes(), f.stamp_ns, t.boxes.tobytes(), t.extras)
                for f, t in drive(seed, 2, COARSE)]
    first = content(3)
    assert first == content(3)
    assert all(a[0] != b[0] for a, b in zip(first, content(4)))


def test_a_longer_drive_starts_like_a_shorter_one():
    short, = drive(1, 1, COARSE)
    long = next(drive(1, 9, COARSE))
    assert np.array_equal(short[0].xyz, long[0].xyz)


def test_frames_are_as_promised():
    for i, (frame, found) in enumerate(drive(0, 3, COARSE)):
        assert frame.xyz.dtype == frame.intensity.dtype == np.float32
        assert frame.xyz.shape == (len(frame.intensity), 3) and frame.xyz.flags.c_contiguous
        assert frame.frame_id == "velodyne"
        assert frame.stamp_ns == 1_700_000_000 * 10**9 + i * 10**8
        reach = np.linalg.norm(frame.xyz.astype(float), axis=1)
        assert reach.min() >= COARSE.min_range and reach.max() <= COARSE.max_range
        assert frame.intensity.min() >= 0.0 and frame.intensity.max() <= 1.0
        assert np.hypot(*found.boxes[:, :2].T).max() <= 80.0
        assert all(e["num_points"] > 0 and e["occluded"] in (0, 1, 2) and e["truncated"] == 0.0
                   for e in found.extras)
        tracks = [e["track_id"] for e in found.extras]
        assert len(set(tracks)) == len(tracks) and min(tracks) > 0


@pytest.mark.parametrize("t", [0.0, 1.7, 3.9])
@pytest.mark.parametrize("seed", [0, 5])
def test_points_of_an_object_lie_in_its_box(seed, t):
    _, moment, hits, xyz, owner = scan(seed, t)
    exact, _, whose = measure(hits, replace(COARSE, range_noise=0.0), np.random.default_rng(0))
    for box, track in zip(moment.boxes, moment.track_ids):
        assert points_in_box(exact[whose == track], box, margin=1e-3).all()
        assert points_in_box(xyz[owner == track], box, margin=6 * COARSE.range_noise).all()
    assert set(np.unique(owner)) <= {0, *moment.track_ids}
    found = truth(moment, hits, owner)
    assert [e["num_points"] for e in found.extras] == [
        (owner == e["track_id"]).sum() for e in found.extras]


@pytest.mark.parametrize("seed", range(3))
def test_boxes_stand_on_the_ground_and_apart(seed):
    scene = street(seed)
    for t in (0.0, 2.0, 10.0, 19.9):
        moment = scene.at(t, 1.73)
        world = moment.boxes[:, :3] + moment.position
        ground = np.array([surface_height(scene.ground, x, y) for x, y, _ in world])
        assert np.abs(world[:, 2] - moment.boxes[:, 5] / 2 - ground).max() < 0.05
        # No two footprints have a corner or a centre of the other inside.
        flat = moment.boxes * [1, 1, 0, 1, 1, 1, 1]
        marks = np.concatenate([box_corners(flat)[:, :4] * [1, 1, 0], flat[:, None, :3]], axis=1)
        for i, box in enumerate(flat):
            assert not points_in_box(np.delete(marks, i, axis=0).reshape(-1, 3), box).any()


def test_pedestrians_walk_in_view_all_the_time():
    for _, found in drive(0, 11, replace(COARSE, rate=2.5)):
        boxes = found.of_class(PEDESTRIAN)
        reach, bearing = np.hypot(boxes[:, 0], boxes[:, 1]), np.arctan2(boxes[:, 1], boxes[:, 0])
        seen = (np.abs(bearing) < np.radians(40)) & (reach > 6) & (reach < 35)
        assert seen.sum() >= 4
        assert np.ptp(reach[seen]) > 5
        assert ((boxes[:, 5] > 1.5) & (boxes[:, 5] <= 1.9)).all()


def test_a_walker_moves_its_legs_and_a_standing_one_does_not():
    scene = street(0)
    boxes = {t: scene.at(t, 1.73) for t in (0.0, 0.3)}
    length = np.array([m.boxes[m.class_ids == PEDESTRIAN, 3] for m in boxes.values()])
    speed = np.array([a.speed for a in scene.actors if a.class_id == PEDESTRIAN])
    assert (np.abs(np.diff(length, axis=0)[0]) > 1e-3)[speed > 0].mean() > 0.9
    assert np.array_equal(*length[:, speed == 0])


def test_flat_ground_is_at_height_over_sine():
    hits = cast(NOTHING, Ground(), OVER_ROAD, EXACT)
    elevation = np.array(EXACT.elevations)
    expected = np.where(elevation < -0.001, EXACT.height / np.sin(-np.minimum(elevation, -1e-3)),
                        np.inf)
    expected[expected > EXACT.max_range] = np.inf
    assert np.allclose(hits.range, expected[None], rtol=1e-9)
    assert (hits.owner == 0).all()


def test_the_ground_is_met_where_it_is():
    ground = street(2).ground
    position = np.array([7.0, 0.0, 1.73])
    hits = cast(NOTHING, ground, position, EXACT)
    met = np.isfinite(hits.range)
    x, y, z = (EXACT.directions()[met] * hits.range[met, None] + position).T
    surface = np.array([surface_height(ground, *at) for at in zip(x, y)])
    at_curb = np.minimum(abs(y - ground.curb_left), abs(y - ground.curb_right)) < 1e-6
    assert np.abs(z - surface)[~at_curb].max() < 0.01
    assert np.abs(z - surface)[at_curb].max() <= ground.curb_height + 1e-6
    assert at_curb.any() and (y > ground.curb_left).any() and (y < ground.curb_right).any()


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("kind", [BOX, ELLIPSOID, CYLINDER])
def test_hits_lie_on_the_surface_and_no_ray_is_missed(kind, side):
    """Against a march along every ray: windows and intersections lose nothing."""
    yaw, pitch = 0.7, 0.4
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    nod = np.array([[np.cos(pitch), 0, np.sin(pitch)], [0, 1, 0],
                    [-np.sin(pitch), 0, np.cos(pitch)]])
    sensor = Sensor(tuple(np.radians(np.linspace(20, -20, 15))), np.radians(2.0), range_noise=0.0)
    centre, half, axes = np.array([side * 6.0, 0.5, 0.3]), np.array([1.5, 0.8, 1.1]), turn @ nod
    thing = solids((kind, centre, half, 1), axes=axes[None])
    hits = cast(thing, Ground(), np.array([0.0, 0.0, 1e4]), sensor)
    steps = np.arange(3.0, 9.0, 0.01)
    unit = (sensor.directions()[..., None, :] * steps[:, None] - centre) @ axes / half
    slabs, disc = np.abs(unit), np.hypot(unit[..., 0], unit[..., 1])
    inside = {BOX: slabs.max(axis=-1), ELLIPSOID: np.linalg.norm(unit, axis=-1),
              CYLINDER: np.maximum(slabs[..., 2], disc)}[kind] < 1
    marched = np.where(inside.any(axis=-1), steps[inside.argmax(axis=-1)], np.inf)
    both = np.isfinite(marched) & np.isfinite(hits.range)
    assert both.sum() > 50
    assert (marched[both] - hits.range[both]).min() >= 0 and np.allclose(
        marched[both], hits.range[both], atol=0.0101)
    assert not (np.isfinite(marched) & ~both).any()  # the march only misses grazing rays
    assert (np.isfinite(hits.range) & ~both).sum() <= 3


def test_nearest_wins_and_occlusion_is_seen():
    near, far = (BOX, (5, 0, 0), (0.5, 0.5, 1.0), 1), (BOX, (9, 0, 0), (0.5, 0.5, 1.0), 2)
    hits = cast(solids(far, near), Ground(), OVER_ROAD, EXACT)
    assert (hits.range[0][hits.owner[0] == 1] < 5.0).all()
    seen = np.bincount(hits.owner.ravel(), minlength=3)
    assert seen[1] == hits.reached[1]
    assert seen[2] < 0.4 * hits.reached[2]


def test_order_of_objects_does_not_matter():
    scene = street(1)
    moment = scene.at(1.0, 1.73)
    order = np.random.default_rng(0).permutation(len(scene.actors))
    shuffled = replace(scene, actors=tuple(scene.actors[i] for i in order)).at(1.0, 1.73)
    first, second = (cast(m.solids, scene.ground, m.position, EXACT) for m in (moment, shuffled))
    assert np.array_equal(first.range, second.range)
    assert len(moment.boxes) == len(shuffled.boxes)


def test_a_scan_looks_like_one_of_the_real_sensor():
    """Numbers of KITTI's scans: 109 000 to 127 000 points, and on a pedestrian in full view
    about 27 000 over the square of its range."""
    frame, found = next(drive(0, 1))
    assert 105_000 < len(frame) < 130_000
    assert 0.15 < frame.intensity.mean() < 0.4
    density = [e["num_points"] * (box[0] ** 2 + box[1] ** 2)
               for box, label, e in zip(found.boxes, found.labels, found.extras)
               if label == "Pedestrian" and e["occluded"] == 0]
    assert 15_000 < np.median(density) < 45_000
    assert {"Car", "Pedestrian", "Cyclist"} <= set(found.labels) <= set(CLASSES)


@pytest.mark.parametrize("arguments, named", [
    ({"frames": 0}, "frames = 0"), ({"frames": 10_000}, "frames = 10000"),
    ({"seed": -1}, "seed = -1")])
def test_bad_input_is_named_at_the_call(arguments, named):
    with pytest.raises(ValueError, match=named) as error:
        drive(**arguments)
    assert "\n" not in str(error.value)
