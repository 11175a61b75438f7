"""Laws of boxes, seeds, refinement and the whole candidate pipeline."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from samples import DATA, needs_data

from lidar_perception.camera import Camera
from lidar_perception.candidates.boxes import height_matches, snap_to_ground
from lidar_perception.candidates.refine import group_points, refine
from lidar_perception.candidates.seeds import (
    Seed,
    load_seed,
    save_seed,
    seed_from_click,
    seed_from_points,
    seed_from_truth,
)
from lidar_perception.candidates.silhouette import to_pixels
from lidar_perception.clustering.shapes import oriented_boxes
from lidar_perception.datasets.kitti import open_kitti
from lidar_perception.geometry import points_in_box
from lidar_perception.params import (
    STEPS,
    HeightParams,
    PipelineParams,
    SeedParams,
    StmParams,
    ViewParams,
)
from lidar_perception.pipeline import (
    Segmented,
    clicked_seed,
    find_candidates,
    fixed_seed,
    refined,
    segment,
    truth_seed,
)
from lidar_perception.types import PEDESTRIAN, InputError, LidarFrame

few = settings(deadline=None, max_examples=40, database=None)
seeds = st.integers(0, 2**32 - 1)
GROUND_Z = -1.7


def labelled(seed):
    """Random points with ids 0..K, every cluster with at least one point."""
    rng = np.random.default_rng(seed)
    count = rng.integers(1, 8)
    labels = np.concatenate([np.arange(1, count + 1), rng.integers(0, count + 1, 60)])
    xyz = rng.uniform(-30, 30, (len(labels), 3)).astype(np.float32)
    return xyz, rng.permutation(labels).astype(np.int32)


def person(x, y, count=400, seed=0, height=1.75):
    """Points of a head, a torso and two legs that stand on the ground at x, y, facing us."""
    rng = np.random.default_rng(seed)
    part = rng.choice(4, count, p=[0.15, 0.45, 0.2, 0.2])
    low = np.array([[-0.12, 1.45], [-0.25, 0.8], [-0.2, 0.06], [0.05, 0.06]])[part]
    high = np.array([[0.12, height], [0.25, 1.45], [-0.05, 0.8], [0.2, 0.8]])[part]
    across, up = (low + rng.random((count, 2)) * (high - low)).T
    return np.column_stack([x + rng.uniform(0, 0.1, count), y + across, GROUND_Z + up])


def block(x, y, size, count=600, seed=0):
    """A box of points with its bottom 0.06 m above the ground."""
    low = [x, y, GROUND_Z + 0.06]
    return low + np.random.default_rng(seed).random((count, 3)) * size


def floor(seed=0):
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-40, 40, (6000, 2)), rng.normal(GROUND_Z, 0.01, 6000)])


PEOPLE = np.array([[7, 2], [12, -5], [20, 4]])


def scene():
    """A floor, three people and two things of other shapes, one of them of a person's height."""
    parts = [floor(), *(person(*at, seed=i) for i, at in enumerate(PEOPLE)),
             block(10, 8, [2.0, 3.0, 1.3]), block(13, 3, [0.2, 0.6, 1.69])]
    return np.concatenate(parts).astype(np.float32)


def boxes_at(places, height=1.8):
    return np.array([[x + 0.05, y, GROUND_Z + height / 2, 0.6, 0.8, height, 0] for x, y in places])


# --- boxes ---------------------------------------------------------------------------------


@few
@given(seeds, st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(-20, 20))
def test_snapping_lowers_bottoms_to_the_plane_never_raises_them_and_keeps_tops(seed, a, b, c):
    boxes = oriented_boxes(*labelled(seed), "axis_aligned")
    before = boxes.copy()
    snapped = snap_to_ground(boxes, np.array([a, b, c]))
    assert snapped.dtype == np.float32
    bottom, top = (before[:, 2] + s * before[:, 5] / 2 for s in (-1, 1))
    ground = a * before[:, 0] + b * before[:, 1] + c
    np.testing.assert_allclose(snapped[:, 2] + snapped[:, 5] / 2, top, rtol=0, atol=2e-5)
    np.testing.assert_allclose(snapped[:, 2] - snapped[:, 5] / 2, np.minimum(bottom, ground),
                               rtol=0, atol=2e-5)
    np.testing.assert_array_equal(snapped[:, [0, 1, 3, 4, 6]], before[:, [0, 1, 3, 4, 6]])
    np.testing.assert_array_equal(boxes, before)  # the input is not touched
    np.testing.assert_array_equal(snap_to_ground(boxes, None), before)
    np.testing.assert_allclose(snap_to_ground(snapped, np.array([a, b, c])), snapped, rtol=0,
                               atol=2e-5)


