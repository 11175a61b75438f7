"""Positions and motion of the actors on simulated streets."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from footprint_samples import find_overlaps, make_flat_boxes

from lidar_perception.geometry import box_corners
from lidar_perception.simulation.actors import SPEED, WIDTH, footprints_touch
from lidar_perception.simulation.roadside import is_plant
from lidar_perception.simulation.scene import make_scene
from lidar_perception.simulation.street import STREET_KINDS
from lidar_perception.simulation.terrain import compute_ground_height
from lidar_perception.types import CLASSES, InputError

pytestmark = pytest.mark.no_cover  # covered by other tests

SEEDS = range(3)
STREETS = [(kind, seed) for kind in STREET_KINDS for seed in SEEDS]
SIGN = 81  # SemanticKITTI class
TIMES = (0.0, 4.0, 8.0, 12.0, 16.0)
HEIGHT = 1.73
SITTING, CAR, PEDESTRIAN, CYCLIST = (CLASSES.index(name) for name in ("Person_sitting", "Car", "Pedestrian", "Cyclist"))
make_cached_scene = cache(lambda kind, seed, people=1.0: make_scene(seed, kind, people))


@pytest.mark.parametrize("kind, seed", STREETS)
def test_actors_never_overlap(kind, seed):
    """All objects are compared, including unlabelled ones and the ego vehicle, except people on benches and plants."""
    scene = make_cached_scene(kind, seed)
    props = [a for a in scene.actors if not a.obj.label]
    plants = np.array([is_plant(a) for a in props])
    fixed = make_flat_boxes(np.array([a.footprint for a in props]), 0.0)
    assert not len(find_overlaps(fixed[~plants], sum(~plants)))
    for t in np.linspace(0.0, scene.seconds, 5):
        moment = scene.compute_state(t, HEIGHT)
        ego = np.array([[0.0, 0, 0, 4.6, 1.9, 1, 0]])
        footprints = fixed - [*moment.position[:2], 0, 0, 0, 0, 0]
        boxes = np.concatenate([ego, moment.boxes * [1, 1, 0, 1, 1, 1, 1], footprints])
        for i, j in find_overlaps(boxes, len(moment.boxes) + 1):
            sits = i > 0 and moment.class_ids[i - 1] == SITTING
            assert sits and j > len(moment.boxes), (t, boxes[i], boxes[j])


@pytest.mark.parametrize("kind, seed", STREETS)
def test_objects_stand_on_ground(kind, seed):
    scene = make_cached_scene(kind, seed)
    m = scene.compute_state(5.0, HEIGHT)
    world = m.boxes[:, :3] + m.position
    ground = compute_ground_height(scene.ground, *world[:, :2].T)
    assert np.allclose(world[:, 2] - m.boxes[:, 5] / 2, ground, atol=1e-9)
    low = m.solids.centre[:, 2] - np.abs(m.solids.axes[:, 2] * m.solids.half_size).sum(axis=1)
    for track, box in zip(m.track_ids, m.boxes):
        lowest = low[m.solids.owner == track].min()
        assert abs(lowest - (box[2] - box[5] / 2)) < 0.12
    for actor in [a for a in scene.actors if not a.obj.label][::15]:
        m = replace(scene, actors=(actor,)).compute_state(actor.x / max(scene.trajectory.speed, 0.1), HEIGHT)
        if len(m.solids):
            foot = (
                m.solids.centre[:, 2] - np.abs(m.solids.axes[:, 2] * m.solids.half_size).sum(axis=1)
            ).min() + m.position[2]
            box = make_flat_boxes(actor.footprint[None], 0.0)
            ground = compute_ground_height(scene.ground, *box_corners(box)[0, :4, :2].T)
            assert ground.min() - 1.5 < foot < ground.min() + 0.12


@pytest.mark.parametrize("kind, seed", STREETS)
def test_boxes_move_at_their_speed(kind, seed):
    scene, dt = make_cached_scene(kind, seed), 0.5
    for t in (0.0, 9.0):
        one, two = scene.compute_state(t, HEIGHT), scene.compute_state(t + dt, HEIGHT)
        for m in (one, two):
            assert len(np.unique(m.track_ids)) == len(m.track_ids) and (m.track_ids > 0).all()
        _, i, j = np.intersect1d(one.track_ids, two.track_ids, return_indices=True)
        assert (one.class_ids[i] == two.class_ids[j]).all()
        assert np.array_equal(one.boxes[i, 3:], two.boxes[j, 3:])
        motion = (two.boxes[j, :2] + two.position[:2]) - (one.boxes[i, :2] + one.position[:2])
        heading = one.boxes[i, 6]
        forward = np.cos(heading) * motion[:, 0] + np.sin(heading) * motion[:, 1]
        is_steady = one.speeds[i] == two.speeds[j]
        assert is_steady.mean() > 0.8
        assert np.allclose(forward[is_steady], dt * one.speeds[i][is_steady], atol=1e-9)
        assert np.allclose(np.hypot(*motion.T), forward, atol=1e-9)
        assert (forward <= dt * np.maximum(one.speeds[i], two.speeds[j]) + 1e-9).all()
        sensor_motion = two.position - one.position
        assert np.allclose(sensor_motion[:2], dt * np.array(one.motion.velocity)[:2])


@pytest.mark.parametrize("kind, seed", STREETS)
def test_other_vehicles_keep_a_distance_to_the_ego_vehicle(kind, seed):
    scene = make_cached_scene(kind, seed)
    for t in (0.0, 10.0, 20.0):
        m = scene.compute_state(t, HEIGHT)
        lane = (np.abs(m.boxes[:, 1]) < 1.0) & (np.abs(m.boxes[:, 6]) < 0.1) & (m.class_ids < PEDESTRIAN)
        gap = np.abs(m.boxes[lane, 0]) - m.boxes[lane, 3] / 2 - 2.3
        assert (gap > 0.6 * scene.trajectory.speed).all()


def test_solids_have_velocity_and_class_of_their_object():
    for kind in STREET_KINDS:
        m = make_cached_scene(kind, 0).compute_state(3.0, HEIGHT)
        speed = dict(zip(m.track_ids, m.speeds))
        horizontal_speed = np.hypot(*m.solids.velocity[:, :2].T)
        assert np.allclose(horizontal_speed, [speed.get(o, 0.0) for o in m.solids.owner])
        assert set(m.solids.owner) <= {0, *m.track_ids} >= set(m.track_ids)
        assert 300 < len(m.solids) < 5000
        assert (m.solids.semantic > 0).all() and (m.solids.half_size > 0).all()


def test_traffic_islands_are_at_crossings_outside_lanes():
    count = 0
    for kind, seed in STREETS:
        scene = make_cached_scene(kind, seed)
        islands = [
            a
            for a in scene.actors
            if not a.obj.label and a.speed == 0.0 and 1.3 < a.y < 2.8 and (a.obj.parts(0.0)["semantic"] == SIGN).any()
        ]
        edges = np.ravel(scene.ground.crossings)
        for actor in islands:
            count += 1
            assert np.abs(edges - actor.x).min() <= 15.0
            assert abs(actor.footprint[1]) - actor.footprint[WIDTH] > 1.0  # cars in the ego lane
    assert count > 10


def test_streets_have_about_as_many_objects_as_kitti():
    """The 57 labelled KITTI frames have 1.7 cars, 0.19 pedestrians and 0.14 cyclists within 30 m in
    the camera's view. The limits are wide, because hidden objects have no label there, and the
    numbers are small (11 pedestrians, 8 cyclists)."""
    seeds = range(4)  # cyclists are rare
    fraction = np.array([k.fraction for k in STREET_KINDS.values()])
    counts = np.zeros((len(STREET_KINDS), len(CLASSES)))
    for i, kind in enumerate(STREET_KINDS):
        for seed in seeds:
            for t in TIMES:
                m = make_cached_scene(kind, seed).compute_state(t, HEIGHT)
                in_view = (np.abs(np.arctan2(m.boxes[:, 1], m.boxes[:, 0])) < np.radians(40)) & (
                    np.hypot(*m.boxes[:, :2].T) < 30
                )
                counts[i] += np.bincount(m.class_ids[in_view], minlength=len(CLASSES))
    mean = fraction @ counts / (len(TIMES) * len(seeds))
    assert fraction.sum() == pytest.approx(1.0)
    assert 1.0 < mean[CAR] < 4.5
    assert 0.2 < mean[PEDESTRIAN] < 1.5
    assert 0.05 < mean[CYCLIST] < 0.6
    assert (counts.sum(axis=0)[: len(CLASSES) - 1] > 0).sum() >= 6


def test_people_option_scales_the_number_of_people():
    def count_people(factor):
        labels = [a.obj.label for a in make_cached_scene("residential", 0, factor).actors]
        return sum(label in ("Pedestrian", "Person_sitting", "Cyclist") for label in labels)

    assert count_people(0.0) == 0 < count_people(1.0) < count_people(4.0) / 2


def test_scene_without_objects_has_empty_arrays():
    scene = replace(make_cached_scene("country", 0), actors=())
    m = scene.compute_state(0.0, HEIGHT)
    assert len(m.solids) == 0 and m.solids.axes.shape == (0, 3, 3)
    assert m.boxes.shape == (0, 7) and m.boxes.dtype == np.float64
    assert m.class_ids.shape == m.track_ids.shape == m.speeds.shape == (0,)
    assert m.class_ids.dtype == m.track_ids.dtype == np.int32


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"seed": -1}, "seed = -1"),
        ({"people": -0.5}, "people = -0.5"),
        ({"people": np.nan}, "people = nan"),
        ({"kind": "moon"}, "kind = 'moon' must be one of city"),
    ],
)
def test_error_names_impossible_arguments(arguments, message):
    with pytest.raises(InputError, match=message) as error:
        make_scene(**arguments)
    assert "\n" not in str(error.value)


def test_footprints_touch_equals_dense_sampling():
    rng = np.random.default_rng(0)
    rows = rng.uniform((-6, -6, -3, 0.3, 0.2, 0, 0, 0), (6, 6, 3, 2.5, 1.2, 3, 2, 6), (120, 8))
    rows[::3, SPEED] = 0.0
    rows[1::3, 6:] = 0.0, np.inf
    one, many = rows[0] + [0, 0, 0, 0, 0, 1, 0, 0], rows[1:]
    is_touching = np.array([footprints_touch(one, row, 5.0, 0.0) for row in many])
    is_overlapping = np.zeros(len(many), bool)
    for t in np.linspace(0.0, 5.0, 501):
        boxes = make_flat_boxes(rows, t)
        boxes[0] = make_flat_boxes(one[None], t)[0]
        is_overlapping[[j - 1 for i, j in find_overlaps(boxes, 1)]] = True
    assert 20 < is_touching.sum() < 100
    assert (is_touching >= is_overlapping).all() and (
        is_touching != is_overlapping
    ).sum() <= 2  # contact shorter than a sampling interval
    assert np.array_equal(is_touching, [footprints_touch(row, one, 5.0, 0.0) for row in many])
