"""Candidates: boxes snapped to the ground, the height filter, and refinement by a seed."""

from __future__ import annotations

import numpy as np
import pytest
from candidate_samples import GROUND_Z, PEOPLE, boxes_at, person, scene
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
def test_snapping_lowers_bottoms_to_the_plane_and_keeps_tops(seed, a, b, c):
    boxes = fit_boxes(*make_labelled_points(seed), "axis_aligned")
    before = boxes.copy()
    snapped = snap_to_ground(boxes, np.array([a, b, c]))
    assert snapped.dtype == np.float32
    bottom, top = (before[:, 2] + s * before[:, 5] / 2 for s in (-1, 1))
    ground = a * before[:, 0] + b * before[:, 1] + c
    np.testing.assert_allclose(snapped[:, 2] + snapped[:, 5] / 2, top, rtol=0, atol=2e-5)
    np.testing.assert_allclose(snapped[:, 2] - snapped[:, 5] / 2, np.minimum(bottom, ground), rtol=0, atol=2e-5)
    np.testing.assert_array_equal(snapped[:, [0, 1, 3, 4, 6]], before[:, [0, 1, 3, 4, 6]])
    np.testing.assert_array_equal(boxes, before)  # the input is not modified
    np.testing.assert_array_equal(snap_to_ground(boxes, None), before)
    np.testing.assert_allclose(snap_to_ground(snapped, np.array([a, b, c])), snapped, rtol=0, atol=2e-5)


def test_the_height_filter_includes_the_tolerance():
    boxes = np.zeros((5, 7), np.float32)
    boxes[:, 5] = [1.25, 1.5, 1.75, 2.0, 2.25]
    assert select_by_height(boxes, 1.75, HeightParams(tolerance=0.25)).tolist() == [False, True, True, True, False]
    assert select_by_height(boxes, 1.75, HeightParams(tolerance=0.0)).tolist() == [False, False, True, False, False]


@given(seeds)
def test_group_points_keeps_the_given_order_of_clusters(seed):
    xyz, labels = make_labelled_points(seed)
    rng = np.random.default_rng(seed)
    wanted = rng.permutation(np.arange(1, labels.max() + 1))[: rng.integers(0, labels.max() + 1)]
    points, start = group_points(xyz, labels, wanted)
    assert len(start) == len(wanted) + 1 and start[0] == 0 and start[-1] == len(points)
    for i, k in enumerate(wanted):  # each cluster's points are in the order of the input
        np.testing.assert_array_equal(points[start[i] : start[i + 1]], xyz[labels == k])


def rows(detections):
    return {tuple(box) for box in detections.boxes.tolist()}


def with_threshold(threshold):
    return PipelineParams(stm=StmParams(threshold=threshold))


def test_stages_are_subsets_of_the_first_stage():
    s = segment_cloud(PointCloud(scene()))
    (seed,) = make_truth_source(boxes_at(PEOPLE))(s)
    tall = select_by_height(s.boxes, seed.height, HeightParams())
    assert 3 < tall.sum() < len(s.boxes)
    for threshold in (0.0, 0.4, 0.7, 0.9, 1.0):
        found = refine_segmented(s, make_fixed_source(seed), with_threshold(threshold))
        assert rows(found.stage1) == {tuple(box) for box in s.boxes[tall].tolist()}
        assert rows(found.stage2) <= rows(found.stage1)
        assert rows(found.final) <= rows(found.stage1)
        for stage in (found.stage2, found.final):
            assert (stage.scores >= np.float32(threshold)).all()
            assert (stage.class_ids == PEDESTRIAN).all()


def test_threshold_0_accepts_every_cluster_and_1_only_the_seed():
    s = segment_cloud(PointCloud(scene()))
    k = s.cluster_ids[np.argmin(np.linalg.norm(s.xyz - [7, 2, -1], axis=1))]
    own = seed_from_points(s.xyz[s.cluster_ids == k], s.boxes[k - 1])
    everything = refine_segmented(s, make_fixed_source(own), with_threshold(0.0))
    assert rows(everything.stage2) == rows(everything.final) == rows(everything.stage1)
    exact = refine_segmented(s, make_fixed_source(own), with_threshold(1.0))
    for stage in (exact.stage2, exact.final):
        assert rows(stage) == {tuple(s.boxes[k - 1].tolist())}
        assert stage.scores.tolist() == [1.0]


def test_augmentation_changes_scores_from_15_to_30_metres_only():
    s = segment_cloud(PointCloud(scene()))
    found = refine_segmented(s, make_truth_source(boxes_at(PEOPLE)), with_threshold(0.0))
    np.testing.assert_array_equal(found.final.boxes, found.stage1.boxes)
    ranges = np.hypot(*found.final.boxes[:, :2].T)
    differs = found.final.scores != found.stage1.scores
    assert differs.any() and not differs[(ranges < 15) | (ranges >= 30)].any()