def test_the_height_filter_keeps_what_differs_at_most_the_tolerance():
    boxes = np.zeros((5, 7), np.float32)
    boxes[:, 5] = [1.25, 1.5, 1.75, 2.0, 2.25]
    assert height_matches(boxes, 1.75, HeightParams(tolerance=0.25)).tolist() == [
        False, True, True, True, False]
    assert height_matches(boxes, 1.75, HeightParams(tolerance=0.0)).tolist() == [
        False, False, True, False, False]


@few
@given(seeds)
def test_group_points_lists_the_wanted_clusters_in_the_order_asked_for(seed):
    xyz, labels = labelled(seed)
    rng = np.random.default_rng(seed)
    wanted = rng.permutation(np.arange(1, labels.max() + 1))[:rng.integers(0, labels.max() + 1)]
    points, start = group_points(xyz, labels, wanted)
    assert len(start) == len(wanted) + 1 and start[0] == 0 and start[-1] == len(points)
    for i, k in enumerate(wanted):  # the points of each in the order of the input
        np.testing.assert_array_equal(points[start[i]:start[i + 1]], xyz[labels == k])


# --- seeds ---------------------------------------------------------------------------------


def test_seed_from_truth_is_the_nearest_pedestrians_points_that_are_not_ground():
    xyz = scene()
    ground = xyz[:, 2] < GROUND_Z + 0.4  # takes the feet too
    boxes = boxes_at(PEOPLE[[2, 0, 1]])
    inside = points_in_box(xyz, boxes[1])
    assert (inside & ground).any()
    seed = seed_from_truth(xyz, ground, boxes)
    np.testing.assert_array_equal(seed.xyz, xyz[inside & ~ground])
    assert seed.height == 1.8 and seed.floor == pytest.approx(boxes[1, 2] - 0.9)
    with_ground = seed_from_points(xyz[inside], boxes[1])
    assert (with_ground.silhouette() != seed.silhouette()).any()


def test_seed_from_truth_needs_a_pedestrian_with_ten_points():
    xyz = person(6, 0, count=9).astype(np.float32)
    none = np.zeros(9, bool)
    with pytest.raises(InputError, match="no Pedestrian"):
        seed_from_truth(xyz, none, np.zeros((0, 7)))
    with pytest.raises(InputError, match="has 9 points"):
        seed_from_truth(xyz, none, boxes_at([[6, 0]]))
    more = np.concatenate([xyz, xyz[:1]])
    assert seed_from_truth(more, np.zeros(10, bool), boxes_at([[6, 0]])).height == 1.8
    with pytest.raises(InputError, match="has 0 points"):
        seed_from_truth(more, np.ones(10, bool), boxes_at([[6, 0]]))


def clicked_scene():
    xyz = np.concatenate([person(6, 0), person(8, 3, seed=1)]).astype(np.float32)
    labels = np.repeat(np.int32([1, 2]), 400)
    return xyz, labels, oriented_boxes(xyz, labels, "axis_aligned")


def test_seed_from_click_is_the_nearest_clusters():
    xyz, labels, boxes = clicked_scene()
    for k, click in ((1, [6, 0.2, -1]), (2, [8.5, 3, 0]), (1, [6, 1.2, -1]), (2, [8, 1.8, -1])):
        seed = seed_from_click(np.array(click), xyz, labels, boxes, 2.0)
        np.testing.assert_array_equal(seed.xyz, xyz[labels == k])
        assert seed.height == boxes[k - 1, 5]
        assert seed.floor == pytest.approx(boxes[k - 1, 2] - boxes[k - 1, 5] / 2)


def test_seed_from_click_takes_no_noise_point_however_near():
    xyz, labels, boxes = clicked_scene()
    xyz = np.concatenate([np.float32([[7, 1.5, -1]]), xyz])
    labels = np.concatenate([np.int32([0]), labels])
    with pytest.raises(InputError, match="nearest cluster is"):
        seed_from_click(np.array([7, 1.5, -1]), xyz, labels, boxes, 0.5)


