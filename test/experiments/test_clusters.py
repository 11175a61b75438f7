"""Paper C's segmentation experiment: counts, the range image method, and the report."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from samples import write_crowd_folder

from experiments.clusters.experiment import SEGMENTATION
from experiments.clusters.range_image import cluster_range_image
from experiments.clusters.segmentation import COUNT_COLUMNS, count_points, pair_clusters
from experiments.clusters.segmentation_tables import compute_object_scores, compute_scores
from experiments.framework.statistics import compute_paired_p
from lidar_perception.data.open import open_recording
from lidar_perception.scoring.points.segmentation import Objects
from lidar_perception.types import InputError


def make_objects(owner, region=None):
    owner = np.asarray(owner, np.int32)
    region = owner if region is None else np.asarray(region, np.int32)
    count = int(owner.max(initial=0))
    return Objects(owner, region, region > 0, np.ones(len(owner), bool), tuple("abcdef"[:count]), np.full(count, 10.0))


def scores(ids, owner, ground=None, region=None):
    ground = np.zeros(len(owner), bool) if ground is None else np.asarray(ground, bool)
    counts = count_points(np.asarray(ids, np.int32), ground, make_objects(owner, region))
    return dict(zip(COUNT_COLUMNS, counts)), compute_scores(np.array(counts, float)).tolist()


def test_perfect_clusters_score_100_with_any_numbers():
    owner = np.repeat([0, 1, 2, 0], [30, 10, 20, 5])
    counts, found = scores(np.repeat([0, 7, 3, 9], [30, 10, 20, 5]), owner)
    assert found == [100] * 5 and counts["hits"] == counts["objects"] == 2


def test_point_scores_equal_hand_computed_values():
    # Object 1 is cut in two; its larger part also has 5 background points. Object 2 is ground.
    owner = np.repeat([1, 1, 0, 2, 0, 0], [12, 8, 5, 10, 15, 40])
    ids = np.repeat([4, 5, 4, 0, 6, 0], [12, 8, 5, 10, 15, 40])
    ground = np.repeat([0, 0, 0, 1, 0, 1], [12, 8, 5, 10, 15, 40])
    counts, found = scores(ids, owner, ground)
    assert [counts[k] for k in COUNT_COLUMNS[:5]] == [50, 12 + 15, 12, 17, 30]
    assert found == pytest.approx([100 * 27 / 50, 100 * 12 / 17, 40, 2400 / 47, 100 * 12 / 35])
    assert counts["objects"] == 2 and counts["hits"] == 0


def test_neutral_points_of_an_object_do_not_count():
    owner, region = np.repeat([1, 0], [10, 10]), np.ones(20)
    assert scores(np.ones(20), owner, region=region)[1] == [100] * 5


@given(st.integers(0, 2**32 - 1))
def test_each_object_is_paired_with_one_overlapping_cluster(seed):
    rng = np.random.default_rng(seed)
    owner, ids = rng.integers(0, 5, 80), rng.integers(0, 6, 80)
    cluster_of = pair_clusters(ids, owner, 4)
    paired = cluster_of[cluster_of > 0]
    assert len(np.unique(paired)) == len(paired)
    for k in np.flatnonzero(cluster_of):
        assert ((owner == k + 1) & (ids == cluster_of[k])).any()


def test_object_scores_equal_hand_computed_values():
    counts = np.array([0, 0, 0, 0, 0, 4, 2, 3, 2.5])
    recall, precision, f1, iou = compute_object_scores(counts)
    assert (recall, precision, f1, iou) == pytest.approx((50, 200 / 3, 400 / 7, 62.5))


def make_panel(x, y, width=1.0):
    """Return the points of a wall, 1 m high and `width` metres wide, that begins at (x, y)."""
    z, side = (g.ravel() for g in np.meshgrid(np.arange(-1, 0, 0.05), np.arange(0, width, 0.03)))
    return np.stack([np.full(len(z), x), y + side, z], axis=1).astype(np.float32)


def test_range_image_separates_an_object_from_the_one_behind():
    xyz = np.concatenate([make_panel(10, 0), make_panel(14, 1.43), make_panel(10, 4), make_panel(-10, 0)])
    ids = cluster_range_image(xyz)
    sizes = [len(make_panel(10, 0))] * 4
    groups = np.split(ids, np.cumsum(sizes)[:-1])
    labels = [np.bincount(group).argmax() for group in groups]
    assert len(set(labels)) == 4 and 0 not in labels
    assert all((group == label).mean() > 0.9 for group, label in zip(groups, labels))
    assert (ids[xyz[:, 0] > 0][:3] > 0).all() and ids.dtype == np.int32


def test_range_image_clusters_span_the_180_degree_border():
    behind = make_panel(-10, -0.5)  # where the azimuth jumps from 180 to -180 degrees
    assert len(np.unique(cluster_range_image(behind))) == 1
    assert (cluster_range_image(make_panel(10, 0)[:5]) == 0).all()
    assert cluster_range_image(np.zeros((0, 3), np.float32)).shape == (0,)


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    return open_recording(write_crowd_folder(tmp_path_factory.mktemp("kitti"), 3)).frames


def test_report_is_complete_with_and_without_records(frames):
    records = [SEGMENTATION.measure(frames, i) for i in range(2)]
    for record in records:
        for counts in (*record["methods"].values(), *record["sweeps"].values()):
            count_by_name = dict(zip(COUNT_COLUMNS, counts, strict=True))
            limit = min(count_by_name["found object points"], count_by_name["object points"])
            assert count_by_name["right object points"] <= limit <= count_by_name["points"]
    for some in ([], [{"frame": "x", "skipped": "why"}], records):
        sections = SEGMENTATION.make_sections(some)
        tables = [table for section in sections for table in section.tables]
        assert {"table_2", "table_3", "table_3_objects"} <= {table.name for table in tables}
        for table in tables:
            assert all(len(row) == len(table.header) for row in table.rows), table.name


def test_frame_without_objects_is_skipped_with_a_reason(frames):
    with pytest.raises(InputError, match="no labels"):
        SEGMENTATION.measure([type(frames[0]).of("x", frames[0].load())], 0)


def test_paired_p_value_is_small_for_consistent_difference():
    rng = np.random.default_rng(0)
    base = rng.integers(0, 50, (30, 1))

    def rate(sums):
        return sums / 100

    equal = np.stack([base, rng.permutation(base)], axis=1)
    better = np.stack([base + 5, base], axis=1)
    assert compute_paired_p(equal, rate)[0] > 0.1 and compute_paired_p(better, rate)[0] < 0.01
    assert compute_paired_p(np.stack([base, base], axis=1), rate)[0] == 1.0
    assert np.isnan(compute_paired_p(np.zeros((0, 2, 1)), rate)).all()
