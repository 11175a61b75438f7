"""Augmentation of scenes, and pasting of objects into other scenes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from training_toy import STILL

from lidar_perception.geometry import bev_iou, points_in_box, wrap_angle
from lidar_perception.training.augment import (
    BEAM_STEP,
    TrainingScene,
    augment_scene,
    blur_ranges,
    change_intensity,
    crop_scene,
    distort_intensity,
    drop_points,
    flip_scene,
    move_objects,
    raise_scene,
    rotate_and_crop,
    rotate_scene,
    scale_scene,
)
from lidar_perception.training.cut_objects import cut_objects, join_databases
from lidar_perception.training.database import BACKGROUND_ID, Database, paste_objects, vary_background_box
from lidar_perception.training.params import AugmentParams
from lidar_perception.training.pasting import find_points_in_box
from lidar_perception.types import CLASSES, PEDESTRIAN, InputError

AREA = np.array([0.0, -15, -3]), np.array([20.0, 15, 1])
seeds = st.integers(0, 2**32 - 1)
CAR, CYCLIST = CLASSES.index("Car"), CLASSES.index("Cyclist")


def make_random_scene(seed: int, around: bool = False) -> TrainingScene:
    """Return ground with up to twelve boxes of points that do not touch."""
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


def find_points_of_boxes(scene: TrainingScene, margin: float = 0.0) -> np.ndarray:
    """Return (M, N) bool: which points are in which box."""
    return np.array([points_in_box(scene.points[:, :3], box, margin) for box in scene.boxes], bool).reshape(
        len(scene.boxes), len(scene.points)
    )


def any_touch(boxes: np.ndarray) -> bool:
    return bool((bev_iou(boxes, boxes) - np.eye(len(boxes)) > 1e-9).any())


@given(seeds, st.floats(0, 0.5))
def test_find_points_in_box_agrees_with_points_in_box(seed, margin):
    scene = make_random_scene(seed)
    for box in scene.boxes:
        plain = points_in_box(scene.points[:, :3], box, margin)
        assert np.array_equal(find_points_in_box(scene.points, box, margin), np.flatnonzero(plain))


# augmentation


@given(seeds)
def test_points_stay_in_their_boxes(seed):
    scene, rng = make_random_scene(seed), np.random.default_rng(seed)
    before = find_points_of_boxes(scene)
    for changed_scene in (
        flip_scene(scene),
        rotate_scene(scene, rng.uniform(-4, 4)),
        scale_scene(scene, rng.uniform(0.8, 1.2)),
        raise_scene(scene, rng.uniform(-1, 1)),
        change_intensity(scene, rng.uniform(0.5, 1.5), rng.uniform(-0.3, 0.3)),
        move_objects(scene, 0.5, 0.5, rng),
    ):
        assert changed_scene.points.dtype == np.float32 and changed_scene.points.shape == scene.points.shape
        assert not (before & ~find_points_of_boxes(changed_scene, margin=2e-4)).any()
        np.testing.assert_allclose(
            changed_scene.boxes[:, 3:6] / scene.boxes[:, 3:6],
            (changed_scene.boxes[:1, 3:4] / scene.boxes[:1, 3:4]).sum() or 1,
        )
        assert any_touch(changed_scene.boxes) is False


@given(seeds, st.floats(-0.1, 0.1), st.floats(-0.1, 0.1))
def test_slope_keeps_heights_above_the_ground(seed, ahead, aside):
    scene = make_random_scene(seed)
    tilted = raise_scene(scene, 0.3, (ahead, aside))
    for before, after in ((scene.points, tilted.points), (scene.boxes, tilted.boxes)):
        np.testing.assert_allclose(after[:, 2] - 0.3 - after[:, :2] @ [ahead, aside], before[:, 2], atol=1e-5)
        assert np.array_equal(np.delete(after, 2, axis=1), np.delete(before, 2, axis=1))


@given(seeds, st.floats(-7, 7))
def test_inverse_augmentations_restore_the_scene(seed, angle):
    scene = make_random_scene(seed)
    for back in (
        flip_scene(flip_scene(scene)),
        rotate_scene(rotate_scene(scene, angle), -angle),
        scale_scene(scale_scene(scene, 1.25), 0.8),
        raise_scene(raise_scene(scene, 0.5, (0.02, -0.01)), -0.5, (-0.02, 0.01)),
    ):
        np.testing.assert_allclose(back.points, scene.points, atol=1e-4)
        np.testing.assert_allclose(back.boxes[:, :6], scene.boxes[:, :6], atol=1e-9)
        np.testing.assert_allclose(wrap_angle(back.boxes[:, 6] - scene.boxes[:, 6]), 0, atol=1e-9)


def test_positive_rotation_is_counterclockwise():
    scene = TrainingScene(
        np.array([[5, 0, 1, 0.5]], np.float32), np.array([[5.0, 0, 1, 4, 2, 1, 0.1]]), np.array([CAR]), np.ones(1, bool)
    )
    rotated_scene = rotate_scene(scene, np.pi / 2)
    np.testing.assert_allclose(rotated_scene.points, [[0, 5, 1, 0.5]], atol=1e-6)
    np.testing.assert_allclose(rotated_scene.boxes, [[0, 5, 1, 4, 2, 1, 0.1 + np.pi / 2]], atol=1e-9)


@given(seeds, st.floats(0, 0.99))
def test_drop_points_keeps_the_fraction_and_order(seed, share):
    scene = make_random_scene(seed)
    left = drop_points(scene, share, np.random.default_rng(seed))
    assert (len(left.points) == len(scene.points)) or share > 0
    assert abs(len(left.points) - (1 - share) * len(scene.points)) < 6 * len(scene.points) ** 0.5
    places = iter(scene.points.tolist())
    assert all(point in places for point in left.points.tolist())


@given(seeds)
def test_intensity_stays_within_0_and_1_and_0_stays_0(seed):
    scene = make_random_scene(seed)
    changed_scene = change_intensity(scene, 1.4, 0.2)
    assert changed_scene.points[:, 3].min() >= 0 and changed_scene.points[:, 3].max() <= 1
    assert np.array_equal(changed_scene.points[:, :3], scene.points[:, :3])
    scene.points[::2, 3] = 0  # weak returns without an intensity
    assert (change_intensity(scene, 1.4, 0.2).points[::2, 3] == 0).all()


def test_intensity_of_a_scan_is_removed_or_distorted():
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(2, 60, (4000, 3)), rng.uniform(0.1, 0.4, 4000)])
    points[::4, 3] = 0
    removed = distort_intensity(points, replace(STILL, no_intensity=1), rng)
    assert not removed[:, 3].any() and np.array_equal(removed[:, :3], points[:, :3])
    faded = distort_intensity(points, replace(STILL, fade=1.0), np.random.default_rng(3))
    ratio = faded[:, 3][points[:, 3] > 0] / points[:, 3][points[:, 3] > 0]
    ranges = np.linalg.norm(points[points[:, 3] > 0, :3], axis=1)
    assert abs(np.corrcoef(np.log(ratio), np.log(ranges))[0, 1]) > 0.999
    rounded = distort_intensity(points, replace(STILL, quantize=16), rng)
    assert 4 <= len(np.unique(rounded[:, 3])) < 100 and not rounded[::4, 3].any()
    assert not np.array_equal(distort_intensity(points, replace(STILL, speckle=0.2), rng), points)


@given(seeds, st.booleans())
def test_augmentation_is_deterministic_and_zero_is_identity(seed, around):
    scene = make_random_scene(seed, around)
    original = scene.points.copy(), scene.boxes.copy()
    once, twice = (augment_scene(scene, AugmentParams(), np.random.default_rng(seed)) for _ in "ab")
    assert np.array_equal(once.points, twice.points) and np.array_equal(once.boxes, twice.boxes)
    assert np.array_equal(scene.points, original[0]) and np.array_equal(scene.boxes, original[1])
    same = augment_scene(scene, STILL, np.random.default_rng(seed))
    np.testing.assert_allclose(same.points, scene.points, atol=1e-5)
    np.testing.assert_allclose(same.boxes, scene.boxes, atol=1e-9)


# pasted objects


@given(seeds)
def test_pasted_objects_touch_nothing_and_keep_points(seed):
    database = join_databases(
        [cut_objects(make_random_scene(seed + k), ("Car", "Pedestrian", "Cyclist"), 5) for k in range(1, 6)]
    )
    scene, rng = make_random_scene(seed), np.random.default_rng(seed)
    params = AugmentParams(cars=4, pedestrians=4, cyclists=0)
    fuller = paste_objects(scene, database, params, *AREA, rng)
    old, count = len(scene.boxes), len(fuller.boxes)
    assert not any_touch(fuller.boxes)
    assert np.array_equal(fuller.boxes[:old], scene.boxes)
    assert len(fuller.class_ids) == len(fuller.detectable) == count
    for kind, most in ((CAR, 4), (PEDESTRIAN, 4), (CYCLIST, 0)):
        present = (fuller.class_ids == kind).sum()
        assert present <= max(most, (scene.class_ids == kind).sum())
    within = find_points_of_boxes(fuller, 1e-3).sum(axis=1)
    assert (within[:old] <= find_points_of_boxes(scene, 1e-3).sum(axis=1)).all()  # some may be in the shadow of others
    sizes = np.diff(database.first)
    ranges = np.hypot(database.boxes[:, 0], database.boxes[:, 1])
    for box, number in zip(fuller.boxes[old:], within[old:]):
        assert (box[:2] >= AREA[0][:2]).all() and (box[:2] < AREA[1][:2]).all()
        origin = np.abs(ranges - np.hypot(box[0], box[1])).argmin()
        assert ranges[origin] == pytest.approx(np.hypot(box[0], box[1]), abs=1e-9)
        assert number <= sizes[origin] and sizes[origin] >= 5  # others may hide it
    second_result = paste_objects(scene, database, params, *AREA, np.random.default_rng(seed))
    assert np.array_equal(second_result.points, fuller.points)


def make_wall(x: float, y: tuple[float, float], z: tuple[float, float], apart: float = 0.02) -> np.ndarray:
    """Return the points (N, 4) of a wall across the x axis."""
    sides, heights = np.meshgrid(np.arange(*y, apart), np.arange(*z, apart))
    return np.column_stack([np.full(sides.size, x), sides.ravel(), heights.ravel(), np.zeros(sides.size)]).astype(
        np.float32
    )


def make_walker(x: float) -> Database:
    """Return a pedestrian x metres ahead as a flat grid of points."""
    own = make_wall(x, (-0.25, 0.25), (-1.7, 0))
    return Database(
        np.array([[x, 0, -0.86, 0.8, 0.7, 1.74, 0]]), np.array([PEDESTRIAN], np.int32), own, np.array([0, len(own)])
    )


def make_street(*walls: np.ndarray) -> TrainingScene:
    ground = make_wall(-1.73, (-15, 15), (0, 15), 0.1)[:, [2, 1, 0, 3]]
    return TrainingScene(np.concatenate([ground, *walls]), np.zeros((0, 7)), np.zeros(0, int), np.zeros(0, bool))


@given(seeds)
@pytest.mark.no_cover
def test_pasted_object_casts_shadow_and_is_not_hidden(seed):
    params, rng = AugmentParams(cars=0, pedestrians=1, cyclists=0), np.random.default_rng(seed)
    behind = make_wall(12.0, (-14, 14), (-1.7, 1.0), 0.06)
    scene = make_street(behind)
    fuller = paste_objects(scene, make_walker(8.0), params, *AREA, rng)
    assert len(fuller.boxes) == 1
    box = fuller.boxes[0]
    assert np.hypot(box[0], box[1]) == pytest.approx(8.0)
    count = len(make_walker(8.0).points)
    rest, own = fuller.points[:-count], fuller.points[-count:]
    assert points_in_box(own, box, 1e-4).all()
    visible_points = rest[(rest[:, 0] == 12) & (rest[:, 2] > -1.72)]
    # rays from the sensor to the remaining points of the wall miss the walker
    for share in np.linspace(0.5, 0.95, 40):
        assert not points_in_box(visible_points * np.float32(share), box - [0, 0, 0, 0.35, 0.3, 0.1, 0]).any()
    assert len(visible_points) > 0.8 * len(behind)
    if abs(np.arctan2(box[1], box[0])) < 0.6:
        assert len(visible_points) < len(behind)
    hidden = paste_objects(scene, make_walker(14.0), params, *AREA, rng)
    assert len(hidden.boxes) == 0 or abs(np.arctan2(*hidden.boxes[0, 1::-1])) > 0.45
    assert len(paste_objects(make_street(), make_walker(14.0), params, *AREA, rng).boxes) == 1


def test_posts_are_pasted_without_a_box():
    post = make_wall(8.0, (2.9, 3.1), (-1.73, 0.6))
    walker = make_walker(9.0)
    scene = make_street(post, walker.points, make_wall(11.0, (-8, -5), (-1.73, 0.5)))
    scene = replace(scene, boxes=walker.boxes, class_ids=walker.class_ids, detectable=np.ones(1, bool))
    database = cut_objects(scene, ("Pedestrian",), 5)
    assert database.class_ids.tolist() == [PEDESTRIAN, BACKGROUND_ID]
    assert len(cut_objects(scene, ("Car",), 5)) == 0
    box, own = database.boxes[1], database.get_points(1)
    assert (own[:, 0] == 8).all() and len(own) > 0.8 * len(post)
    assert box[:2] == pytest.approx([8, 3], abs=0.05) and box[5] == pytest.approx(2.33, abs=0.1)
    params = replace(STILL, things=1, things_stretch=0, things_intensity=0, things_shine=0)
    fuller = paste_objects(make_street(), database, params, *AREA, np.random.default_rng(0))
    assert len(fuller.boxes) == len(fuller.class_ids) == len(fuller.detectable) == 0
    added = fuller.points[-len(own) :]
    np.testing.assert_allclose(np.hypot(added[:, 0], added[:, 1]), np.hypot(own[:, 0], own[:, 1]), atol=1e-4)
    assert added[:, 2].max() == pytest.approx(0.6, abs=0.1)


@given(seeds)
def test_range_noise_is_along_rays_and_shared_by_beams(seed):
    rng = np.random.default_rng(seed)
    points = np.concatenate([make_random_scene(seed).points, np.zeros((1, 4), np.float32)])
    assert np.array_equal(blur_ranges(points, 0, 0, rng), points)
    before = np.linalg.norm(points[:-1, :3], axis=1)
    for beam, point in ((0.05, 0.0), (0.0, 0.05)):
        noisy_points = blur_ranges(points, beam, point, rng)[:-1]
        after = np.linalg.norm(noisy_points[:, :3], axis=1)
        np.testing.assert_allclose(noisy_points[:, :3] / after[:, None], points[:-1, :3] / before[:, None], atol=1e-5)
        shift, (x, y, z) = after - before, points[:-1, :3].T
        assert 0.02 < shift.std() < 0.1
        beams = np.floor(np.arctan2(z, np.hypot(x, y)) / BEAM_STEP)
        known, sizes = np.unique(beams, return_counts=True)
        fullest = shift[beams == known[sizes.argmax()]]
        assert (np.ptp(fullest) < 1e-3) == (point == 0)


STILL_THINGS = AugmentParams(things_stretch=0, things_intensity=0, things_shine=0)


@given(seeds)
def test_reflector_spans_range_of_heights(seed):
    scene, rng = make_random_scene(seed), np.random.default_rng(seed)
    for box in scene.boxes:
        own = scene.points[find_points_in_box(scene.points, box, 0.0)]
        own[:, 3] = 0.3
        _, points = vary_background_box(box, own, replace(STILL_THINGS, things_shine=1), rng)
        bright = points[:, 3] > 0.9
        assert (points[~bright, 3] == np.float32(0.3)).all()
        if bright.any():
            low, high = points[bright, 2].min(), points[bright, 2].max()
            assert bright[(points[:, 2] >= low) & (points[:, 2] <= high)].all()


@given(seeds)
def test_stretched_background_stays_on_the_ground(seed):
    scene, rng = make_random_scene(seed), np.random.default_rng(seed)
    changes = replace(STILL_THINGS, things_stretch=0.5, things_intensity=0.4)
    for box in scene.boxes:
        own = scene.points[find_points_in_box(scene.points, box, 0.0)]
        stretched, points = vary_background_box(box, own, changes, rng)
        assert len(find_points_in_box(points, stretched, 1e-3)) == len(own)
        assert stretched[2] - stretched[5] / 2 == pytest.approx(box[2] - box[5] / 2)
        assert stretched[[0, 1, 6]] == pytest.approx(box[[0, 1, 6]])
        assert (np.abs(np.log(stretched[3:6] / box[3:6])) <= 0.5).all()
        same_box, unchanged_box = vary_background_box(box, own, STILL_THINGS, rng)
        np.testing.assert_allclose(same_box, box, atol=1e-12)
        np.testing.assert_allclose(unchanged_box, own, atol=1e-6)


@given(seeds, st.sampled_from([-1, 1]), st.sampled_from([-1, 1]))
def test_early_crop_keeps_points_that_may_move_into_range(seed, larger, higher):
    scene, params = make_random_scene(seed), AugmentParams(turn=0, scale=0.1, height=0.3, tilt=0.1)
    low, high = np.array([0, -10, -1.8]), np.array([10.0, 10, 0.5])

    def changed(scene: TrainingScene) -> TrainingScene:
        scene = raise_scene(
            scale_scene(scene, 1 + larger * params.scale),
            higher * params.height,
            (higher * params.tilt, -larger * params.tilt),
        )
        return crop_scene(scene, low, high)

    part = rotate_and_crop(scene, params, low, high, np.random.default_rng(seed))
    assert len(part.points) < len(scene.points) and len(part.boxes) == len(part.class_ids)
    expected, cropped = changed(scene), changed(part)
    assert np.array_equal(cropped.points, expected.points)
    np.testing.assert_allclose(cropped.boxes, expected.boxes, atol=1e-12)
    assert np.array_equal(cropped.class_ids, expected.class_ids)


def test_scenes_labelled_all_around_rotate_by_any_angle():
    def bearings(around: bool) -> np.ndarray:
        scene = TrainingScene(
            np.array([[5, 0, -1, 0.5]], np.float32), np.zeros((0, 7)), np.zeros(0, int), np.zeros(0, bool), around
        )
        points = [
            rotate_and_crop(
                scene, AugmentParams(), np.full(3, -9.0), np.full(3, 9.0), np.random.default_rng(seed)
            ).points[0]
            for seed in range(60)
        ]
        return np.abs(np.arctan2(*np.array(points).T[1::-1]))

    assert bearings(True).max() > 2.5 and 0.6 < bearings(False).max() <= AugmentParams().turn


def test_database_file_survives_saving_or_is_named_as_broken(tmp_path):
    database = join_databases([cut_objects(make_random_scene(k), ("Car", "Pedestrian"), 5) for k in range(4)])
    assert len(database) > 0 and set(database.class_ids) <= {CAR, PEDESTRIAN}
    database.save(tmp_path / "objects.npz")
    back = Database.load(tmp_path / "objects.npz")
    assert all(np.array_equal(v, getattr(back, k)) for k, v in vars(database).items())
    (tmp_path / "objects.npz").write_bytes(b"PK")
    with pytest.raises(InputError, match=r"objects\.npz"):
        Database.load(tmp_path / "objects.npz")
    assert len(join_databases([])) == 0


def test_objects_are_not_pasted_without_ground():
    database = join_databases([cut_objects(make_random_scene(k), ("Car",), 5) for k in range(4)])
    empty = TrainingScene(np.zeros((0, 4), np.float32), np.zeros((0, 7)), np.zeros(0, int), np.zeros(0, bool))
    assert len(paste_objects(empty, database, AugmentParams(), *AREA, np.random.default_rng(0)).boxes) == 0