def test_seed_from_click_needs_a_cluster_within_the_radius():
    xyz, labels, boxes = clicked_scene()
    edge = np.array([xyz[:, 0].min() - 1.0, 0, -1])
    seed_from_click(edge, xyz, labels, boxes, 1.5)
    with pytest.raises(InputError, match=r"within 0\.9 m"):
        seed_from_click(edge, xyz, labels, boxes, 0.9)
    with pytest.raises(InputError, match="no clusters"):
        seed_from_click(edge, xyz, np.zeros_like(labels), boxes[:0], 2.0)


@few
@given(seeds, st.integers(1, 30_000), st.integers(10, 300))
def test_load_seed_is_the_inverse_of_save_seed(tmp_path_factory, seed, tenth_mm, count):
    rng = np.random.default_rng(seed)
    xyz = np.float32(np.round(rng.uniform(-90, 90, (count, 3)), 4))
    path = tmp_path_factory.mktemp("seed") / "folder/template.json"
    save_seed(Seed(xyz, -1.7321, tenth_mm / 10_000), path)
    loaded = load_seed(path)
    np.testing.assert_array_equal(loaded.xyz, xyz)
    assert (loaded.floor, loaded.height) == (-1.7321, tenth_mm / 10_000)


POINTS = [[5.0, 0.1 * i, -1.0] for i in range(10)]
GOOD = {"height_m": 1.7, "floor_m": -1.7, "points_m": POINTS}


def changed(**values):
    return json.dumps({**GOOD, **values})


@pytest.mark.parametrize("text", [
    "", "not JSON", "[]", "{}", "null", "3", '"text"', json.dumps({"height_m": 1.7}),
    json.dumps({"points_m": POINTS}), changed(height_m="tall"), changed(height_m=None),
    changed(height_m=0), changed(height_m=-1.7), changed(height_m=float("nan")),
    changed(floor_m=None), changed(floor_m=float("inf")), changed(points_m=None),
    changed(points_m=7), changed(points_m=[]), changed(points_m=POINTS[:9]),
    changed(points_m=[[1.0, 2.0]] * 10), changed(points_m=[*POINTS, [1.0]]),
    changed(points_m=[*POINTS, [1.0, 2.0, "x"]]), changed(points_m=[*POINTS, [1, 2, float("nan")]]),
])
def test_a_bad_template_is_an_input_error_that_names_the_file(tmp_path, text):
    path = tmp_path / "bad.json"
    path.write_text(text)
    with pytest.raises(InputError, match=r"bad\.json"):
        load_seed(path)


def test_a_template_that_cannot_be_read_is_an_input_error_that_names_it(tmp_path):
    binary = tmp_path / "binary.json"
    binary.write_bytes(b"\xff\xfe\x00\x81")
    for path in (tmp_path / "missing.json", tmp_path, binary):
        with pytest.raises(InputError, match=path.name):
            load_seed(path)


def test_the_default_template_is_a_pedestrian():
    seed = load_seed()
    assert 1.4 < seed.height < 2.1
    pixels = to_pixels(seed.silhouette())
    assert pixels[0].any() and pixels[-1].any() and pixels[:, 0].any() and pixels[:, -1].any()


# --- refinement ----------------------------------------------------------------------------


def rows(detections):
    return {tuple(box) for box in detections.boxes.tolist()}


def with_threshold(threshold):
    return PipelineParams(stm=StmParams(threshold=threshold))


def test_the_later_stages_are_subsets_of_the_first_and_it_of_the_clusters():
    s = segment(LidarFrame(scene()))
    seed = truth_seed(boxes_at(PEOPLE))(s)
    tall = height_matches(s.boxes, seed.height, HeightParams())
    assert 3 < tall.sum() < len(s.boxes)
    for threshold in (0.0, 0.4, 0.7, 0.9, 1.0):
        found = refined(s, fixed_seed(seed), with_threshold(threshold))
        assert rows(found.stage1) == {tuple(box) for box in s.boxes[tall].tolist()}
        assert rows(found.stage2) <= rows(found.stage1)
        assert rows(found.final) <= rows(found.stage1)
        for stage in (found.stage2, found.final):
            assert (stage.scores >= np.float32(threshold)).all()
            assert (stage.class_ids == PEDESTRIAN).all()


