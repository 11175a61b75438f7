"""Candidates: boxes snapped to the ground, the height filter, and refinement by a seed."""

from __future__ import annotations

import numpy as np
import pytest
from candidate_samples import GROUND_Z, PEOPLE, make_boxes_at, make_people_scene, make_person
from hypothesis import given
from hypothesis import strategies as st
from samples import DATA, needs_data

from lidar_perception.candidates.configurations import BEST
from lidar_perception.candidates.params import HeightParams, PipelineParams, SeedParams, StmParams
from lidar_perception.candidates.pipeline import find_candidates, refine_segmented, segment_cloud
from lidar_perception.candidates.refine import refine_clusters, select_by_height
from lidar_perception.candidates.seed_sources import make_click_source, make_fixed_source, make_truth_source
from lidar_perception.candidates.seeds import Seed, seed_from_points
from lidar_perception.candidates.segmented_cloud import snap_to_ground
from lidar_perception.clustering.shapes import fit_boxes
from lidar_perception.data.open import open_recording
from lidar_perception.groups import group_points
from lidar_perception.param_fields import with_values
from lidar_perception.types import PEDESTRIAN, InputError, PointCloud

seeds = st.integers(0, 2**32 - 1)


def make_labelled_points(seed):
    """Return random points with ids 0..K, where every cluster has at least one point."""
    rng = np.random.default_rng(seed)
    count = rng.integers(1, 8)
    labels = np.concatenate([np.arange(1, count + 1), rng.integers(0, count + 1, 60)])
    xyz = rng.uniform(-30, 30, (len(labels), 3)).astype(np.float32)
    return xyz, rng.permutation(labels).astype(np.int32)


@given(seeds, st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(-20, 20))
def test_snapping_extends_boxes_down_to_the_plane(seed, a, b, c):
    boxes = fit_boxes(*make_labelled_points(seed), "axis_aligned")
    original = boxes.copy()
    snapped = snap_to_ground(boxes, np.array([a, b, c]))
    assert snapped.dtype == np.float32
    bottom, top = (original[:, 2] + s * original[:, 5] / 2 for s in (-1, 1))
    ground = a * original[:, 0] + b * original[:, 1] + c
    np.testing.assert_allclose(snapped[:, 2] + snapped[:, 5] / 2, top, rtol=0, atol=2e-5)
    np.testing.assert_allclose(snapped[:, 2] - snapped[:, 5] / 2, np.minimum(bottom, ground), rtol=0, atol=2e-5)
    np.testing.assert_array_equal(snapped[:, [0, 1, 3, 4, 6]], original[:, [0, 1, 3, 4, 6]])
    np.testing.assert_array_equal(boxes, original)  # the input is not modified
    np.testing.assert_array_equal(snap_to_ground(boxes, None), original)
    np.testing.assert_allclose(snap_to_ground(snapped, np.array([a, b, c])), snapped, rtol=0, atol=2e-5)


def test_height_filter_includes_its_tolerance():
    boxes = np.zeros((5, 7), np.float32)
    boxes[:, 5] = [1.25, 1.5, 1.75, 2.0, 2.25]
    assert select_by_height(boxes, 1.75, HeightParams(tolerance=0.25)).tolist() == [False, True, True, True, False]
    assert select_by_height(boxes, 1.75, HeightParams(tolerance=0.0)).tolist() == [False, False, True, False, False]


@given(seeds)
def test_group_points_keeps_the_given_order_of_clusters(seed):
    xyz, labels = make_labelled_points(seed)
    rng = np.random.default_rng(seed)
    cluster_order = rng.permutation(np.arange(1, labels.max() + 1))[: rng.integers(0, labels.max() + 1)]
    points, start = group_points(xyz, labels, cluster_order)
    assert len(start) == len(cluster_order) + 1 and start[0] == 0 and start[-1] == len(points)
    for i, k in enumerate(cluster_order):  # each cluster's points are in the order of the input
        np.testing.assert_array_equal(points[start[i] : start[i + 1]], xyz[labels == k])


