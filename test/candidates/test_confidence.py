"""Metric silhouettes, confidence and automatic seeds, which the configuration `best` adds."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from candidate_samples import from_pixels
from hypothesis import given
from hypothesis import strategies as st
from samples import DATA, needs_data

from lidar_perception.candidates.confidence import (
    SEED_KNOTS,
    SHAPE_KNOTS,
    _load_models,
    compute_confidence,
    compute_shape_features,
)
from lidar_perception.candidates.configurations import BEST, PAPER
from lidar_perception.candidates.params import PipelineParams, StmParams
from lidar_perception.candidates.pipeline import refine_segmented, segment_cloud
from lidar_perception.candidates.refine import refine_clusters
from lidar_perception.candidates.seed_sources import make_fixed_source, make_truth_source
from lidar_perception.candidates.seeds import find_seed_cluster, seed_from_points
from lidar_perception.candidates.silhouette import (
    COLUMNS,
    ROWS,
    WINDOW_HEIGHT_M,
    WINDOW_WIDTH_M,
    compute_similarity,
    draw_silhouettes,
    to_pixels,
)
from lidar_perception.data.open import open_recording
from lidar_perception.param_fields import with_values
from lidar_perception.types import PEDESTRIAN, PointCloud

seeds = st.integers(0, 2**32 - 1)
METRIC = with_values(PipelineParams(), {"stm.window": "metric", "stm.spread": True, "stm.dilations": 0})
FLOOR = -1.7
STEP = np.radians([METRIC.resolution.azimuth_step, METRIC.resolution.elevation_step])


def make_board(distance, width=0.5, height=1.7, bearing=0.0, offset=0.3):
    """Return points of an upright board at a distance, as dense as silhouettes in metres need."""
    step = distance * STEP
    y = np.arange(-width / 2, width / 2, step[0])[:, None] + offset * step[0]
    z = FLOOR + np.arange(0, height, step[1])[None] + offset * step[1]
    y, z = (a.ravel() for a in np.broadcast_arrays(y, z))
    keep = (np.abs(y) <= width / 2) & (z <= FLOOR + height)
    cos, sin = np.cos(bearing), np.sin(bearing)
    xyz = np.stack([distance * cos - y * sin, distance * sin + y * cos, z], 1)
    return xyz[keep].astype(np.float32)


def draw_silhouette(xyz, params=METRIC, floor=FLOOR):
    return draw_silhouettes(xyz, np.array([0, len(xyz)]), np.ones((1, 1)), np.array([floor]), params)[0]


def make_box(distance, width=0.5, height=1.7):
    return np.array([[distance, 0, FLOOR + height / 2, 0.3, width, height, 0]], np.float32)


# --- metric silhouettes --------------------------------------------------------------------


@pytest.mark.parametrize("distance", [6.0, 15.0, 30.0])
@pytest.mark.parametrize("width, height", [(0.5, 1.7), (0.9, 1.2), (1.2, 2.2)])
def test_size_of_a_board_does_not_depend_on_range(distance, width, height):
    pixels = to_pixels(draw_silhouette(make_board(distance, width, height)))
    rows, columns = np.flatnonzero(pixels.any(axis=1)), np.flatnonzero(pixels.any(axis=0))
    cell = distance * STEP
    assert np.ptp(columns) + 1 == pytest.approx(width / WINDOW_WIDTH_M * COLUMNS, abs=2 + cell[0] * 20)
    assert np.ptp(rows) + 1 == pytest.approx(height / WINDOW_HEIGHT_M * ROWS, abs=2 + cell[1] / WINDOW_HEIGHT_M * ROWS)
    assert pixels[np.ix_(rows, columns)].mean() > 0.99  # no gaps


def test_spreading_points_makes_silhouettes_independent_of_range():
    near_board, far_board = make_board(7.0), make_board(26.0)
    params = PipelineParams()
    assert compute_similarity(draw_silhouette(far_board, params)[None], draw_silhouette(near_board, params))[0] < 0.75
    assert compute_similarity(draw_silhouette(far_board)[None], draw_silhouette(near_board))[0] > 0.9


@given(seeds)
def test_metric_silhouette_is_relative_to_the_ground(seed):
    rng = np.random.default_rng(seed)
    xyz = make_board(rng.uniform(5, 30), bearing=0.0) + rng.normal(0, 0.02, (1, 3)).astype(np.float32)
    shift = np.float32(rng.integers(-8, 8) / 4)  # exact in float32
    shifted_points = xyz + np.float32([0, 0, shift])
    similarity = compute_similarity(
        draw_silhouette(shifted_points, floor=FLOOR + float(shift))[None], draw_silhouette(xyz)
    )[0]
    assert similarity > 0.97


def test_points_outside_the_window_are_not_drawn():
    low_board, tall_board = make_board(10.0), make_board(10.0, height=4.0)
    assert to_pixels(draw_silhouette(tall_board))[0].any()
    high_points = tall_board[tall_board[:, 2] > FLOOR + WINDOW_HEIGHT_M + 0.2]
    assert not draw_silhouette(high_points).any()
    image = draw_silhouette(np.concatenate([low_board, low_board + np.float32([0, 0, 3.0])]))
    np.testing.assert_array_equal(image, draw_silhouette(low_board))


@given(seeds, st.integers(0, 6))
def test_shifts_return_the_best_score_of_the_shifted_images(seed, shifts):
    rng = np.random.default_rng(seed)
    pixels, template = (rng.random((ROWS, COLUMNS)) < 0.2 for _ in range(2))
    expected = 0.0
    for columns in range(-shifts, shifts + 1):
        shifted = np.zeros_like(pixels)
        if columns >= 0:
            shifted[:, columns:] = pixels[:, : COLUMNS - columns]
        else:
            shifted[:, :columns] = pixels[:, -columns:]
        expected = max(expected, (shifted & template).sum() / np.sqrt(pixels.sum() * template.sum()))
    similarity = compute_similarity(from_pixels(pixels)[None], from_pixels(template), StmParams(shifts=shifts))
    assert similarity[0] == pytest.approx(expected, abs=1e-12)


def test_seen_only_compares_visible_parts_of_silhouettes():
    person = make_board(12.0, width=0.4)
    is_leg = person[:, 2] < FLOOR + 0.8
    upper_body = person[~is_leg]
    seen_only_params = with_values(METRIC, {"stm.seen_only": True})
    similarities = [
        compute_similarity(draw_silhouette(upper_body)[None], draw_silhouette(person), params.stm)[0]
        for params in (METRIC, seen_only_params)
    ]
    assert similarities[0] < 0.85 and similarities[1] > 0.99
    reverse_similarity = compute_similarity(
        draw_silhouette(person)[None], draw_silhouette(upper_body), seen_only_params.stm
    )[0]
    assert reverse_similarity == pytest.approx(similarities[1], abs=1e-12)  # symmetric in the hidden image


def test_only_the_pca_axis_corrects_a_tilt():
    rng = np.random.default_rng(0)
    upright_points = rng.normal(size=(600, 3)) * [0.05, 0.2, 0.6] + [10, 0, 0]
    angle = 0.5
    rotation = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
    tilted_points = (upright_points - [10, 0, 0]) @ rotation.T + [10, 0, 0]
    images = {
        axis: [
            draw_silhouette(xyz.astype(np.float32), with_values(PipelineParams(), {"stm.axis": axis}))
            for xyz in (upright_points, tilted_points)
        ]
        for axis in ("yaw", "pca")
    }
    similarity = {axis: compute_similarity(a[None], b)[0] for axis, (a, b) in images.items()}
    assert similarity["pca"] > 0.97 > 0.9 > similarity["yaw"]


def test_every_dilation_adds_pixels():
    xyz = make_board(15.0)
    images = [to_pixels(draw_silhouette(xyz, with_values(PipelineParams(), {"stm.dilations": n}))) for n in range(4)]
    for small, large in pairwise(images):
        assert (large[small]).all() and large.sum() >= small.sum()


# --- confidence ----------------------------------------------------------------------------


def compute_features(clusters, boxes):
    start = np.cumsum([0] + [len(c) for c in clusters])
    return compute_shape_features(np.concatenate(clusters), start, np.concatenate(boxes), BEST)


def test_features_of_a_board_are_its_dimensions():
    shape = {k: v[0] for k, v in compute_features([make_board(12.0, 0.6, 1.7)], [make_box(12.0, 0.6)]).items()}
    assert set(shape) == set(SHAPE_KNOTS)
    assert shape["range_m"] == pytest.approx(12.0, abs=0.05)
    assert shape["height_m"] == pytest.approx(1.7, abs=12 * STEP[1])
    assert shape["length_m"] == pytest.approx(0.6, abs=0.08) and shape["width_m"] < 0.05
    assert shape["area_m2"] == pytest.approx(0.6 * 1.7, rel=0.1)
    assert shape["fill"] == pytest.approx(1.15, abs=0.2) and shape["lopsided"] < 0.05
    assert shape["hidden_below_m"] == pytest.approx(0.0, abs=12 * STEP[1])


@given(seeds)
def test_features_do_not_depend_on_other_clusters(seed):
    rng = np.random.default_rng(seed)
    distances = rng.uniform(5, 40, 4)
    clusters = [make_board(d, rng.uniform(0.3, 2), rng.uniform(0.5, 2.5)) for d in distances]
    boxes = [make_box(d) for d in distances]
    features = compute_features(clusters, boxes)
    order = rng.permutation(4)
    permuted_features = compute_features([clusters[i] for i in order], [boxes[i] for i in order])
    for name, values in features.items():
        np.testing.assert_array_equal(permuted_features[name], values[order])
    for seed_features in ((), (rng.random(4), rng.normal(0, 0.3, 4))):
        confidence = compute_confidence(features, *seed_features)
        assert confidence.shape == (4,) and ((confidence > 0) & (confidence < 1)).all()


def test_features_of_no_clusters_are_empty():
    features = compute_shape_features(np.zeros((0, 3), np.float32), np.array([0]), np.zeros((0, 7)), BEST)
    assert all(v.shape == (0,) for v in features.values()) and compute_confidence(features).shape == (0,)


def test_single_point_has_finite_features():
    shape = compute_features([np.float32([[9, 0, -1]])], [make_box(9.0)])
    assert all(np.isfinite(v).all() for v in shape.values()) and np.isfinite(compute_confidence(shape))[0]


def test_all_curves_exist_and_similarity_increases_confidence():
    models = _load_models()
    assert set(models["shape"]["curves"]) == set(SHAPE_KNOTS)
    assert set(models["seed"]["curves"]) == set(SHAPE_KNOTS) | set(SEED_KNOTS)
    for model in (models["shape"], models["seed"]):
        for name, curve in model["curves"].items():
            assert tuple(curve["knots"]) == ({**SHAPE_KNOTS, **SEED_KNOTS})[name]
            assert len(curve["values"]) == len(curve["knots"])
    values = models["seed"]["curves"]["similarity"]["values"]
    assert values == sorted(values) and values[-1] > values[0]


def make_two_people():
    """Return points of two similar people, the first row of each, and their boxes."""
    xyz = np.concatenate([make_board(9.0), make_board(9.0, offset=0.7) + np.float32([0, 3, 0])])
    first = len(make_board(9.0))
    return xyz, np.array([0, first, len(xyz)]), np.concatenate([make_box(9.0), make_box(9.0)])


def test_seed_cluster_contains_points_of_the_seed():
    xyz, start, boxes = make_two_people()
    seed = seed_from_points(xyz[: start[1]], boxes[0])
    assert find_seed_cluster(seed, xyz, start).tolist() == [True, False]
    partial_seed = seed_from_points(xyz[: int(0.6 * start[1])], boxes[0])
    assert find_seed_cluster(partial_seed, xyz, start).tolist() == [True, False]
    shifted_seed = seed_from_points(xyz[: start[1]] + np.float32(1e-3), boxes[0])
    assert not find_seed_cluster(shifted_seed, xyz, start).any()
    assert find_seed_cluster(seed, np.zeros((0, 3), np.float32), np.array([0])).shape == (0,)


@pytest.mark.parametrize("confidence", [1.0, 0.7, None])
def test_cluster_of_the_seed_has_the_confidence_of_the_seed(confidence):
    xyz, start, boxes = make_two_people()
    boxes[1, 1] += 3.0
    ids = np.repeat(np.int32([1, 2]), np.diff(start))
    params = with_values(BEST, {"confidence.threshold": 0.0})
    seed = seed_from_points(xyz[: start[1]], boxes[0], confidence)
    scores = refine_clusters(xyz, ids, boxes, [seed], params).final.scores
    shape = compute_confidence(compute_shape_features(xyz, start, boxes, BEST))
    assert scores[0] == pytest.approx(shape[0] if confidence is None else confidence, abs=1e-6)
    assert scores[1] == pytest.approx(
        refine_clusters(
            xyz, ids, boxes, [seed_from_points(xyz[: start[1]] + np.float32([0, 0.5, 0]), boxes[0])], params
        ).final.scores[1],
        abs=0.05,
    )


# --- the configuration ---------------------------------------------------------------------


def test_best_configuration_accepts_clusters_by_confidence():
    people = [make_board(8.0), make_board(16.0), make_board(11.0, width=1.8)]
    xyz = np.concatenate([p + np.float32([0, 6 * i - 6, 0]) for i, p in enumerate(people)])
    rng = np.random.default_rng(0)
    flat = np.column_stack([rng.uniform(2, 30, 6000), rng.uniform(-20, 20, 6000), np.full(6000, FLOOR)]).astype(
        np.float32
    )
    params = with_values(BEST, {"view.enabled": False, "confidence.threshold": 0.0})
    s = segment_cloud(PointCloud(np.concatenate([xyz, flat])), params=params)
    seed = seed_from_points(people[0] + np.float32([0, -6, 0]), make_box(8.0)[0] + np.float32([0, -6, 0, 0, 0, 0, 0]))
    all_ = refine_segmented(s, make_fixed_source(seed), params).final
    assert len(all_) >= 3
    limit = float(np.sort(all_.scores)[-2:].mean())
    some = refine_segmented(s, make_fixed_source(seed), with_values(params, {"confidence.threshold": limit})).final
    assert 0 < len(some) < len(all_)
    assert sorted(some.scores) == sorted(all_.scores[all_.scores >= np.float32(limit)])


@needs_data
def test_best_configuration_finds_more_real_pedestrians():
    hits = dict.fromkeys(("paper", "best"), 0)
    for frame in open_recording(DATA / "kitti_object"):
        truth = frame.truth().select_class(PEDESTRIAN)
        if len(truth) == 0:
            continue
        for name, params in (("paper", PAPER), ("best", BEST)):
            s = segment_cloud(frame.load(), frame.calibration().camera(), params)
            found = refine_segmented(s, make_truth_source(truth), params).final.boxes
            near = np.linalg.norm(found[:, None, :3] - truth[None, :, :3], axis=2) <= 1.0
            hits[name] += int(near.any(axis=0).sum())
    assert hits["best"] > hits["paper"] > 0
