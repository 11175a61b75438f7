"""The canvas compared with slow reference implementations, and videos."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from lidar_perception.rendering.canvas import Canvas, Text
from lidar_perception.rendering.files import MAX_ANIMATED, check_video, open_video
from lidar_perception.rendering.views import NEAR, BirdsEye, Perspective, project_lines
from lidar_perception.types import InputError

SIZE = 24, 16
RED, GREEN = np.array([255, 0, 0], np.uint8), np.array([0, 255, 0], np.uint8)
VIEWS = {
    "behind": Perspective((-10.0, 0.0, 5.0), (10.0, 0.0, 0.0), 70.0, 80, 60),
    "above": BirdsEye((5.0, 0.0), 3.0, 80, 60),
}


def seeds():
    return st.integers(0, 10_000).map(np.random.default_rng)


@given(seeds())
def test_near_points_hide_far_ones(rng):
    count = rng.integers(0, 60)
    at = rng.uniform(-6, 30, (count, 2))
    depth = rng.permutation(count) * 0.5 + 1.0
    colors = rng.integers(1, 256, (count, 3)).astype(np.uint8)
    radius = np.where(depth < 10, 1.5, 0.5)
    canvas = Canvas(*SIZE)
    canvas.draw_points(at, depth, colors, radius)
    expected = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    for k in np.argsort(-depth):
        column, row = np.floor(at[k]).astype(int)
        reach = 1 if depth[k] < 10 else 0
        for y in range(max(row - reach, 0), min(row + reach + 1, SIZE[1])):
            for x in range(max(column - reach, 0), min(column + reach + 1, SIZE[0])):
                expected[y, x] = colors[k]
    np.testing.assert_array_equal(canvas.pixels, expected)


@given(seeds())
def test_drawn_line_has_the_given_width(rng):
    start, end = rng.uniform(-20, 40, (2, 2))
    if np.hypot(*(end - start)) < 1:
        return
    canvas = Canvas(*SIZE)
    canvas.draw_lines([[start, end]], RED, 3.0)
    x, y = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    way = end - start
    share = ((x - start[0]) * way[0] + (y - start[1]) * way[1]) / (way @ way)
    away = np.abs((x - start[0]) * way[1] - (y - start[1]) * way[0]) / np.hypot(*way)
    red = canvas.pixels[..., 0]
    margin = 2.0 / np.hypot(*way)
    assert (red[(away < 0.4) & (share > margin) & (share < 1 - margin)] > 250).all()
    assert (red[(away > 3.0) | (share < -margin - 0.1) | (share > 1 + margin + 0.1)] == 0).all()


def test_dashed_line_has_gaps_and_alpha_makes_it_fainter():
    plain, dashed, faint = (Canvas(60, 9) for _ in range(3))
    line = [[[2, 4.5], [58, 4.5]]]
    plain.draw_lines(line, RED, 2.0)
    dashed.draw_lines(line, RED, 2.0, dashed=True)
    faint.draw_lines(line, RED, 2.0, alpha=0.5)
    row = [canvas.pixels[4, 4:56, 0] for canvas in (plain, dashed, faint)]
    assert (row[0] == 255).all() and 0.3 < (row[1] == 255).mean() < 0.8
    assert np.abs(row[2] - 127.5).max() <= 1


def test_canvas_skips_invalid_and_outside_shapes():
    canvas = Canvas(*SIZE)
    canvas.draw_lines(np.full((2, 2, 2), np.nan), RED)
    canvas.draw_lines(np.zeros((0, 2, 2)), RED)
    canvas.draw_lines([[[-9e9, -5], [9e9, -5]], [[1e30, 1e30], [2e30, 1e30]]], RED)
    canvas.draw_points(np.zeros((0, 2)), np.zeros(0), np.zeros((0, 3), np.uint8), np.zeros(0))
    canvas.fill_polygon(np.full((4, 2), np.nan), RED)
    canvas.fill_polygon(np.array([[50, 50], [60, 50], [60, 60]]), RED)
    canvas.draw_texts([])
    assert not canvas.pixels.any()


def test_polygon_fills_its_interior():
    for corners in np.array([[2, 3], [12, 3], [12, 9], [2, 9]]), np.array([[2, 9], [12, 9], [12, 3], [2, 3]]):
        canvas = Canvas(*SIZE)
        canvas.fill_polygon(corners, GREEN, 0.5)
        assert (canvas.pixels[3:9, 2:12, 1] == 128).all()
        assert np.count_nonzero(canvas.pixels) == 60


def test_text_is_placed_at_its_anchor():
    canvas = Canvas(80, 40)
    canvas.draw_texts([Text((70, 20), "12 m/s", (255, 255, 255), 14, "rm")])
    rows, columns = np.nonzero(canvas.pixels[..., 0] > 200)
    assert 60 < columns.max() <= 70 and columns.min() > 10 and 10 < rows.min() < rows.max() < 30


@pytest.mark.parametrize("name", VIEWS)
@given(seeds())
def test_view_keeps_lines_straight(name, rng):
    view = VIEWS[name]
    ends = rng.uniform(-20, 20, (2, 3))
    line = ends[0] + np.linspace(0, 1, 9)[:, None] * (ends[1] - ends[0])
    pixels, depth = view.project(line)
    if (depth > NEAR).all():
        way = pixels[-1] - pixels[0]
        aside = (pixels - pixels[0]) @ [way[1], -way[0]]
        assert np.abs(aside).max() <= 1e-6 * max(way @ way, 1)
    one = view.project(line.astype(np.float32))
    np.testing.assert_allclose(one[1], depth, atol=1e-3)
    cut = project_lines(view, ends[None])
    assert np.isnan(cut).all() == bool((depth[[0, -1]] < NEAR).all())


def test_views_look_ahead():
    behind, above = VIEWS.values()
    pixels, depth = behind.project(np.array([[10.0, 0, 0], [10, 3, 0], [10, 0, 3], [-30, 0, 0]]))
    np.testing.assert_allclose(pixels[0], [40, 30], atol=1e-9)
    assert pixels[1, 0] < 40 and pixels[2, 1] < 30 and depth[3] < 0 < depth[0]  # y left, z up
    pixels, depth = above.project(np.array([[5.0, 0, 0], [6, 0, 0], [5, 1, 0], [5, 0, 1]]))
    np.testing.assert_allclose(pixels, [[40, 30], [40, 27], [37, 30], [40, 30]])
    assert depth[3] < depth[0]


def make_pictures(count):
    return [np.full((90, 160, 3), 40 * k, np.uint8) for k in range(count)]


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv", "a.gif", "a.webp"])
def test_video_has_every_picture_with_its_duration(name, tmp_path):
    path = tmp_path / "deep" / name
    if path.suffix in (".mp4", ".mkv"):
        pytest.importorskip("av", reason="needs PyAV, the extra [video]")
    check_video(path, 4)
    with open_video(path, (160, 90)) as video:
        for k, picture in enumerate(make_pictures(4)):
            video.add(picture, 0.1 if k else 0.3)
        assert not path.exists()
    assert [p.name for p in path.parent.iterdir()] == [name]
    pictures, times = read_video(path)
    assert [np.abs(image - 40 * k).max() <= 8 for k, image in enumerate(pictures)] == [True] * 4
    assert times == pytest.approx([0, 0.3, 0.4, 0.5], abs=0.011)


def read_video(path):
    """Return the pictures and their start times in seconds."""
    if path.suffix in (".gif", ".webp"):
        image, pictures, times, now = Image.open(path), [], [], 0.0
        for k in range(image.n_frames):
            image.seek(k)
            pictures.append(np.asarray(image.convert("RGB"), float))
            times.append(now)
            now += image.info["duration"] / 1000
        return pictures, times
    import av

    with av.open(str(path)) as container:
        frames = [(frame.to_ndarray(format="rgb24").astype(float), frame.time) for frame in container.decode(video=0)]
    return [list(column) for column in zip(*frames)]


def test_failed_or_empty_video_leaves_no_file(tmp_path):
    for suffix in (".gif", *[".mp4"] * (importlib.util.find_spec("av") is not None)):
        with open_video(tmp_path / f"a{suffix}", (160, 90)):
            pass
    with pytest.raises(ZeroDivisionError), open_video(tmp_path / "a.gif", (160, 90)) as video:
        video.add(make_pictures(1)[0], 1 / 0)
    assert not [*tmp_path.iterdir()]


def test_unsupported_videos_are_rejected(tmp_path, monkeypatch):
    with pytest.raises(InputError, match=r"a.avi is not a video file; .*\.mp4"):
        check_video(tmp_path / "a.avi", 1)
    with pytest.raises(InputError, match=f"would have {MAX_ANIMATED + 1} frames.*--limit"):
        check_video(tmp_path / "a.gif", MAX_ANIMATED + 1)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"a.mp4 needs PyAV; run pip install 'lidar_perception\[video"):
        check_video(tmp_path / "a.mp4", 1)
    check_video(tmp_path / "a.webp", 1)
