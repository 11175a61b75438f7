"""Overlap of rotated boxes, compared with shapely."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidar_perception.geometry import bev_and_3d_iou, bev_iou, box_corners, iou_3d

seeds = st.integers(0, 2**32 - 1)
QUARTER = np.pi / 2


def draw_boxes(rng, count, reach=3.0):
    """Make boxes close to each other, some of which touch or are rotated by quarter turns."""
    boxes = np.column_stack(
        [
            rng.uniform(-reach, reach, (count, 2)),
            rng.uniform(-1, 1, count),
            rng.uniform(0.3, 5, (count, 3)),
            rng.uniform(-7, 7, count),
        ]
    )
    tidy = rng.random(count) < 0.3
    boxes[tidy] = np.round(boxes[tidy])
    boxes[tidy, 6] = rng.integers(-4, 5, tidy.sum()) * QUARTER
    boxes[rng.random(count) < 0.1, rng.integers(3, 6)] = 0
    return boxes


def move_boxes(boxes, shift, yaw):
    cos, sin = np.cos(yaw), np.sin(yaw)
    x, y = boxes[:, 0], boxes[:, 1]
    return np.column_stack(
        [
            cos * x - sin * y + shift[0],
            sin * x + cos * y + shift[1],
            boxes[:, 2] + shift[2],
            boxes[:, 3:6],
            boxes[:, 6] + yaw,
        ]
    )


def compute_by_shapely(boxes, others):
    shapely = pytest.importorskip("shapely", reason="needs shapely, of the extra [test]")
    a, b = (shapely.polygons(box_corners(x)[:, :4, :2]) for x in (boxes, others))
    # Use a fine grid, because GEOS sometimes misses the overlap of almost coincident edges.
    shared = shapely.area(shapely.intersection(a[:, None], b[None], grid_size=1e-9))
    area = shapely.area(a)[:, None] + shapely.area(b)
    (low_a, high_a), (low_b, high_b) = ((x[:, 2] - x[:, 5] / 2, x[:, 2] + x[:, 5] / 2) for x in (boxes, others))
    height = np.maximum(np.minimum(high_a[:, None], high_b) - np.maximum(low_a[:, None], low_b), 0)
    volume = np.prod(boxes[:, 3:6], axis=1)[:, None] + np.prod(others[:, 3:6], axis=1)
    with np.errstate(invalid="ignore"):
        return (np.nan_to_num(shared / (area - shared)), np.nan_to_num(shared * height / (volume - shared * height)))


@given(seeds)
def test_overlaps_equal_shapely(seed):
    rng = np.random.default_rng(seed)
    boxes, others = draw_boxes(rng, 12), draw_boxes(rng, 12)
    others[:4] = boxes[:4]  # identical
    others[4] = boxes[4] + [0, 0, 0, 0, 0, 0, QUARTER]
    others[5] = boxes[5] * [1, 1, 1, 0.4, 0.4, 0.4, 1]  # contained
    others[6:8] = move_boxes(boxes[6:8] * [0, 0, 0, 1, 1, 1, 0], (boxes[6, 3], 0, 0), 0)  # touching
    for found, expected in zip(bev_and_3d_iou(boxes, others), compute_by_shapely(boxes, others)):
        np.testing.assert_allclose(found, expected, atol=1e-6)


@pytest.mark.parametrize(
    "name, box, other, bev, space",
    [
        # a = 4 x 2 x 2 around the origin: area 8, volume 16
        ("itself", [0, 0, 0, 4, 2, 2, 0.7], [0, 0, 0, 4, 2, 2, 0.7], 1, 1),
        # overlap 2 x 2: 4 / (8 + 8 - 4)
        ("a quarter turn", [0, 0, 0, 4, 2, 2, 0], [0, 0, 0, 4, 2, 2, QUARTER], 1 / 3, 1 / 3),
        ("sides touch", [0, 0, 0, 4, 2, 2, 0], [4, 0, 0, 4, 2, 2, 0], 0, 0),
        ("corners touch", [0, 0, 0, 4, 2, 2, 0], [4, 2, 0, 4, 2, 2, 0], 0, 0),
        ("one on top of the other", [0, 0, 0, 4, 2, 2, 0], [0, 0, 2, 4, 2, 2, 0], 1, 0),
        # inside: 1 / 8; 1 / 16
        ("contained", [0, 0, 0, 4, 2, 2, 0], [0.5, 0.2, 0.1, 1, 1, 1, 0], 1 / 8, 1 / 16),
        # half of the length: 4 / 12; also half of the height: 4 / 28
        ("moved by half", [0, 0, 0, 4, 2, 2, 0], [2, 0, 1, 4, 2, 2, 0], 1 / 3, 1 / 7),
        # square of side 2 rotated by 45 degrees: octagon of area 8 (sqrt 2 - 1) = 3.3137, union 8 - 3.3137
        ("an octagon", [5, 5, 0, 2, 2, 1, 0], [5, 5, 0, 2, 2, 1, np.pi / 4], 2**-0.5, 2**-0.5),
        ("no length", [0, 0, 0, 0, 2, 2, 0], [0, 0, 0, 0, 2, 2, 0], 0, 0),
        ("no height", [0, 0, 0, 4, 2, 0, 0], [0, 0, 0, 4, 2, 0, 0], 1, 0),
        ("less than nothing", [0, 0, 0, -4, -2, 2, 0], [0, 0, 0, 4, 2, 2, 0], 0, 0),
        ("not a number", [0, 0, np.nan, 4, 2, 2, 0], [0, 0, 0, 4, 2, 2, 0], 0, 0),
        ("endless", [0, 0, 0, np.inf, 2, 2, 0], [0, 0, 0, 4, 2, 2, 0], 0, 0),
        ("far away", [1e6, 0, 0, 4, 2, 2, 0], [0, 0, 0, 4, 2, 2, 0], 0, 0),
    ],
)
def test_overlaps_equal_hand_computed_values(name, box, other, bev, space):
    for a, b in ((box, other), (other, box)):
        found = bev_and_3d_iou(np.array([a], float), np.array([b], float))
        assert (found[0].item(), found[1].item()) == pytest.approx((bev, space), abs=1e-12)


def test_any_shape_dtype_and_layout_is_accepted():
    boxes = draw_boxes(np.random.default_rng(0), 6)
    for rows, columns in ((0, 6), (6, 0), (0, 0), (2, 6)):
        for matrix in bev_and_3d_iou(boxes[:rows], boxes[:columns]):
            assert matrix.shape == (rows, columns) and matrix.dtype == np.float64
    before = boxes.copy()
    np.testing.assert_array_equal(bev_iou(np.asfortranarray(boxes), boxes), bev_iou(boxes, boxes))
    np.testing.assert_allclose(iou_3d(boxes.astype(np.float32), boxes), iou_3d(boxes, boxes), atol=1e-5)
    np.testing.assert_array_equal(boxes, before)
