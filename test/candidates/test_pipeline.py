"""The complete candidate pipeline."""

from __future__ import annotations

import numpy as np
import pytest
from candidate_samples import make_boxes_at, make_floor, make_people_scene, make_person

from lidar_perception.camera import Camera
from lidar_perception.candidates.params import STEPS, PipelineParams
from lidar_perception.candidates.pipeline import find_candidates, segment_cloud
from lidar_perception.candidates.seed_sources import make_click_source, make_fixed_source, make_truth_source
from lidar_perception.candidates.seeds import seed_from_points
from lidar_perception.candidates.segmented_cloud import SegmentedCloud
from lidar_perception.types import InputError, PointCloud
from lidar_perception.wire.params import ViewParams


def make_template_source():
    return make_fixed_source(seed_from_points(make_person(7, 2).astype(np.float32), make_boxes_at([[7, 2]])[0]))


@pytest.mark.parametrize(
    "xyz",
    [np.zeros((0, 3)), np.float32([[5, 0, -1]]), np.float32([[5, 0, -1.7]]), make_floor()],
    ids=["empty", "one point", "one low point", "only ground"],
)
def test_clouds_without_objects_give_empty_results(xyz):
    segmented, candidates = find_candidates(PointCloud(xyz.astype(np.float32)), make_template_source())
    assert isinstance(segmented, SegmentedCloud)
    assert segmented.indices.tolist() == list(range(len(xyz))) and segmented.xyz.shape == (len(xyz), 3)
    assert segmented.ground.shape == (len(xyz),) and segmented.ground.dtype == bool
    assert segmented.cluster_ids.shape == (len(xyz),) and segmented.cluster_ids.dtype == np.int32
    assert segmented.boxes.shape == (0, 7) and segmented.boxes.dtype == np.float32
    for stage in (candidates.stage1, candidates.stage2, candidates.final):
        assert stage.boxes.shape == (0, 7) and stage.boxes.dtype == np.float32
        assert stage.class_ids.shape == stage.scores.shape == (0,)
    assert tuple(candidates.ms) == STEPS


def test_cloud_without_a_seed_raises_input_error():
    with pytest.raises(InputError, match="no Pedestrian"):
        find_candidates(PointCloud(make_people_scene()), make_truth_source(np.zeros((0, 7))))
    with pytest.raises(InputError, match="no clusters"):
        find_candidates(PointCloud(make_floor().astype(np.float32)), make_click_source(np.zeros(3)))


WITH_VIEW = PipelineParams(view=ViewParams(enabled=True))


def test_error_for_missing_camera_names_the_remedy():
    with pytest.raises(InputError, match=r"view\.enabled"):
        find_candidates(PointCloud(make_people_scene()), make_template_source(), params=WITH_VIEW)


def test_restricted_view_equals_pipeline_on_cropped_points():
    # Camera at the sensor, looking along x: image x = -y, image y = -z, depth = x.
    axes = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]])
    intrinsics = np.array([[600, 0, 500], [0, 600, 300], [0, 0, 1]])
    camera = Camera(np.column_stack([intrinsics @ axes, np.zeros(3)]), 1000, 600)
    xyz = make_people_scene()
    in_view = camera.in_view(xyz)
    assert 0 < in_view.sum() < len(xyz)
    segmented, candidates = find_candidates(PointCloud(xyz), make_template_source(), camera, WITH_VIEW)
    np.testing.assert_array_equal(segmented.indices, np.flatnonzero(in_view))
    expected_cloud, expected = find_candidates(PointCloud(xyz[in_view]), make_template_source())
    np.testing.assert_array_equal(segmented.xyz, expected_cloud.xyz)
    np.testing.assert_array_equal(segmented.cluster_ids, expected_cloud.cluster_ids)
    np.testing.assert_array_equal(candidates.final.boxes, expected.final.boxes)
    empty, _ = find_candidates(PointCloud(np.zeros((0, 3), np.float32)), make_template_source(), camera, WITH_VIEW)
    assert empty.xyz.shape == (0, 3)


@pytest.mark.parametrize("seed", range(4))
def test_order_of_the_points_does_not_matter(seed):
    xyz = make_people_scene()
    order = np.random.default_rng(seed).permutation(len(xyz))
    segmented, candidates = find_candidates(PointCloud(xyz), make_template_source())
    shuffled_segmented, shuffled_candidates = find_candidates(PointCloud(xyz[order]), make_template_source())
    np.testing.assert_array_equal(shuffled_segmented.ground, segmented.ground[order])
    np.testing.assert_array_equal(shuffled_segmented.cluster_ids > 0, segmented.cluster_ids[order] > 0)
    for name in ("stage1", "stage2", "final"):
        a, b = (getattr(result, name) for result in (candidates, shuffled_candidates))
        assert len(a) == len(b) > 0
        i, j = np.lexsort(a.boxes.T), np.lexsort(b.boxes.T)
        np.testing.assert_allclose(a.boxes[i], b.boxes[j], rtol=0, atol=1e-5)
        np.testing.assert_allclose(a.scores[i], b.scores[j], rtol=0, atol=1e-5)


def test_ground_points_have_no_cluster_and_ids_match_boxes():
    segmented = segment_cloud(PointCloud(make_people_scene()))
    assert not (segmented.ground & (segmented.cluster_ids > 0)).any()
    assert np.unique(segmented.cluster_ids).tolist() == list(range(len(segmented.boxes) + 1))