def test_at_threshold_0_every_stage_1_cluster_passes_and_at_1_the_seed_does():
    s = segment(LidarFrame(scene()))
    k = s.cluster_ids[np.argmin(np.linalg.norm(s.xyz - [7, 2, -1], axis=1))]
    own = seed_from_points(s.xyz[s.cluster_ids == k], s.boxes[k - 1])
    everything = refined(s, fixed_seed(own), with_threshold(0.0))
    assert rows(everything.stage2) == rows(everything.final) == rows(everything.stage1)
    exact = refined(s, fixed_seed(own), with_threshold(1.0))
    for stage in (exact.stage2, exact.final):
        assert rows(stage) == {tuple(s.boxes[k - 1].tolist())}
        assert stage.scores.tolist() == [1.0]


def test_only_clusters_of_15_to_30_metres_change_their_score_by_augmentation():
    s = segment(LidarFrame(scene()))
    found = refined(s, truth_seed(boxes_at(PEOPLE)), with_threshold(0.0))
    np.testing.assert_array_equal(found.final.boxes, found.stage1.boxes)
    ranges = np.hypot(*found.final.boxes[:, :2].T)
    differs = found.final.scores != found.stage1.scores
    assert differs.any() and not differs[(ranges < 15) | (ranges >= 30)].any()


def test_a_threshold_cuts_each_stage_by_the_stages_own_scores():
    s = segment(LidarFrame(scene()))
    seed = fixed_seed(truth_seed(boxes_at(PEOPLE))(s))
    everything = refined(s, seed, with_threshold(0.0))
    assert (everything.final.scores != everything.stage2.scores).any()
    scores = np.unique(np.concatenate([everything.stage2.scores, everything.final.scores]))
    scores = scores[np.diff(scores, prepend=0) > 1e-4].astype(float)
    for threshold in (scores[1:] + scores[:-1]) / 2:
        found = refined(s, seed, with_threshold(float(threshold)))
        for name in ("stage2", "final"):
            stage, all_of_it = getattr(found, name), getattr(everything, name)
            assert rows(stage) == rows(all_of_it[all_of_it.scores >= threshold])


def test_the_people_are_found_and_the_rest_is_not():
    _, found = find_candidates(LidarFrame(scene()), truth_seed(boxes_at(PEOPLE)),
                               params=with_threshold(0.75))
    order = np.argsort(found.final.boxes[:, 0])
    np.testing.assert_allclose(found.final.boxes[order, :2], PEOPLE + [0.05, 0], atol=0.1)
    bottoms = found.final.boxes[:, 2] - found.final.boxes[:, 5] / 2
    np.testing.assert_allclose(bottoms, GROUND_Z, atol=0.02)


def test_refining_without_clusters_finds_none():
    seed = Seed(person(7, 2).astype(np.float32), -1.7, 1.7)
    xyz = np.ones((5, 3), np.float32)
    found = refine(xyz, np.zeros(5, np.int32), np.zeros((0, 7), np.float32), seed)
    for stage in (found.stage1, found.stage2, found.final):
        assert stage.boxes.shape == (0, 7) and stage.scores.shape == (0,)
    assert set(found.ms) == {"height", "stm", "cpa", "confidence"}


@needs_data
def test_on_a_real_frame_the_seeds_own_cluster_passes_every_stage():
    checked = 0
    for frame in open_kitti(DATA / "kitti_object")[:12]:
        truth = frame.truth().of_class(PEDESTRIAN)
        if len(truth) == 0:
            continue
        s = segment(frame.load())
        click = clicked_seed(truth[np.hypot(*truth[:, :2].T).argmin(), :3], SeedParams())
        try:
            seed = click(s)
        except InputError:
            continue
        found = refined(s, click, PipelineParams())
        assert seed.height in found.stage2.boxes[:, 5] and found.stage2.scores.max() == 1.0
        assert rows(found.stage2) | rows(found.final) <= rows(found.stage1)
        checked += 1
    assert checked > 0


# --- the whole pipeline --------------------------------------------------------------------


def template():
    return fixed_seed(seed_from_points(person(7, 2).astype(np.float32), boxes_at([[7, 2]])[0]))