def test_the_threshold_applies_to_each_stages_own_scores():
    s = segment_cloud(PointCloud(scene()))
    seed = make_fixed_source(*make_truth_source(boxes_at(PEOPLE))(s))
    everything = refine_segmented(s, seed, with_threshold(0.0))
    assert (everything.final.scores != everything.stage2.scores).any()
    scores = np.unique(np.concatenate([everything.stage2.scores, everything.final.scores]))
    scores = scores[np.diff(scores, prepend=0) > 1e-4].astype(float)
    for threshold in (scores[1:] + scores[:-1]) / 2:
        found = refine_segmented(s, seed, with_threshold(float(threshold)))
        for name in ("stage2", "final"):
            stage, unfiltered = getattr(found, name), getattr(everything, name)
            assert rows(stage) == rows(unfiltered[unfiltered.scores >= threshold])


def test_pedestrians_are_candidates_and_other_objects_are_not():
    _, found = find_candidates(PointCloud(scene()), make_truth_source(boxes_at(PEOPLE)), params=with_threshold(0.75))
    order = np.argsort(found.final.boxes[:, 0])
    np.testing.assert_allclose(found.final.boxes[order, :2], PEOPLE + [0.05, 0], atol=0.1)
    bottoms = found.final.boxes[:, 2] - found.final.boxes[:, 5] / 2
    np.testing.assert_allclose(bottoms, GROUND_Z, atol=0.02)


def test_refining_without_clusters_finds_no_candidates():
    seed = Seed(person(7, 2).astype(np.float32), -1.7, 1.7)
    xyz = np.ones((5, 3), np.float32)
    found = refine_clusters(xyz, np.zeros(5, np.int32), np.zeros((0, 7), np.float32), [seed])
    for stage in (found.stage1, found.stage2, found.final):
        assert stage.boxes.shape == (0, 7) and stage.scores.shape == (0,)
    assert set(found.ms) == {"height", "stm", "cpa", "confidence"}


@needs_data
def test_the_seeds_own_cluster_passes_every_stage():
    checked = 0
    for frame in open_recording(DATA / "kitti_object").frames[:12]:
        truth = frame.truth().select_class(PEDESTRIAN)
        if len(truth) == 0:
            continue
        s = segment_cloud(frame.load())
        click = make_click_source(truth[np.hypot(*truth[:, :2].T).argmin(), :3], SeedParams())
        try:
            (seed,) = click(s)
        except InputError:
            continue
        found = refine_segmented(s, click, PipelineParams())
        assert seed.height in found.stage2.boxes[:, 5] and found.stage2.scores.max() == 1.0
        assert rows(found.stage2) | rows(found.final) <= rows(found.stage1)
        checked += 1
    assert checked > 0


def test_candidates_keep_the_ids_of_a_foreign_clustering():
    """Ids may have gaps and be huge; the candidates are the same as for 1..K."""
    frame = PointCloud(scene())
    s = segment_cloud(frame)
    k = len(s.boxes)
    source = make_fixed_source(seed_from_points(s.xyz[s.cluster_ids == 1], s.boxes[0]))
    expected = refine_segmented(s, source)
    assert len(expected.final) > 1
    for foreign in (np.arange(1, k + 1) * 2 + 1, np.arange(k) * 10_000_000 + 2**31):
        ids = np.concatenate([[0], foreign])[s.cluster_ids].astype(np.uint32)
        found = refine_segmented(segment_cloud(frame, ground=s.ground, cluster_ids=ids), source)
        np.testing.assert_array_equal(found.final.boxes, expected.final.boxes)
        np.testing.assert_array_equal(found.clusters, foreign[expected.clusters - 1])


@pytest.mark.parametrize(
    "params",
    [
        with_threshold(0.0),
        with_values(BEST, {"view.enabled": False, "confidence.threshold": 0.0, "height.tolerance": 0.3}),
    ],
)
def test_seed_bank_gives_each_cluster_its_best_score(params):
    s = segment_cloud(PointCloud(scene()), params=params)
    sizes = np.bincount(s.cluster_ids)[1:]
    seeds = [seed_from_points(s.xyz[s.cluster_ids == k + 1], s.boxes[k]) for k in np.argsort(-sizes)[:4]]
    best = {}
    for seed in seeds:
        alone = refine_segmented(s, make_fixed_source(seed), params)
        for cluster, score in zip(alone.clusters.tolist(), alone.final.scores.tolist()):
            best[cluster] = max(score, best.get(cluster, 0.0))
    together = refine_segmented(s, make_fixed_source(*seeds), params)
    assert dict(zip(together.clusters.tolist(), together.final.scores.tolist())) == best