def to_rows(detections):
    return {tuple(box) for box in detections.boxes.tolist()}


def make_params(threshold):
    return PipelineParams(stm=StmParams(threshold=threshold))


def test_stages_are_subsets_of_the_first_stage():
    segmented = segment_cloud(PointCloud(make_people_scene()))
    (seed,) = make_truth_source(make_boxes_at(PEOPLE))(segmented)
    has_seed_height = select_by_height(segmented.boxes, seed.height, HeightParams())
    assert 3 < has_seed_height.sum() < len(segmented.boxes)
    for threshold in (0.0, 0.4, 0.7, 0.9, 1.0):
        candidates = refine_segmented(segmented, make_fixed_source(seed), make_params(threshold))
        assert to_rows(candidates.stage1) == {tuple(box) for box in segmented.boxes[has_seed_height].tolist()}
        assert to_rows(candidates.stage2) <= to_rows(candidates.stage1)
        assert to_rows(candidates.final) <= to_rows(candidates.stage1)
        for stage in (candidates.stage2, candidates.final):
            assert (stage.scores >= np.float32(threshold)).all()
            assert (stage.class_ids == PEDESTRIAN).all()


def test_threshold_0_accepts_all_clusters_and_1_only_the_seed():
    segmented = segment_cloud(PointCloud(make_people_scene()))
    k = segmented.cluster_ids[np.argmin(np.linalg.norm(segmented.xyz - [7, 2, -1], axis=1))]
    seed = seed_from_points(segmented.xyz[segmented.cluster_ids == k], segmented.boxes[k - 1])
    unfiltered = refine_segmented(segmented, make_fixed_source(seed), make_params(0.0))
    assert to_rows(unfiltered.stage2) == to_rows(unfiltered.final) == to_rows(unfiltered.stage1)
    strict = refine_segmented(segmented, make_fixed_source(seed), make_params(1.0))
    for stage in (strict.stage2, strict.final):
        assert to_rows(stage) == {tuple(segmented.boxes[k - 1].tolist())}
        assert stage.scores.tolist() == [1.0]


def test_augmentation_changes_scores_from_15_to_30_metres_only():
    segmented = segment_cloud(PointCloud(make_people_scene()))
    candidates = refine_segmented(segmented, make_truth_source(make_boxes_at(PEOPLE)), make_params(0.0))
    np.testing.assert_array_equal(candidates.final.boxes, candidates.stage1.boxes)
    ranges = np.hypot(*candidates.final.boxes[:, :2].T)
    differs = candidates.final.scores != candidates.stage1.scores
    assert differs.any() and not differs[(ranges < 15) | (ranges >= 30)].any()


def test_threshold_applies_to_the_scores_of_each_stage():
    segmented = segment_cloud(PointCloud(make_people_scene()))
    seed = make_fixed_source(*make_truth_source(make_boxes_at(PEOPLE))(segmented))
    unfiltered = refine_segmented(segmented, seed, make_params(0.0))
    assert (unfiltered.final.scores != unfiltered.stage2.scores).any()
    scores = np.unique(np.concatenate([unfiltered.stage2.scores, unfiltered.final.scores]))
    scores = scores[np.diff(scores, prepend=0) > 1e-4].astype(float)
    for threshold in (scores[1:] + scores[:-1]) / 2:
        candidates = refine_segmented(segmented, seed, make_params(float(threshold)))
        for name in ("stage2", "final"):
            stage, unfiltered_stage = getattr(candidates, name), getattr(unfiltered, name)
            assert to_rows(stage) == to_rows(unfiltered_stage[unfiltered_stage.scores >= threshold])


