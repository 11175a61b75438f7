"""Pictures of frames: their content and invariants."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lidar_perception.rendering.canvas import Canvas
from lidar_perception.rendering.colors import BACKGROUND, LABEL, color_by_cluster, color_by_height, get_class_color
from lidar_perception.rendering.picture import Boxes, RenderSettings, _draw_legend, draw_frame
from lidar_perception.types import CLASSES, PointCloud

CAR, PEDESTRIAN = CLASSES.index("Car"), CLASSES.index("Pedestrian")
BOX = np.array([[12.0, 1.0, -1.0, 4.0, 1.8, 1.5, 0.3]])
SIZE = 480, 270
RENDER_SETTINGS = {
    name: RenderSettings(30.0, name == "ahead", -1.73, width=SIZE[0], height=SIZE[1]) for name in ("ahead", "around")
}
each_range = pytest.mark.parametrize("render_settings", RENDER_SETTINGS.values(), ids=RENDER_SETTINGS)


def make_cloud(seed=0, count=2000):
    rng = np.random.default_rng(seed)
    xyz = rng.uniform([-30, -30, -1.8], [40, 30, 2], (count, 3)).astype(np.float32)
    return PointCloud(xyz, rng.uniform(0, 1, count).astype(np.float32))


EMPTY = PointCloud(np.zeros((0, 3), np.float32))


def count_pixels(image, color, tolerance=3):
    """Count pixels of a colour in the left view and in the bird's-eye view."""
    matches = np.abs(image.astype(int) - np.array(color)).max(axis=2) <= tolerance
    left = round(SIZE[0] * 0.625)
    return np.count_nonzero(matches[30:-40, :left]), np.count_nonzero(matches[30:-40, left:])


@each_range
def test_both_views_draw_boxes_in_class_colour(render_settings):
    plain = draw_frame(render_settings, EMPTY, Boxes())
    for class_id in range(len(CLASSES)):
        image = draw_frame(render_settings, EMPTY, Boxes(BOX, np.array([class_id])))
        color = get_class_color(class_id)
        added = np.subtract(count_pixels(image, color), count_pixels(plain, color))
        assert all(added > 20), CLASSES[class_id]


@each_range
def test_labels_trails_and_arrows_are_drawn(render_settings):
    labelled = count_pixels(draw_frame(render_settings, EMPTY, Boxes(), BOX), LABEL, 40)
    plain = count_pixels(draw_frame(render_settings, EMPTY, Boxes()), LABEL, 40)
    assert all(np.subtract(labelled, plain) > 10)
    static_boxes = Boxes(BOX, np.array([CAR]))
    trail = BOX[0, :3] - np.linspace(6, 0, 20)[:, None] * [0.0, 1.0, 0.0]
    for moving in (
        Boxes(BOX, np.array([CAR]), trails=[trail]),
        Boxes(BOX, np.array([CAR]), velocities=np.array([[0.0, 4.0]])),
    ):
        assert np.any(draw_frame(render_settings, EMPTY, moving) != draw_frame(render_settings, EMPTY, static_boxes))


@each_range
@settings(max_examples=10)
@given(st.integers(0, 1000))
def test_order_of_points_and_boxes_does_not_matter(render_settings, seed):
    rng, scan = np.random.default_rng(seed), make_cloud(seed, 300)
    scan.xyz[:, 2] += np.linspace(0, 1, 300)  # all depths differ
    boxes = np.vstack([BOX, BOX + [9, 8, 0, 0, 0, 0, 1]])
    order, reverse = rng.permutation(len(scan)), slice(None, None, -1)
    one = draw_frame(render_settings, scan, Boxes(boxes, np.array([CAR, PEDESTRIAN])))
    two = draw_frame(render_settings, scan.take(order), Boxes(boxes[reverse], np.array([PEDESTRIAN, CAR])))
    assert np.mean(np.any(one != two, axis=2)) < 2e-3  # except points within one depth step


@each_range
def test_point_colour_is_height_or_intensity(render_settings):
    scan = PointCloud(np.array([[15.0, 0, 1.0]], np.float32), np.array([0.9], np.float32))
    for color, expected in (("height", color_by_height(np.array([2.73]))[0]), ("intensity", None)):
        settings = RenderSettings(render_settings.reach, render_settings.ahead, render_settings.ground, color, *SIZE)
        expected = settings.color_points(scan)[0] if expected is None else expected
        assert all(
            np.subtract(
                count_pixels(draw_frame(settings, scan, Boxes()), expected, 0),
                count_pixels(draw_frame(settings, EMPTY, Boxes()), expected, 0),
            )
            > 0
        )


def test_given_point_colours_are_not_modified():
    scan = make_cloud()
    ground, clusters = scan.xyz[:, 2] < -1.5, (scan.xyz[:, 0] > 10).astype(int)
    colors = color_by_cluster(ground, clusters)
    before = colors.copy()
    image = draw_frame(RENDER_SETTINGS["ahead"], scan, Boxes(BOX, np.array([CAR])), colors=colors)
    np.testing.assert_array_equal(colors, before)
    assert len(np.unique(colors, axis=0)) == 3 and image.shape == (SIZE[1], SIZE[0], 3)


@pytest.mark.parametrize("far, reach", [(0.5, 6.0), (20.0, 20.0), (500.0, 55.0)])
def test_view_covers_the_range_of_the_first_cloud(far, reach):
    angles = np.linspace(0, 2 * np.pi, 200)
    scan = PointCloud(np.stack([far * np.cos(angles), far * np.sin(angles), 0 * angles], axis=1).astype(np.float32))
    render_settings = RenderSettings.of(scan, 1.0, True, size=SIZE)
    assert render_settings.reach == pytest.approx(reach, rel=1e-3) and render_settings.ground == -1.0
    assert 3 <= len(render_settings.ring_radii) <= 12
    assert RenderSettings.of(EMPTY, 1.0, False).reach == 6.0


@pytest.mark.parametrize("width", [480, 800, 1280])
def test_color_scale_does_not_overlap_the_class_names(width):
    render_settings = RenderSettings(30.0, True, -1.73, width=width, height=270)
    found = Boxes(np.repeat(BOX, 3, axis=0), np.array([CAR, PEDESTRIAN, CLASSES.index("Cyclist")]))
    *classes, scale, _ = _draw_legend(Canvas(width, 270, BACKGROUND), render_settings, found, BOX, True)
    last = classes[-1]
    end, start = last.position[0] + 9 * len(last.text), scale.position[0] - 8 * len(scale.text)
    assert len(classes) == 4 and (end < start or scale.position[1] < last.position[1] - 12)
