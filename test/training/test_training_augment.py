"""Laws of augmentation, and of objects that are put into other scenes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidar_perception.geometry import bev_iou, points_in_box, wrap_angle
from lidar_perception.training.augment import (
    STEP,
    TrainingScene,
    augmented,
    blurred,
    brightened,
    cropped,
    faced,
    flipped,
    raised,
    scaled,
    thinned,
    turned,
    with_moved_objects,
)
from lidar_perception.training.cut_objects import cut, joined
from lidar_perception.training.database import THING, Database, varied_thing, with_objects
from lidar_perception.training.params import AugmentParams
from lidar_perception.training.putting import inside
from lidar_perception.types import CLASSES, PEDESTRIAN, InputError

AREA = np.array([0.0, -15, -3]), np.array([20.0, 15, 1])
seeds = st.integers(0, 2**32 - 1)
CAR, CYCLIST = CLASSES.index("Car"), CLASSES.index("Cyclist")
STILL = AugmentParams(cars=0, pedestrians=0, cyclists=0, things=0, object_turn=0, object_shift=0,
                      flip=0, turn=0, scale=0, beam_noise=0, range_noise=0, dropout=0, intensity=0,
                      height=0, tilt=0)


def random_scene(seed: int, around: bool = False) -> TrainingScene:
    """Ground, and up to a dozen boxes full of points that do not touch."""
    rng = np.random.default_rng(seed)
    boxes, ids = np.zeros((0, 7)), []
    for _ in range(rng.integers(0, 13)):
        kind = rng.choice([CAR, PEDESTRIAN, CYCLIST])
        size = {CAR: (4, 1.7, 1.5), PEDESTRIAN: (0.8, 0.7, 1.7), CYCLIST: (1.8, 0.6, 1.7)}[kind]
        box = np.array([*rng.uniform(-18, 18, 2), size[2] / 2 - 1.73, *size, rng.uniform(-3, 3)])
        if not bev_iou(box[None] + [0, 0, 0, 0.1, 0.1, 0, 0], boxes).any():
            boxes, ids = np.concatenate([boxes, box[None]]), [*ids, kind]
    parts = [rng.uniform([-20, -20, -1.75], [20, 20, -1.73], (800, 3))]
    for box in boxes:
        flat = rng.uniform(-0.48, 0.48, (rng.integers(3, 30), 3)) * box[3:6]
        cos, sin = np.cos(box[6]), np.sin(box[6])
        parts.append(flat @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]]) + box[:3])
    xyz = np.concatenate(parts)
    points = np.column_stack([xyz, rng.uniform(0, 1, len(xyz))]).astype(np.float32)
    return TrainingScene(points, boxes, np.array(ids, int), np.ones(len(ids), bool), around)


def members(scene: TrainingScene, margin: float = 0.0) -> np.ndarray:
    """(M, N) bool: which points are in which box."""
    return np.array([points_in_box(scene.points[:, :3], box, margin) for box in scene.boxes],
                    bool).reshape(len(scene.boxes), len(scene.points))


def touching(boxes: np.ndarray) -> bool:
    return bool((bev_iou(boxes, boxes) - np.eye(len(boxes)) > 1e-9).any())


@given(seeds, st.floats(0, 0.5))
def test_points_inside_a_box_are_found_as_by_the_plain_way(seed, margin):
    scene = random_scene(seed)
    for box in scene.boxes:
        plain = points_in_box(scene.points[:, :3], box, margin)
        assert np.array_equal(inside(scene.points, box, margin), np.flatnonzero(plain))


# augmentation

@given(seeds)
def test_points_in_a_box_stay_in_it(seed):
    scene, rng = random_scene(seed), np.random.default_rng(seed)
    before = members(scene)
    for changed in (flipped(scene), turned(scene, rng.uniform(-4, 4)),
                    scaled(scene, rng.uniform(0.8, 1.2)), raised(scene, rng.uniform(-1, 1)),
                    brightened(scene, rng.uniform(0.5, 1.5), rng.uniform(-0.3, 0.3)),
                    with_moved_objects(scene, 0.5, 0.5, rng)):
        assert changed.points.dtype == np.float32 and changed.points.shape == scene.points.shape
        assert not (before & ~members(changed, margin=2e-4)).any()
        np.testing.assert_allclose(changed.boxes[:, 3:6] / scene.boxes[:, 3:6],
                                   (changed.boxes[:1, 3:4] / scene.boxes[:1, 3:4]).sum() or 1)
        assert touching(changed.boxes) is False


@given(seeds)
def test_whole_scenes_move_as_one(seed):
    scene = random_scene(seed)
    for changed in flipped(scene), turned(scene, 2.0), raised(scene, 0.4):
        assert np.array_equal(members(changed, 1e-3).sum(axis=1), members(scene, 1e-3).sum(axis=1))


@given(seeds, st.floats(-0.1, 0.1), st.floats(-0.1, 0.1))
def test_on_a_slope_everything_is_as_high_above_the_ground_as_before(seed, ahead, aside):
    scene = random_scene(seed)
    tilted = raised(scene, 0.3, (ahead, aside))
    for before, after in ((scene.points, tilted.points), (scene.boxes, tilted.boxes)):
        np.testing.assert_allclose(after[:, 2] - 0.3 - after[:, :2] @ [ahead, aside], before[:, 2],
                                   atol=1e-5)
        assert np.array_equal(np.delete(after, 2, axis=1), np.delete(before, 2, axis=1))


@given(seeds, st.floats(-7, 7))
def test_changes_are_undone_by_their_inverses(seed, angle):
    scene = random_scene(seed)
    for back in (flipped(flipped(scene)), turned(turned(scene, angle), -angle),
                 scaled(scaled(scene, 1.25), 0.8),
                 raised(raised(scene, 0.5, (0.02, -0.01)), -0.5, (-0.02, 0.01))):
        np.testing.assert_allclose(back.points, scene.points, atol=1e-4)
        np.testing.assert_allclose(back.boxes[:, :6], scene.boxes[:, :6], atol=1e-9)
        np.testing.assert_allclose(wrap_angle(back.boxes[:, 6] - scene.boxes[:, 6]), 0, atol=1e-9)


def test_a_turn_takes_what_is_ahead_to_the_left():
    scene = TrainingScene(np.array([[5, 0, 1, 0.5]], np.float32),
                          np.array([[5.0, 0, 1, 4, 2, 1, 0.1]]), np.array([CAR]), np.ones(1, bool))
    changed = turned(scene, np.pi / 2)
    np.testing.assert_allclose(changed.points, [[0, 5, 1, 0.5]], atol=1e-6)
    np.testing.assert_allclose(changed.boxes, [[0, 5, 1, 4, 2, 1, 0.1 + np.pi / 2]], atol=1e-9)


@given(seeds, st.floats(0, 0.99))
def test_thinning_leaves_a_part_of_the_points_in_their_order(seed, share):
    scene = random_scene(seed)
    left = thinned(scene, share, np.random.default_rng(seed))
    assert (len(left.points) == len(scene.points)) or share > 0
    assert abs(len(left.points) - (1 - share) * len(scene.points)) < 6 * len(scene.points)**0.5
    places = iter(scene.points.tolist())
    assert all(point in places for point in left.points.tolist())


@given(seeds)
def test_intensities_stay_intensities_and_nothing_else_changes(seed):
    scene = random_scene(seed)
    changed = brightened(scene, 1.4, 0.2)
    assert changed.points[:, 3].min() >= 0 and changed.points[:, 3].max() <= 1
    assert np.array_equal(changed.points[:, :3], scene.points[:, :3])
    scene.points[::2, 3] = 0  # what was too weak to be told
    assert (brightened(scene, 1.4, 0.2).points[::2, 3] == 0).all()


@given(seeds, st.booleans())
def test_the_same_rng_gives_the_same_scene_and_zeros_change_nothing(seed, around):
    scene = random_scene(seed, around)
    kept = scene.points.copy(), scene.boxes.copy()
    once, twice = (augmented(scene, AugmentParams(), np.random.default_rng(seed)) for _ in "ab")
    assert np.array_equal(once.points, twice.points) and np.array_equal(once.boxes, twice.boxes)
    assert np.array_equal(scene.points, kept[0]) and np.array_equal(scene.boxes, kept[1])
    same = augmented(scene, STILL, np.random.default_rng(seed))
    np.testing.assert_allclose(same.points, scene.points, atol=1e-5)
    np.testing.assert_allclose(same.boxes, scene.boxes, atol=1e-9)


# objects of other scenes

@given(seeds)
def test_objects_that_are_put_in_touch_nothing_and_keep_their_points(seed):
    database = joined([cut(random_scene(seed + k), ("Car", "Pedestrian", "Cyclist"), 5)
                       for k in range(1, 6)])
    scene, rng = random_scene(seed), np.random.default_rng(seed)
    params = AugmentParams(cars=4, pedestrians=4, cyclists=0)
    fuller = with_objects(scene, database, params, *AREA, rng)
    old, count = len(scene.boxes), len(fuller.boxes)
    assert not touching(fuller.boxes)
    assert np.array_equal(fuller.boxes[:old], scene.boxes)
    assert len(fuller.class_ids) == len(fuller.wanted) == count
    for kind, most in ((CAR, 4), (PEDESTRIAN, 4), (CYCLIST, 0)):
        here = (fuller.class_ids == kind).sum()
        assert here <= max(most, (scene.class_ids == kind).sum())
    within = members(fuller, 1e-3).sum(axis=1)
    assert (within[:old] <= members(scene, 1e-3).sum(axis=1)).all()  # some may be in a shadow now
    sizes = np.diff(database.first)
    ranges = np.hypot(database.boxes[:, 0], database.boxes[:, 1])
    for box, number in zip(fuller.boxes[old:], within[old:]):
        assert (box[:2] >= AREA[0][:2]).all() and (box[:2] < AREA[1][:2]).all()
        origin = np.abs(ranges - np.hypot(box[0], box[1])).argmin()
        assert ranges[origin] == pytest.approx(np.hypot(box[0], box[1]), abs=1e-9)
        assert number <= sizes[origin] and sizes[origin] >= 5  # the next one may stand before it
    again = with_objects(scene, database, params, *AREA, np.random.default_rng(seed))
    assert np.array_equal(again.points, fuller.points)


def wall(x: float, y: tuple[float, float], z: tuple[float, float], apart: float = 0.02
         ) -> np.ndarray:
    """(N, 4) points."""
    sides, heights = np.meshgrid(np.arange(*y, apart), np.arange(*z, apart))
    return np.column_stack([np.full(sides.size, x), sides.ravel(), heights.ravel(),
                            np.zeros(sides.size)]).astype(np.float32)


def one_walker(x: float) -> Database:
    """A pedestrian x metres ahead, a flat grid of points."""
    own = wall(x, (-0.25, 0.25), (-1.7, 0))
    return Database(np.array([[x, 0, -0.86, 0.8, 0.7, 1.74, 0]]),
                    np.array([PEDESTRIAN], np.int32), own, np.array([0, len(own)]))


def street_with(*walls: np.ndarray) -> TrainingScene:
    ground = wall(-1.73, (-15, 15), (0, 15), 0.1)[:, [2, 1, 0, 3]]
    return TrainingScene(np.concatenate([ground, *walls]), np.zeros((0, 7)), np.zeros(0, int),
                 np.zeros(0, bool))


@given(seeds)
@pytest.mark.no_cover
def test_what_is_behind_an_object_goes_and_none_is_put_behind_something(seed):
    params, rng = AugmentParams(cars=0, pedestrians=1, cyclists=0), np.random.default_rng(seed)
    behind = wall(12.0, (-14, 14), (-1.7, 1.0), 0.06)
    scene = street_with(behind)
    fuller = with_objects(scene, one_walker(8.0), params, *AREA, rng)
    assert len(fuller.boxes) == 1
    box = fuller.boxes[0]
    assert np.hypot(box[0], box[1]) == pytest.approx(8.0)
    count = len(one_walker(8.0).points)
    rest, own = fuller.points[:-count], fuller.points[-count:]
    assert points_in_box(own, box, 1e-4).all()
    seen = rest[(rest[:, 0] == 12) & (rest[:, 2] > -1.72)]
    # a ray from the sensor to a point of the wall that is left misses the walker
    for share in np.linspace(0.5, 0.95, 40):
        assert not points_in_box(seen * np.float32(share), box - [0, 0, 0, 0.35, 0.3, 0.1, 0]).any()
    assert len(seen) > 0.8 * len(behind)
    if abs(np.arctan2(box[1], box[0])) < 0.6:
        assert len(seen) < len(behind)
    hidden = with_objects(scene, one_walker(14.0), params, *AREA, rng)
    assert len(hidden.boxes) == 0 or abs(np.arctan2(*hidden.boxes[0, 1::-1])) > 0.45
    assert len(with_objects(street_with(), one_walker(14.0), params, *AREA, rng).boxes) == 1


def test_posts_are_learned_from_but_are_no_objects():
    post = wall(8.0, (2.9, 3.1), (-1.73, 0.6))
    walker = one_walker(9.0)
    scene = street_with(post, walker.points, wall(11.0, (-8, -5), (-1.73, 0.5)))
    scene = replace(scene, boxes=walker.boxes, class_ids=walker.class_ids, wanted=np.ones(1, bool))
    database = cut(scene, ("Pedestrian",), 5)
    assert database.class_ids.tolist() == [PEDESTRIAN, THING]
    assert len(cut(scene, ("Car",), 5)) == 0
    box, own = database.boxes[1], database.points_of(1)
    assert (own[:, 0] == 8).all() and len(own) > 0.8 * len(post)
    assert box[:2] == pytest.approx([8, 3], abs=0.05) and box[5] == pytest.approx(2.33, abs=0.1)
    params = replace(STILL, things=1, things_stretch=0, things_intensity=0, things_shine=0)
    fuller = with_objects(street_with(), database, params, *AREA, np.random.default_rng(0))
    assert len(fuller.boxes) == len(fuller.class_ids) == len(fuller.wanted) == 0
    added = fuller.points[-len(own):]
    np.testing.assert_allclose(np.hypot(added[:, 0], added[:, 1]),
                               np.hypot(own[:, 0], own[:, 1]), atol=1e-4)
    assert added[:, 2].max() == pytest.approx(0.6, abs=0.1)


@given(seeds)
def test_noise_is_along_the_ray_and_beams_have_theirs_in_common(seed):
    rng = np.random.default_rng(seed)
    points = np.concatenate([random_scene(seed).points, np.zeros((1, 4), np.float32)])
    assert np.array_equal(blurred(points, 0, 0, rng), points)
    before = np.linalg.norm(points[:-1, :3], axis=1)
    for beam, point in ((0.05, 0.0), (0.0, 0.05)):
        moved = blurred(points, beam, point, rng)[:-1]
        after = np.linalg.norm(moved[:, :3], axis=1)
        np.testing.assert_allclose(moved[:, :3] / after[:, None],
                                   points[:-1, :3] / before[:, None], atol=1e-5)
        shift, (x, y, z) = after - before, points[:-1, :3].T
        assert 0.02 < shift.std() < 0.1
        beams = np.floor(np.arctan2(z, np.hypot(x, y)) / STEP)
        known, sizes = np.unique(beams, return_counts=True)
        fullest = shift[beams == known[sizes.argmax()]]
        assert (np.ptp(fullest) < 1e-3) == (point == 0)


STILL_THINGS = AugmentParams(things_stretch=0, things_intensity=0, things_shine=0)


@given(seeds)
def test_what_shines_of_a_thing_is_between_two_heights(seed):
    scene, rng = random_scene(seed), np.random.default_rng(seed)
    for box in scene.boxes:
        own = scene.points[inside(scene.points, box, 0.0)]
        own[:, 3] = 0.3
        _, points = varied_thing(box, own, replace(STILL_THINGS, things_shine=1), rng)
        bright = points[:, 3] > 0.9
        assert (points[~bright, 3] == np.float32(0.3)).all()
        if bright.any():
            low, high = points[bright, 2].min(), points[bright, 2].max()
            assert bright[(points[:, 2] >= low) & (points[:, 2] <= high)].all()


@given(seeds)
def test_things_are_stretched_upon_their_floor(seed):
    scene, rng = random_scene(seed), np.random.default_rng(seed)
    changes = replace(STILL_THINGS, things_stretch=0.5, things_intensity=0.4)
    for box in scene.boxes:
        own = scene.points[inside(scene.points, box, 0.0)]
        grown, points = varied_thing(box, own, changes, rng)
        assert len(inside(points, grown, 1e-3)) == len(own)
        assert grown[2] - grown[5] / 2 == pytest.approx(box[2] - box[5] / 2)
        assert grown[[0, 1, 6]] == pytest.approx(box[[0, 1, 6]])
        assert (np.abs(np.log(grown[3:6] / box[3:6])) <= 0.5).all()
        same, still = varied_thing(box, own, STILL_THINGS, rng)
        np.testing.assert_allclose(same, box, atol=1e-12)
        np.testing.assert_allclose(still, own, atol=1e-6)


@given(seeds, st.sampled_from([-1, 1]), st.sampled_from([-1, 1]))
def test_nothing_that_may_come_into_view_is_cut_off(seed, larger, higher):
    scene, params = random_scene(seed), AugmentParams(turn=0, scale=0.1, height=0.3, tilt=0.1)
    low, high = np.array([0, -10, -1.8]), np.array([10.0, 10, 0.5])

    def changed(scene: TrainingScene) -> TrainingScene:
        scene = raised(scaled(scene, 1 + larger * params.scale), higher * params.height,
                       (higher * params.tilt, -larger * params.tilt))
        return cropped(scene, low, high)

    part = faced(scene, params, low, high, np.random.default_rng(seed))
    assert len(part.points) < len(scene.points) and len(part.boxes) == len(part.class_ids)
    whole, cut = changed(scene), changed(part)
    assert np.array_equal(whole.points, cut.points)
    np.testing.assert_allclose(whole.boxes, cut.boxes, atol=1e-12)
    assert np.array_equal(whole.class_ids, cut.class_ids)


def test_scenes_that_are_labelled_all_around_are_turned_all_around():
    def bearings(around: bool) -> np.ndarray:
        scene = TrainingScene(np.array([[5, 0, -1, 0.5]], np.float32), np.zeros((0, 7)),
                              np.zeros(0, int), np.zeros(0, bool), around)
        turned = [faced(scene, AugmentParams(), np.full(3, -9.0), np.full(3, 9.0),
                        np.random.default_rng(seed)).points[0] for seed in range(60)]
        return np.abs(np.arctan2(*np.array(turned).T[1::-1]))

    assert bearings(True).max() > 2.5 and 0.6 < bearings(False).max() <= AugmentParams().turn


def test_objects_survive_their_file_and_a_broken_file_is_named(tmp_path):
    database = joined([cut(random_scene(k), ("Car", "Pedestrian"), 5) for k in range(4)])
    assert len(database) > 0 and set(database.class_ids) <= {CAR, PEDESTRIAN}
    database.save(tmp_path / "objects.npz")
    back = Database.load(tmp_path / "objects.npz")
    assert all(np.array_equal(v, getattr(back, k)) for k, v in vars(database).items())
    (tmp_path / "objects.npz").write_bytes(b"PK")
    with pytest.raises(InputError, match=r"objects\.npz"):
        Database.load(tmp_path / "objects.npz")
    assert len(joined([])) == 0


def test_where_there_is_no_ground_nothing_is_put():
    database = joined([cut(random_scene(k), ("Car",), 5) for k in range(4)])
    empty = TrainingScene(np.zeros((0, 4), np.float32), np.zeros((0, 7)), np.zeros(0, int),
                  np.zeros(0, bool))
    assert len(with_objects(empty, database, AugmentParams(), *AREA,
                            np.random.default_rng(0)).boxes) == 0
