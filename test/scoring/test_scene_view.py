"""The picture in perspective: what is near hides what is behind, and lines are where they are."""

from __future__ import annotations

import numpy as np
import pytest

from lidar_perception.geometry import box_corners
from lidar_perception.scoring.scene_view import (
    EDGES,
    View,
    discs,
    draw_scene,
    lines,
    nearest,
    render,
)
from lidar_perception.types import CLASSES, InputError

VIEW = View(eye=(-5.0, 1.0, 2.0), target=(10.0, 0.0, 0.0), fov=60.0, width=160, height=100)
CAR = np.array([[8.0, 0.5, 0.0, 4.0, 1.6, 1.5, 0.7]])
NO_BOXES, RED, GREEN = np.zeros((0, 7)), [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]


def picture(xyz, colors=None, boxes=NO_BOXES, box_colors=None, view=VIEW):
    xyz = np.reshape(xyz, (-1, 3))
    colors = np.zeros((len(xyz), 3)) if colors is None else np.asarray(colors, float)
    return render(view, xyz, colors, boxes, np.ones((len(boxes), 3)) if box_colors is None
                  else box_colors)


def test_the_target_is_in_the_middle_and_axes_are_right_down_and_ahead():
    pixels, ahead = VIEW.project(np.array(VIEW.target))
    assert pixels == pytest.approx([80, 50])
    assert ahead == pytest.approx(np.linalg.norm(np.subtract(VIEW.target, VIEW.eye)))
    assert VIEW.axes() @ VIEW.axes().T == pytest.approx(np.eye(3))
    to_the_left_and_up = VIEW.project(np.array(VIEW.target) + [0.0, 1.0, 1.0])[0]
    assert (to_the_left_and_up < [80, 50]).all()


def test_the_field_of_view_reaches_from_edge_to_edge():
    right, _, ahead = VIEW.axes()
    edge = np.array(VIEW.eye) + 7 * (ahead + np.tan(np.radians(30)) * right)
    assert VIEW.project(edge)[0] == pytest.approx([160, 50])


def test_what_is_behind_the_eye_has_no_pixel():
    behind = np.array(VIEW.eye) - VIEW.axes()[2]
    assert np.isnan(VIEW.project(behind)[0]).all()
    assert (picture(behind) == picture([])).all()


@pytest.mark.parametrize("order", [[0, 1], [1, 0]])
def test_a_point_hides_the_one_behind_it_whatever_their_order(order):
    way = VIEW.axes()[2]
    xyz = np.array([VIEW.eye + 4 * way, VIEW.eye + 9 * way])
    seen = picture(xyz[order], np.array([RED, GREEN])[order])
    assert (seen == picture(xyz[:1], [RED])).all()
    assert seen[50, 80, 0] > 100


def test_the_depth_buffer_is_that_of_a_loop():
    rng = np.random.default_rng(5)
    pixels, depth = rng.uniform(-3, [163, 103], (300, 2)), rng.uniform(1, 9, 300)
    radius = rng.uniform(0, 3, 300)
    got, source = nearest(VIEW, discs(VIEW, pixels, depth, radius))
    expected, first = np.full((100, 160), np.inf), np.full((100, 160), -1)
    for i, (column, row) in enumerate(np.floor(pixels).astype(int)):
        for y in range(max(row - 3, 0), min(row + 4, 100)):
            for x in range(max(column - 3, 0), min(column + 4, 160)):
                if ((x - column) ** 2 + (y - row) ** 2 <= radius[i] ** 2
                        and depth[i] < expected[y, x]):
                    expected[y, x], first[y, x] = depth[i], i
    assert (got.reshape(100, 160) == expected).all()
    assert (source.reshape(100, 160) == first).all()


def test_edges_of_a_box_lie_between_its_projected_corners():
    corners = box_corners(CAR)[0]
    drawn = lines(VIEW, corners[EDGES[:, 0]], corners[EDGES[:, 1]], 0.5)
    pixels, ahead = VIEW.project(corners)
    at = np.stack([drawn.place % VIEW.width, drawn.place // VIEW.width], 1) + 0.5
    start, end = pixels[EDGES[drawn.source, 0]], pixels[EDGES[drawn.source, 1]]
    along = end - start
    across = along[:, 0] * (at - start)[:, 1] - along[:, 1] * (at - start)[:, 0]
    off = np.abs(across) / np.linalg.norm(along, axis=1)
    assert off.max() < 1
    assert drawn.depth.min() == pytest.approx(ahead.min())
    assert drawn.depth.max() == pytest.approx(ahead.max())
    for corner in np.floor(pixels).astype(int):
        assert corner[1] * VIEW.width + corner[0] in drawn.place


def test_a_line_that_comes_from_behind_the_eye_is_cut_off_and_bounded():
    drawn = lines(VIEW, np.array([VIEW.eye]) - [[9.0, 0.0, 1.0]], np.array([VIEW.target]), 1.0)
    assert len(drawn.place) and drawn.depth.min() > 0
    assert len(drawn.place) < 9 * 5 * VIEW.width
    behind = np.array([VIEW.eye]) - 2 * VIEW.axes()[2]
    assert len(lines(VIEW, behind, behind - 1, 1.0).place) == 0


def test_a_wall_of_points_dims_the_edges_behind_it():
    right, down, ahead = VIEW.axes()
    across, up = np.meshgrid(np.linspace(-4, 4, 250), np.linspace(-3, 3, 180))
    wall = VIEW.eye + 5 * ahead + across.reshape(-1, 1) * right + up.reshape(-1, 1) * down
    white, black = np.ones((1, 3)), np.zeros((len(wall), 3))
    free, hidden = picture([], None, CAR, white), picture(wall, black, CAR, white)
    assert free.max() > 200 and 0 < hidden.max() < 0.45 * free.max()


def test_the_front_tells_where_a_box_is_heading():
    turned = CAR + [0, 0, 0, 0, 0, 0, np.pi]
    assert (picture([], None, CAR) != picture([], None, turned)).any()


def test_arguments_stay_as_they_are_and_a_picture_is_the_same_twice():
    rng = np.random.default_rng(1)
    xyz, colors = rng.uniform(-5, 9, (500, 3)), rng.uniform(0, 1, (500, 3))
    kept = xyz.copy(), colors.copy(), CAR.copy()
    assert (picture(xyz, colors, CAR) == picture(xyz, colors, CAR)).all()
    for one, other in zip((xyz, colors, CAR), kept):
        assert (one == other).all()


@pytest.mark.parametrize("points, boxes", [(0, 0), (0, 2), (50, 0), (50, 2)])
def test_a_png_of_the_right_size_is_written(tmp_path, points, boxes):
    plt = pytest.importorskip("matplotlib.pyplot")
    rng = np.random.default_rng(0)
    draw_scene(tmp_path / "new" / "a.png", rng.uniform(-9, 9, (points, 3)),
               rng.uniform(size=points) < 0.5, rng.integers(0, 4, points),
               np.repeat(CAR, boxes, axis=0), np.full(boxes, CLASSES.index("Tram")), view=VIEW)
    assert plt.imread(tmp_path / "new" / "a.png").shape[:2] == (100, 160)


def test_a_file_that_cannot_be_written_is_an_input_error(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="cannot write"):
        draw_scene(tmp_path / "file" / "a.png", np.zeros((0, 3)), np.zeros(0, bool),
                   np.zeros(0, int), NO_BOXES, np.zeros(0, int), view=VIEW)
