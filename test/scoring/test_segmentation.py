"""Scores of ground and clusters: invariants and hand-computed cases."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidar_perception.data.frame import Frame, PointTruth
from lidar_perception.data.semantickitti import MOVING, THINGS
from lidar_perception.scoring.points.report import SegmentationParams, measure_methods
from lidar_perception.scoring.points.segmentation import (
    PROTOCOLS,
    RANGE_NAMES,
    ClusterReport,
    GroundReport,
    Objects,
    count_by_protocol,
    count_ground,
    find_instances,
    find_objects_in_boxes,
    score_clusters,
    select_true_ground,
)
from lidar_perception.scoring.points.tables import PUBLISHED
from lidar_perception.types import CLASSES, SENSOR_HEIGHT, GroundTruth, PointCloud

seeds = st.integers(0, 2**32 - 1)
CAR, VAN, TRUCK = (CLASSES.index(name) for name in ("Car", "Van", "Truck"))


def make_objects(owner, region=None, near=None, counted=None, ranges=None):
    """Return objects a, b, c, ... with the given owner of each point."""
    owner = np.asarray(owner, np.int32)
    region = owner if region is None else np.asarray(region, np.int32)
    count = int(owner.max(initial=0))
    return Objects(
        owner,
        region,
        region > 0 if near is None else np.asarray(near, bool),
        np.ones(len(owner), bool) if counted is None else np.asarray(counted, bool),
        tuple("abcdefghij"[:count]),
        np.full(count, 10.0) if ranges is None else ranges,
    )


def compute_report(cluster_ids, truth) -> dict:
    report = ClusterReport()
    score = score_clusters(np.asarray(cluster_ids, np.int32), truth)
    report.update(truth.classes, truth.ranges, score, 2.0)
    return report.compute()


def draw_frame(seed):
    """Return labels and objects of a random frame, with all kinds of overlap."""
    rng = np.random.default_rng(seed)
    owner = rng.integers(0, rng.integers(1, 6), 300).astype(np.int32)
    owner = np.unique(owner, return_inverse=True)[1].reshape(-1)
    region = np.where(owner == 0, rng.integers(0, owner.max() + 1, 300) * (rng.random(300) < 0.1), owner)
    found = np.where(rng.random(300) < 0.7, owner, rng.integers(0, 9, 300)).astype(np.int32)
    return found, make_objects(owner, region, counted=rng.random(300) < 0.9)


def test_perfect_clusters_have_perfect_scores():
    owner = np.repeat([0, 1, 2, 3], [40, 10, 20, 30])
    content = compute_report(owner, make_objects(owner, ranges=np.array([10.0, 20.0, 50.0])))
    assert [content[k] for k in ("precision", "f1")] == [1, 1]
    ranges = [content["by_range"][RANGE_NAMES[i]] for i in (0, 1, 3)]
    for row in [content, *content["by_class"].values(), *ranges]:
        assert (row["recall"], row["mean_iou"], row["mean_pieces"]) == (1, 1, 1)
        assert (row["over_segmentation"], row["under_segmentation"]) == (0, 0)


def test_two_objects_in_one_cluster_are_both_under_segmented():
    owner = np.repeat([1, 2, 3, 0], [30, 60, 50, 5])
    content = compute_report(np.repeat([4, 4, 7, 0], [30, 60, 50, 5]), make_objects(owner))
    assert (content["under_segmented"], content["over_segmented"]) == (2, 0)
    # IoU of 30 / 90, 60 / 90, and 1.
    assert content["mean_iou"] == pytest.approx((1 / 3 + 2 / 3 + 1) / 3)
    assert (content["objects"], content["hits"], content["judged_clusters"]) == (3, 2, 2)
    assert content["under_segmentation"] == pytest.approx(2 / 3)


def test_split_and_merged_objects_are_not_hits():
    halves = compute_report(np.repeat([1, 2], 20), make_objects(np.ones(40)))
    assert (halves["over_segmented"], halves["mean_pieces"], halves["under_segmented"]) == (1, 2, 0)
    both = compute_report(np.ones(40), make_objects(np.repeat([1, 2], 20)))
    assert (both["over_segmented"], both["mean_pieces"], both["under_segmented"]) == (0, 1, 2)
    for content in (halves, both):
        assert (content["mean_iou"], content["hits"], content["f1"]) == (0.5, 0, 0)


def test_fragment_counts_from_a_tenth_of_the_object():
    for small, pieces in ((9, 1), (10, 2)):
        score = score_clusters(np.repeat([3, 1], [100 - small, small]), make_objects(np.ones(100)))
        assert score.pieces.tolist() == [pieces]


def test_scores_equal_hand_computed_values():
    # Cluster 1 has 8 of 10 points of object a and 2 others; object b has no cluster. Half of cluster 2 is near
    # an object, so it is not scored; cluster 3 is far from all; cluster 4 is scored and no hit.
    owner = np.repeat([1, 1, 2, 0, 0, 0, 0], [8, 2, 10, 2, 4, 6, 3])
    found = np.repeat([1, 0, 0, 1, 2, 3, 4], [8, 2, 10, 2, 4, 6, 3])
    near = np.repeat([1, 1, 1, 0, 0, 0, 1], [8, 2, 10, 2, 4, 6, 3])
    near[22:24] = 1
    content = compute_report(found, make_objects(owner, near=near, ranges=np.array([14.9, 45.0])))
    assert (content["clusters"], content["judged_clusters"]) == (4, 2)
    assert (content["objects"], content["hits"]) == (2, 1)
    assert content["mean_iou"] == pytest.approx(8 / 12 / 2)
    assert (content["precision"], content["recall"], content["f1"]) == (0.5, 0.5, 0.5)
    assert content["mean_pieces"] == 1  # object a; object b has no pieces
    assert content["by_class"]["b"]["mean_pieces"] is None
    assert content["by_class"]["a"]["mean_iou"] == pytest.approx(2 / 3)
    assert [row["objects"] for row in content["by_range"].values()] == [1, 0, 0, 1]
    assert (content["frames"], content["ms"], content["clusters_per_frame"]) == (1, 2.0, 4.0)


def test_neutral_points_count_for_other_objects():
    owner, region = np.repeat([1, 0, 2], [10, 10, 10]), np.repeat([1, 1, 2], [10, 10, 10])
    clean = score_clusters(np.repeat([1, 0, 2], [10, 10, 10]), make_objects(owner, region))
    with_road = score_clusters(np.repeat([1, 1, 2], [10, 10, 10]), make_objects(owner, region))
    assert clean.iou.tolist() == with_road.iou.tolist() == [1, 1]
    other = score_clusters(np.repeat([1, 2, 2], [10, 10, 10]), make_objects(owner, region))
    assert other.iou.tolist() == [1, 0.5]


@pytest.mark.parametrize("counted", [0, 10, 20])
def test_clusters_of_ignored_points_are_not_scored(counted):
    """Most points of a frame can be unlabelled."""
    truth = make_objects(np.repeat([1, 0, 2], 10), near=np.ones(30), counted=np.arange(30) < counted)
    assert score_clusters(np.repeat([1, 2, 3], 10), truth).scored_count == counted / 10


@given(seeds)
def test_order_of_points_and_cluster_ids_do_not_matter(seed):
    found, truth = draw_frame(seed)
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(found))
    large = rng.permutation(np.unique(rng.integers(1, 2**31, 40)))[:10]  # lookup tables would take gigabytes
    renamed = np.concatenate([[0], large])[found]
    shuffled = replace(
        truth, **{name: getattr(truth, name)[order] for name in ("owner", "region", "is_near", "is_counted")}
    )
    assert compute_report(renamed[order], shuffled) == compute_report(found, truth)


@given(seeds)
def test_scores_equal_a_plain_loop_over_sets(seed):
    found, truth = draw_frame(seed)
    score = score_clusters(found, truth)
    keep = truth.is_counted
    sets = {c: set(np.flatnonzero(keep & (found == c))) for c in set(found.tolist()) - {0}}
    own = [set(np.flatnonzero(keep & (truth.owner == k + 1))) for k in range(len(truth.classes))]
    pieces = [{c for c, s in sets.items() if s & o and 10 * len(s & o) >= len(o)} for o in own]
    for k, o in enumerate(own):
        neutral = set(np.flatnonzero(keep & (truth.region == k + 1))) - o
        ious = {c: len(s & o) / len(o | (s - neutral)) for c, s in sets.items()}
        best = {c for c, v in ious.items() if v == max(ious.values())}
        assert score.iou[k] == max(ious.values(), default=0)
        assert score.pieces[k] == len(pieces[k])
        assert score.is_shared[k] == any(
            c in pieces[k] and any(c in p for j, p in enumerate(pieces) if j != k) for c in best
        )
    near = set(np.flatnonzero(truth.is_near))
    assert score.scored_count == sum(2 * len(s & near) > len(s) for s in sets.values())
    assert score.scored_count >= np.sum(score.iou > 0.5)  # so that ratios are at most 1


def test_scores_are_defined_without_clusters_or_objects():
    nothing = compute_report(np.zeros(20), make_objects(np.ones(20)))
    assert (nothing["recall"], nothing["precision"], nothing["mean_iou"]) == (0, 0, 0)
    for found in (np.zeros(20), np.ones(20), np.zeros(0)):
        empty = compute_report(found, make_objects(np.zeros(len(found))))
        assert (empty["objects"], empty["judged_clusters"], empty["by_class"]) == (0, 0, {})


def make_column(x, y, z, count):
    """Return `count` points at x, y and heights z[0] .. z[1]."""
    return np.column_stack([np.full(count, x), np.full(count, y), np.linspace(*z, count)])


def test_low_points_are_neutral_and_small_objects_ignored():
    xyz = np.concatenate(
        [
            make_column(10, 0, (-1.65, -1.55), 5),
            make_column(10, 0, (-1.45, 0), 12),
            make_column(20, 0, (-1.4, 0), 9),
            make_column(10, 1.1, (-1, 0), 3),
            make_column(30, 0, (-1, 0), 4),
        ]
    ).astype(np.float32)
    truth = GroundTruth.of([[20, 0, -0.7, 2, 2, 2, 0], [10, 0, -0.7, 2, 2, 2, 0.0]], [CAR, VAN])
    found = find_objects_in_boxes(xyz, truth)
    assert found.owner.tolist() == [0] * 5 + [1] * 12 + [0] * 16
    assert found.region.tolist() == [1] * 17 + [0] * 16
    assert found.is_near.tolist() == [True] * 17 + [False] * 9 + [True] * 3 + [False] * 4
    assert found.is_counted.all() and found.classes == ("Van",) and found.ranges.tolist() == [10]


def test_point_in_two_boxes_belongs_to_the_smaller_one():
    xyz = np.concatenate([make_column(10, 0, (-1, 0), 20), make_column(12, 0, (-1, 0), 30)])
    boxes = [[10, 0, 0, 1, 1, 4, 0], [11, 0, 0, 5, 3, 4, 0]]
    for order in ([0, 1], [1, 0]):
        truth = GroundTruth.of(np.array(boxes)[order], np.array([CAR, TRUCK])[order])
        found = find_objects_in_boxes(xyz.astype(np.float32), truth)
        classes = np.array(["", *found.classes])[found.owner]
        assert classes.tolist() == ["Car"] * 20 + ["Truck"] * 30


def test_dont_care_and_no_boxes_are_no_objects():
    xyz = make_column(10, 0, (-1, 0), 20).astype(np.float32)
    for truth in (GroundTruth.of([[10, 0, 0, 2, 2, 4, 0]], [CLASSES.index("DontCare")]), GroundTruth.of([], [])):
        found = find_objects_in_boxes(xyz, truth)
        assert found.classes == () and not found.owner.any() and not found.is_near.any()


def test_instances_include_moving_points():
    kinds = [
        (10, 5, 12),
        (252, 6, 10),
        (30, 5, 11),
        (10, 0, 20),
        (11, 1, 9),
        (50, 5, 30),
        (0, 5, 4),
        (1, 0, 4),
        (40, 0, 10),
    ]
    counts = [count for _, _, count in kinds]
    semantic, instance = (np.repeat([kind[i] for kind in kinds], counts).astype(np.uint16) for i in (0, 1))
    xyz = np.zeros((len(semantic), 3), np.float32)
    xyz[:12] = [30, 40, 1]
    found = find_instances(xyz, semantic, instance)
    assert found.classes == ("car", "car", "person")
    assert found.owner.tolist() == np.repeat([1, 2, 3, 0, 0, 0, 0, 0, 0], counts).tolist()
    # Not counted: a car without an instance, a bicycle of 9 points, unlabelled, outliers.
    assert found.is_counted.tolist() == np.repeat([1, 1, 1, 0, 0, 1, 0, 0, 1], counts).tolist()
    assert found.ranges.tolist() == [50, 0, 0]
    assert set(MOVING) == set(range(252, 260)) and set(MOVING.values()) <= set(THINGS)


def test_scores_of_each_protocol_equal_hand_computed_values():
    semantic = np.array([40, 44, 48, 49, 60, 72, 70, 70, 70, 0, 1, 10, 50], np.uint16)
    z = np.full(len(semantic), -1.7)
    z[7:9] = [-1.3, -1.2]  # points at the limit are not low
    expected = (
        [1] * 6 + [None] * 5 + [0, 0],
        [1] * 7 + [0, 0, None, None, 0, 0],
        [1] * 6 + [0, 0, 0, None, None, 0, 0],
    )
    for name, row in zip(PROTOCOLS, expected, strict=True):
        ground, counted = select_true_ground(semantic, z, name)
        assert [int(g) if c else None for g, c in zip(ground, counted)] == row, name
    assert set(PUBLISHED) <= set(PROTOCOLS)


@pytest.mark.parametrize("height", [0.7, SENSOR_HEIGHT, 3.0])
def test_low_vegetation_is_measured_from_the_road(height):
    xyz = np.random.default_rng(0).uniform(-9, 9, (450, 3)).astype(np.float32)
    xyz[:, 2] = np.repeat([0.0, 0.4, 0.5], [400, 30, 20]) - height
    truth = PointTruth(np.repeat([40, 70], [400, 50]).astype(np.uint16), np.zeros(450, np.uint16))
    frame = replace(Frame.of("a", PointCloud(xyz), sensor_height=height), point_truth=lambda: truth)
    result = measure_methods(SegmentationParams(), ("cloth",), (), None)(frame)
    tp, fp, fn, tn = result.ground["cloth"][0]["with vegetation"]
    assert (tp + fn, fp + tn) == (430, 20)


def test_ground_scores_equal_hand_computed_values():
    found = np.array([1, 1, 1, 0, 0, 0, 0, 1, 0], bool)
    ground = np.array([1, 1, 0, 1, 0, 0, 0, 1, 0], bool)
    counted = np.array([1, 1, 1, 1, 1, 1, 1, 0, 0], bool)
    assert count_ground(found, ground, counted).tolist() == [2, 1, 1, 3]
    report = GroundReport()
    for _ in range(2):
        report.update(count_by_protocol(found[:7], np.where(ground[:7], 40, 50), np.zeros(7)), 3.0)
    row = report.compute()["protocols"]["without vegetation"]
    assert [row[k] for k in ("tp", "fp", "fn", "tn")] == [4, 2, 2, 6]
    assert [row[k] for k in ("precision", "recall", "f1", "accuracy")] == pytest.approx([2 / 3, 2 / 3, 2 / 3, 5 / 7])
    assert report.compute()["scans"] == 2 and report.compute()["ms"] == 3.0