@pytest.mark.parametrize("xyz", [np.zeros((0, 3)), np.float32([[5, 0, -1]]),
                                 np.float32([[5, 0, -1.7]]), floor()],
                         ids=["empty", "one point", "one low point", "only ground"])
def test_frames_without_objects_give_empty_results_of_the_right_shape(xyz):
    s, found = find_candidates(LidarFrame(xyz.astype(np.float32)), template())
    assert isinstance(s, Segmented)
    assert s.places.tolist() == list(range(len(xyz))) and s.xyz.shape == (len(xyz), 3)
    assert s.ground.shape == (len(xyz),) and s.ground.dtype == bool
    assert s.cluster_ids.shape == (len(xyz),) and s.cluster_ids.dtype == np.int32
    assert s.boxes.shape == (0, 7) and s.boxes.dtype == np.float32
    for stage in (found.stage1, found.stage2, found.final):
        assert stage.boxes.shape == (0, 7) and stage.boxes.dtype == np.float32
        assert stage.class_ids.shape == stage.scores.shape == (0,)
    assert tuple(found.ms) == STEPS


def test_without_a_seed_the_frame_is_an_input_error():
    with pytest.raises(InputError, match="no Pedestrian"):
        find_candidates(LidarFrame(scene()), truth_seed(np.zeros((0, 7))))
    with pytest.raises(InputError, match="no clusters"):
        find_candidates(LidarFrame(floor().astype(np.float32)), clicked_seed(np.zeros(3)))


CROP = PipelineParams(view=ViewParams(enabled=True))


def test_the_crop_without_a_camera_is_an_input_error_that_names_the_remedy():
    with pytest.raises(InputError, match=r"view\.enabled"):
        find_candidates(LidarFrame(scene()), template(), params=CROP)


def test_the_crop_is_the_pipeline_on_the_points_in_view():
    # A camera at the sensor that looks along x: its x is -y, its y is -z, its z is x.
    axes = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]])
    intrinsics = np.array([[600, 0, 500], [0, 600, 300], [0, 0, 1]])
    camera = Camera(np.column_stack([intrinsics @ axes, np.zeros(3)]), 1000, 600)
    xyz = scene()
    inside = camera.in_view(xyz)
    assert 0 < inside.sum() < len(xyz)
    cropped, found = find_candidates(LidarFrame(xyz), template(), camera, CROP)
    np.testing.assert_array_equal(cropped.places, np.flatnonzero(inside))
    alone, expected = find_candidates(LidarFrame(xyz[inside]), template())
    np.testing.assert_array_equal(cropped.xyz, alone.xyz)
    np.testing.assert_array_equal(cropped.cluster_ids, alone.cluster_ids)
    np.testing.assert_array_equal(found.final.boxes, expected.final.boxes)
    empty, _ = find_candidates(LidarFrame(np.zeros((0, 3), np.float32)), template(), camera, CROP)
    assert empty.xyz.shape == (0, 3)


@pytest.mark.parametrize("seed", range(4))
def test_the_result_does_not_depend_on_the_order_of_the_points(seed):
    xyz = scene()
    order = np.random.default_rng(seed).permutation(len(xyz))
    s, found = find_candidates(LidarFrame(xyz), template())
    t, shuffled = find_candidates(LidarFrame(xyz[order]), template())
    np.testing.assert_array_equal(t.ground, s.ground[order])
    np.testing.assert_array_equal(t.cluster_ids > 0, s.cluster_ids[order] > 0)
    for name in ("stage1", "stage2", "final"):
        a, b = (getattr(c, name) for c in (found, shuffled))
        assert len(a) == len(b) > 0
        i, j = np.lexsort(a.boxes.T), np.lexsort(b.boxes.T)
        np.testing.assert_allclose(a.boxes[i], b.boxes[j], rtol=0, atol=1e-5)
        np.testing.assert_allclose(a.scores[i], b.scores[j], rtol=0, atol=1e-5)


def test_ground_points_belong_to_no_cluster_and_ids_count_the_boxes():
    s = segment(LidarFrame(scene()))
    assert not (s.ground & (s.cluster_ids > 0)).any()
    assert np.unique(s.cluster_ids).tolist() == list(range(len(s.boxes) + 1))
