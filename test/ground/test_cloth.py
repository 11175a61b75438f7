"""Properties of the cloth solver and of ground segmentation by cloth."""

from __future__ import annotations

import numpy as np
import pytest
from ground_samples import compute_f1, make_street
from hypothesis import given
from hypothesis import strategies as st
from samples import DATA, needs_data

from lidar_perception.data.open import open_recording
from lidar_perception.ground.cloth import lay_cloth, segment_by_cloth
from lidar_perception.ground.cloth_slopes import REACH_CELLS, STEP_M, UNOBSERVED, find_climbing_cells
from lidar_perception.ground.cloth_solver import settle_sheet
from lidar_perception.ground.params import ClothParams
from lidar_perception.scoring.points.segmentation import PROTOCOLS, count_ground, select_true_ground, to_ground_row

pytestmark = pytest.mark.no_cover  # covered by other tests


def make_obstacles(seed, rows=24, columns=40):
    """Return bumpy obstacles with unobserved cells between them."""
    rng = np.random.default_rng(seed)
    heights = rng.normal(0, 0.3, (rows, columns)).astype(np.float32)
    heights[rng.random((rows, columns)) > 0.6] = np.inf
    heights[rng.random((rows, columns)) < 0.05] += np.float32(3)
    heights[0, 0] = 0
    return heights


def compute_free_height(sheet, obstacle, lift):
    """Return the height that each cell would have without its obstacle."""
    wide = np.pad(sheet.astype(np.float64), 1, mode="edge")
    mean = (wide[:-2, 1:-1] + wide[2:, 1:-1] + wide[1:-1, :-2] + wide[1:-1, 2:]) / 4
    return mean + np.where(np.isfinite(obstacle), lift, 0)


def settle_slowly(obstacle, lift, steps=20_000):
    """Settle the cloth from below by projected Jacobi steps in float64."""
    sheet = np.full(obstacle.shape, obstacle.min(), np.float64)
    for _ in range(steps):
        sheet = np.minimum(compute_free_height(sheet, obstacle, lift), obstacle)
    return sheet


@given(st.integers(0, 2**31), st.floats(0.0001, 0.05), st.integers(1, 4))
def test_each_cell_rests_on_an_obstacle_or_hangs_free(seed, lift, levels):
    obstacle = make_obstacles(seed)
    sheet = settle_sheet(obstacle, lift, 1e-5, levels)
    free = compute_free_height(sheet, obstacle, lift)
    touches = sheet >= obstacle - 1e-6
    assert (sheet <= obstacle).all()
    np.testing.assert_allclose(sheet[~touches], free[~touches], atol=2e-4)
    assert (free[touches] >= sheet[touches] - 2e-4).all()


@pytest.mark.parametrize("seed, lift", [(0, 0.002), (1, 0.006), (2, 0.03)])
def test_multigrid_equals_slow_relaxation(seed, lift):
    obstacle = make_obstacles(seed, 16, 24)
    expected = settle_slowly(obstacle, lift)
    for levels in (1, 2, 3, 4):
        np.testing.assert_allclose(settle_sheet(obstacle, lift, 1e-6, levels), expected, atol=1e-3)


def make_climbing_road(seed=0):
    """Return a road that rises by 0.9 m between 18 and 40 m, with three cars, and its mask.

    The road is sampled in rings, and the cars hide the road under them.
    """
    rng = np.random.default_rng(seed)
    radius = 1.73 / np.tan(np.radians(np.arange(2, 24, 0.42)))
    angles = np.radians(np.arange(-60, 60, 0.17))
    reach, angle = (x.ravel() for x in np.meshgrid(radius, angles))
    x, y = reach * np.cos(angle), reach * np.sin(angle)
    cars = np.array([[15.0, 3], [26, -3], [34, 4]])
    outside = np.abs(np.stack([x, y], axis=1)[:, None] - cars) > [2.1, 0.9]
    is_visible = outside.any(axis=2).all(axis=1)

    def rise(x):
        return 0.45 * (1 - np.cos(np.clip((x - 18) / 22, 0, 1) * np.pi))

    road = np.column_stack([x, y, rise(x) - 1.73 + rng.normal(0, 0.01, len(x))])[is_visible]
    on_road = [rng.uniform(-1, 1, (300, 3)) * [2, 0.85, 0.55] + [*car, rise(car[0]) - 0.9] for car in cars]
    xyz = np.concatenate([road, *on_road])
    return xyz.astype(np.float32), np.arange(len(xyz)) < len(road)


