"""Pictures of frames: their content, and changes that must not matter."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lidar_perception.rendering.colors import LABEL, by_cluster, by_height, class_color
from lidar_perception.rendering.picture import Boxes, Stage, draw_frame
from lidar_perception.types import CLASSES, LidarFrame

CAR, PEDESTRIAN = CLASSES.index("Car"), CLASSES.index("Pedestrian")
BOX = np.array([[12.0, 1.0, -1.0, 4.0, 1.8, 1.5, 0.3]])
SIZE = 480, 270
STAGES = {name: Stage(30.0, name == "ahead", -1.73, width=SIZE[0], height=SIZE[1])
          for name in ("ahead", "around")}
each_stage = pytest.mark.parametrize("stage", STAGES.values(), ids=STAGES)


def cloud(seed=0, count=2000):
    rng = np.random.default_rng(seed)
    xyz = rng.uniform([-30, -30, -1.8], [40, 30, 2], (count, 3)).astype(np.float32)
    return LidarFrame(xyz, rng.uniform(0, 1, count).astype(np.float32))


NOBODY = LidarFrame(np.zeros((0, 3), np.float32))


def share(image, color, tolerance=3):
    """Pixels of a colour, in the view from behind and in that from above."""
    near = np.abs(image.astype(int) - np.array(color)).max(axis=2) <= tolerance
    left = round(SIZE[0] * 0.625)
    return np.count_nonzero(near[30:-40, :left]), np.count_nonzero(near[30:-40, left:])


@each_stage
def test_boxes_are_drawn_in_both_views_in_the_colour_of_their_class(stage):
    plain = draw_frame(stage, NOBODY, Boxes())
    for class_id in range(len(CLASSES)):
        image = draw_frame(stage, NOBODY, Boxes(BOX, np.array([class_id])))
        drawn, before = share(image, class_color(class_id)), share(plain, class_color(class_id))
        assert all(np.subtract(drawn, before) > 20), CLASSES[class_id]


@each_stage
def test_labels_are_dashed_and_trails_and_arrows_are_drawn(stage):
    labelled = share(draw_frame(stage, NOBODY, Boxes(), BOX), LABEL, 40)
    plain = share(draw_frame(stage, NOBODY, Boxes()), LABEL, 40)
    assert all(np.subtract(labelled, plain) > 10)
    still = Boxes(BOX, np.array([CAR]))
    trail = BOX[0, :3] - np.linspace(6, 0, 20)[:, None] * [0.0, 1.0, 0.0]
    for moving in (Boxes(BOX, np.array([CAR]), trails=[trail]),
                   Boxes(BOX, np.array([CAR]), velocities=np.array([[0.0, 4.0]]))):
        assert np.any(draw_frame(stage, NOBODY, moving) != draw_frame(stage, NOBODY, still))


@each_stage
@settings(max_examples=10)
@given(st.integers(0, 1000))
def test_the_order_of_points_and_boxes_does_not_matter(stage, seed):
    rng, scan = np.random.default_rng(seed), cloud(seed, 300)
    scan.xyz[:, 2] += np.linspace(0, 1, 300)  # no two at one depth
    boxes = np.vstack([BOX, BOX + [9, 8, 0, 0, 0, 0, 1]])
    order, turned = rng.permutation(len(scan)), slice(None, None, -1)
    one = draw_frame(stage, scan, Boxes(boxes, np.array([CAR, PEDESTRIAN])))
    two = draw_frame(stage, scan.take(order), Boxes(boxes[turned], np.array([PEDESTRIAN, CAR])))
    assert np.mean(np.any(one != two, axis=2)) < 2e-3  # but for points within a step of depth


@each_stage
def test_points_have_their_height_or_intensity_as_colour(stage):
    scan = LidarFrame(np.array([[15.0, 0, 1.0]], np.float32), np.array([0.9], np.float32))
    for color, expected in (("height", by_height(np.array([2.73]))[0]), ("intensity", None)):
        made = Stage(stage.reach, stage.ahead, stage.ground, color, *SIZE)
        expected = made.colors(scan)[0] if expected is None else expected
        assert all(np.subtract(share(draw_frame(made, scan, Boxes()), expected, 0),
                               share(draw_frame(made, NOBODY, Boxes()), expected, 0)) > 0)


def test_colours_given_for_the_points_are_not_changed():
    scan = cloud()
    ground, clusters = scan.xyz[:, 2] < -1.5, (scan.xyz[:, 0] > 10).astype(int)
    colors = by_cluster(ground, clusters)
    before = colors.copy()
    image = draw_frame(STAGES["ahead"], scan, Boxes(BOX, np.array([CAR])), colors=colors)
    np.testing.assert_array_equal(colors, before)
    assert len(np.unique(colors, axis=0)) == 3 and image.shape == (SIZE[1], SIZE[0], 3)


@pytest.mark.parametrize("far, reach", [(0.5, 6.0), (20.0, 20.0), (500.0, 55.0)])
def test_the_stage_shows_what_the_first_cloud_reaches(far, reach):
    angles = np.linspace(0, 2 * np.pi, 200)
    scan = LidarFrame(np.stack([far * np.cos(angles), far * np.sin(angles), 0 * angles],
                               axis=1).astype(np.float32))
    stage = Stage.of(scan, 1.0, True, size=SIZE)
    assert stage.reach == pytest.approx(reach, rel=1e-3) and stage.ground == -1.0
    assert 3 <= len(stage.rings) <= 12
    assert Stage.of(NOBODY, 1.0, False).reach == 6.0