def test_pedestrians_are_candidates_and_other_objects_are_not():
    _, candidates = find_candidates(
        PointCloud(make_people_scene()), make_truth_source(make_boxes_at(PEOPLE)), params=make_params(0.75)
    )
    order = np.argsort(candidates.final.boxes[:, 0])
    np.testing.assert_allclose(candidates.final.boxes[order, :2], PEOPLE + [0.05, 0], atol=0.1)
    bottoms = candidates.final.boxes[:, 2] - candidates.final.boxes[:, 5] / 2
    np.testing.assert_allclose(bottoms, GROUND_Z, atol=0.02)


def test_refining_without_clusters_finds_no_candidates():
    seed = Seed(make_person(7, 2).astype(np.float32), -1.7, 1.7)
    xyz = np.ones((5, 3), np.float32)
    candidates = refine_clusters(xyz, np.zeros(5, np.int32), np.zeros((0, 7), np.float32), [seed])
    for stage in (candidates.stage1, candidates.stage2, candidates.final):
        assert stage.boxes.shape == (0, 7) and stage.scores.shape == (0,)
    assert set(candidates.ms) == {"height", "stm", "cpa", "confidence"}


@needs_data
def test_seed_cluster_passes_every_stage():
    frame_count = 0
    for frame in open_recording(DATA / "kitti_object").frames[:12]:
        truth = frame.truth().select_class(PEDESTRIAN)
        if len(truth) == 0:
            continue
        segmented = segment_cloud(frame.load())
        click = make_click_source(truth[np.hypot(*truth[:, :2].T).argmin(), :3], SeedParams())
        try:
            (seed,) = click(segmented)
        except InputError:
            continue
        candidates = refine_segmented(segmented, click, PipelineParams())
        assert seed.height in candidates.stage2.boxes[:, 5] and candidates.stage2.scores.max() == 1.0
        assert to_rows(candidates.stage2) | to_rows(candidates.final) <= to_rows(candidates.stage1)
        frame_count += 1
    assert frame_count > 0


def test_candidates_keep_the_ids_of_given_clusters():
    """Ids may have gaps and be huge; the candidates are the same as for 1..K."""
    frame = PointCloud(make_people_scene())
    segmented = segment_cloud(frame)
    cluster_count = len(segmented.boxes)
    source = make_fixed_source(seed_from_points(segmented.xyz[segmented.cluster_ids == 1], segmented.boxes[0]))
    expected = refine_segmented(segmented, source)
    assert len(expected.final) > 1
    for foreign_ids in (np.arange(1, cluster_count + 1) * 2 + 1, np.arange(cluster_count) * 10_000_000 + 2**31):
        ids = np.concatenate([[0], foreign_ids])[segmented.cluster_ids].astype(np.uint32)
        candidates = refine_segmented(segment_cloud(frame, ground=segmented.ground, cluster_ids=ids), source)
        np.testing.assert_array_equal(candidates.final.boxes, expected.final.boxes)
        np.testing.assert_array_equal(candidates.clusters, foreign_ids[expected.clusters - 1])


@pytest.mark.parametrize(
    "params",
    [
        make_params(0.0),
        with_values(BEST, {"view.enabled": False, "confidence.threshold": 0.0, "height.tolerance": 0.3}),
    ],
)
def test_seed_bank_gives_each_cluster_its_best_score(params):
    segmented = segment_cloud(PointCloud(make_people_scene()), params=params)
    sizes = np.bincount(segmented.cluster_ids)[1:]
    seeds = [
        seed_from_points(segmented.xyz[segmented.cluster_ids == k + 1], segmented.boxes[k])
        for k in np.argsort(-sizes)[:4]
    ]
    best_scores = {}
    for seed in seeds:
        candidates = refine_segmented(segmented, make_fixed_source(seed), params)
        for cluster, score in zip(candidates.clusters.tolist(), candidates.final.scores.tolist()):
            best_scores[cluster] = max(score, best_scores.get(cluster, 0.0))
    bank_candidates = refine_segmented(segmented, make_fixed_source(*seeds), params)
    assert dict(zip(bank_candidates.clusters.tolist(), bank_candidates.final.scores.tolist())) == best_scores