def test_climbing_road_is_ground_and_cars_on_it_are_not():
    xyz, road = make_climbing_road()
    result = segment_by_cloth(xyz)
    assert result[road].mean() > 0.97 and result[~road].mean() < 0.1
    # The same holds where reflections far below the road pull the cloth down.
    rng = np.random.default_rng(1)
    below = rng.choice(xyz[road & (xyz[:, 0] > 12)], 12) - np.float32([0, 0, 1])
    below[:, 2] -= rng.uniform(0, 9, 12)
    deep = np.concatenate([xyz, below, below + np.float32([0.6, 0, 0.2])])
    result = segment_by_cloth(deep)
    assert result[: len(xyz)][road].mean() > 0.97 and not result[len(xyz) :].any()
    assert segment_by_cloth(deep, ClothParams(slope=0.0))[: len(xyz)][road].mean() > 0.9


@given(st.integers(0, 2**31), st.floats(0.01, 0.2))
def test_climbing_cells_equal_the_reference(seed, slope):
    rng = np.random.default_rng(seed)
    lowest = rng.uniform(0, 0.8, (14, 18)).astype(np.float32)
    lowest[rng.random(lowest.shape) < 0.4] = UNOBSERVED
    height = np.zeros_like(lowest)
    observed_cells = np.argwhere(lowest != UNOBSERVED)
    touched = {(r, c) for r, c in observed_cells if lowest[r, c] <= 0.1}
    while True:
        new = set()
        for r, c in map(tuple, observed_cells):
            near = sorted(((r - i) ** 2 + (c - j) ** 2, lowest[i, j]) for i, j in touched)
            if (
                (r, c) not in touched
                and near
                and near[0][0] <= REACH_CELLS**2
                and (lowest[r, c] - near[0][1] <= STEP_M + slope * np.sqrt(near[0][0]))
            ):
                new.add((r, c))
        if not new:
            break
        touched |= new
    result = find_climbing_cells(lowest, height, float(np.float32(0.1)), slope)
    assert {tuple(cell) for cell in np.argwhere(result)} == {
        (r, c) for r, c in touched if lowest[r, c] > np.float32(0.1)
    }


@given(st.integers(0, 2**31))
def test_raising_an_obstacle_never_lowers_the_cloth(seed):
    obstacle = make_obstacles(seed)
    higher = obstacle.copy()
    higher[5:9, 5:9] += np.float32(1)
    low, high = (settle_sheet(o, 0.01, 1e-5, 4) for o in (obstacle, higher))
    assert (high >= low - 2e-4).all()


@pytest.mark.parametrize("slope", [(0, 0), (0.1, -0.05), (-0.2, 0.15)])
def test_sloped_road_is_ground_and_objects_are_not(slope):
    xyz, road = make_street(slope=slope)
    assert compute_f1(segment_by_cloth(xyz), road) > 0.985


def test_hill_too_curved_for_a_plane_is_ground():
    rng = np.random.default_rng(1)
    xy = rng.uniform(-40, 40, (40_000, 2))
    hill = np.column_stack([xy, 2.5 * np.cos(xy[:, 0] / 12) * np.cos(xy[:, 1] / 15)])
    post = rng.uniform(-0.2, 0.2, (200, 3)) * [1, 1, 5] + [10, 10, 3]
    result = segment_by_cloth(np.concatenate([hill, post]).astype(np.float32))
    assert result[: len(hill)].mean() > 0.99 and result[len(hill) :].mean() < 0.2


@given(st.integers(0, 2**31))
def test_permuting_points_permutes_the_ground(seed):
    xyz, _ = make_street(seed, count=4000)
    order = np.random.default_rng(seed).permutation(len(xyz))
    np.testing.assert_array_equal(segment_by_cloth(xyz[order]), segment_by_cloth(xyz)[order])


@pytest.mark.parametrize("degrees, same", [(90, 0.999), (180, 0.999), (23, 0.99), (-71, 0.99)])
def test_rotating_about_z_rotates_the_ground(degrees, same):
    xyz, _ = make_street(3, slope=(0.05, 0.02))
    angle = np.radians(degrees)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    rotated_xyz = (xyz @ turn.T).astype(np.float32)
    assert (segment_by_cloth(rotated_xyz) == segment_by_cloth(xyz)).mean() > same


@pytest.mark.parametrize("far", [[1e5, 0, 0], [0, -9e4, 50], [0, 101, -1.7], [95, 80, 30], [-99, 3, -8]])
def test_far_outlier_does_not_change_the_ground(far):
    xyz, _ = make_street(4)
    result = segment_by_cloth(np.concatenate([xyz, np.float32([far])]))[:-1]
    assert (result != segment_by_cloth(xyz)).mean() < 1e-3


def test_reflections_below_the_ground_do_not_lower_it():
    xyz, _ = make_street(5)
    below = np.column_stack([np.random.default_rng(0).uniform(-30, 30, (40, 2)), np.full(40, -4.0)]).astype(np.float32)
    result = segment_by_cloth(np.concatenate([xyz, below]))
    assert not result[-40:].any()
    assert (result[:-40] != segment_by_cloth(xyz)).mean() < 0.002


def test_points_beyond_max_range_are_ignored():
    xyz, road = make_street(6)
    params = ClothParams(max_range=15)
    inside = (np.abs(xyz[:, :2]) <= 15).all(axis=1)
    result = segment_by_cloth(xyz, params)
    assert not result[~inside].any() and compute_f1(result, road & inside) > 0.99
    cells = 2**5
    assert lay_cloth(xyz, params).height.size <= (2 * 15 / 0.5 + 2 * cells) ** 2


@pytest.mark.parametrize(
    "xyz, expected",
    [
        (np.zeros((0, 3)), []),
        ([[5, 5, -1]], [True]),
        ([[500, 0, 0]], [False]),
        (np.full((9, 3), 3.3), [True] * 9),
        ([[1, 1, -2], [1, 1, -1.9], [1, 1, 4]], [True, True, False]),
    ],
    ids=["empty", "one point", "far", "all equal", "column"],
)
def test_clouds_of_few_points_are_segmented(xyz, expected):
    result = segment_by_cloth(np.asarray(xyz, np.float32).reshape(-1, 3))
    assert result.dtype == bool and result.tolist() == expected


def test_ground_hardly_depends_on_cloth_resolution():
    xyz, road = make_street(7, count=120_000)
    for resolution in (0.3, 0.5, 1.0):
        assert compute_f1(segment_by_cloth(xyz, ClothParams(resolution=resolution)), road) > 0.985


@needs_data
def test_real_scan_scores_as_well_as_with_the_csf_library():
    CSF = pytest.importorskip("CSF")
    labelled = open_recording(DATA / "semantickitti").frames[0]
    frame, semantic = labelled.load(), labelled.point_truth().classes
    params = ClothParams()
    peer = CSF.CSF()
    peer.params.bSloopSmooth = False
    peer.params.cloth_resolution = params.resolution
    peer.params.class_threshold = params.class_threshold
    peer.setPointCloud(frame.xyz.astype(np.float64))
    inside, outside = CSF.VecInt(), CSF.VecInt()
    peer.do_filtering(inside, outside, False)
    theirs = np.zeros(len(frame), bool)
    theirs[np.array(inside)] = True
    ours = segment_by_cloth(frame.xyz, params)
    for protocol in PROTOCOLS:
        truth = select_true_ground(semantic, frame.xyz[:, 2], protocol)
        our_f1, their_f1 = (to_ground_row(count_ground(g, *truth))["f1"] for g in (ours, theirs))
        assert our_f1 > their_f1 - 0.01 and our_f1 > 0.95, protocol
