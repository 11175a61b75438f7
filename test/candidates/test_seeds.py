"""Seeds from labels, from a click and from a template file."""

from __future__ import annotations

import json
import os

import numpy as np
import pytest
from candidate_samples import GROUND_Z, PEOPLE, make_boxes_at, make_people_scene, make_person
from hypothesis import given
from hypothesis import strategies as st

from lidar_perception.candidates.seeds import (
    Seed,
    load_seed,
    save_seed,
    seed_from_click,
    seed_from_points,
    seed_from_truth,
)
from lidar_perception.candidates.silhouette import to_pixels
from lidar_perception.clustering.shapes import fit_boxes
from lidar_perception.geometry import points_in_box
from lidar_perception.types import InputError

seeds = st.integers(0, 2**32 - 1)


def test_seed_from_labels_is_the_nearest_pedestrian():
    xyz = make_people_scene()
    ground = xyz[:, 2] < GROUND_Z + 0.4  # includes the feet
    boxes = make_boxes_at(PEOPLE[[2, 0, 1]])
    in_box = points_in_box(xyz, boxes[1])
    assert (in_box & ground).any()
    seed = seed_from_truth(xyz, ground, boxes)
    np.testing.assert_array_equal(seed.xyz, xyz[in_box & ~ground])
    assert seed.height == 1.8 and seed.floor == pytest.approx(boxes[1, 2] - 0.9)
    with_ground = seed_from_points(xyz[in_box], boxes[1])
    assert (with_ground.draw_silhouette() != seed.draw_silhouette()).any()


def test_seed_from_labels_needs_a_pedestrian_with_ten_points():
    xyz = make_person(6, 0, count=9).astype(np.float32)
    no_ground = np.zeros(9, bool)
    with pytest.raises(InputError, match="no Pedestrian"):
        seed_from_truth(xyz, no_ground, np.zeros((0, 7)))
    with pytest.raises(InputError, match="has only 9 points"):
        seed_from_truth(xyz, no_ground, make_boxes_at([[6, 0]]))
    ten_points = np.concatenate([xyz, xyz[:1]])
    assert seed_from_truth(ten_points, np.zeros(10, bool), make_boxes_at([[6, 0]])).height == 1.8
    with pytest.raises(InputError, match="has only 0 points"):
        seed_from_truth(ten_points, np.ones(10, bool), make_boxes_at([[6, 0]]))


def make_clicked_scene():
    xyz = np.concatenate([make_person(6, 0), make_person(8, 3, seed=1)]).astype(np.float32)
    labels = np.repeat(np.int32([1, 2]), 400)
    return xyz, labels, fit_boxes(xyz, labels, "axis_aligned")


def test_seed_from_click_takes_the_nearest_cluster():
    xyz, labels, boxes = make_clicked_scene()
    for k, click in ((1, [6, 0.2, -1]), (2, [8.5, 3, 0]), (1, [6, 1.2, -1]), (2, [8, 1.8, -1])):
        seed = seed_from_click(np.array(click), xyz, labels, boxes, 2.0)
        np.testing.assert_array_equal(seed.xyz, xyz[labels == k])
        assert seed.height == boxes[k - 1, 5]
        assert seed.floor == pytest.approx(boxes[k - 1, 2] - boxes[k - 1, 5] / 2)


def test_seed_from_click_ignores_noise_points():
    xyz, labels, boxes = make_clicked_scene()
    xyz = np.concatenate([np.float32([[7, 1.5, -1]]), xyz])
    labels = np.concatenate([np.int32([0]), labels])
    with pytest.raises(InputError, match="nearest cluster is"):
        seed_from_click(np.array([7, 1.5, -1]), xyz, labels, boxes, 0.5)


def test_seed_from_click_needs_a_cluster_within_the_radius():
    xyz, labels, boxes = make_clicked_scene()
    edge = np.array([xyz[:, 0].min() - 1.0, 0, -1])
    seed_from_click(edge, xyz, labels, boxes, 1.5)
    with pytest.raises(InputError, match=r"within 0\.9 m"):
        seed_from_click(edge, xyz, labels, boxes, 0.9)
    with pytest.raises(InputError, match="no clusters"):
        seed_from_click(edge, xyz, np.zeros_like(labels), boxes[:0], 2.0)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e300])
def test_distant_or_non_finite_click_is_rejected(axis, value):
    xyz, labels, boxes = make_clicked_scene()
    click = np.array([6, 0.2, -1.0])
    click[axis] = value
    with pytest.raises(InputError, match=r"not finite|nearest cluster is inf"):
        seed_from_click(click, xyz, labels, boxes, 2.0)


@given(seeds, st.integers(1, 30_000), st.integers(10, 300))
def test_load_seed_inverts_save_seed(tmp_path_factory, seed, tenth_mm, count):
    rng = np.random.default_rng(seed)
    xyz = np.float32(np.round(rng.uniform(-90, 90, (count, 3)), 4))
    path = tmp_path_factory.mktemp("seed") / "folder/template.json"
    save_seed(Seed(xyz, -1.7321, tenth_mm / 10_000), path)
    loaded_seed = load_seed(path)
    np.testing.assert_array_equal(loaded_seed.xyz, xyz)
    assert (loaded_seed.floor, loaded_seed.height) == (-1.7321, tenth_mm / 10_000)


POINTS = [[5.0, 0.1 * i, -1.0] for i in range(10)]
GOOD = {"height_m": 1.7, "floor_m": -1.7, "points_m": POINTS}


def make_template(**values):
    return json.dumps({**GOOD, **values})


@pytest.mark.parametrize(
    "text",
    [
        "",
        "not JSON",
        "[]",
        "{}",
        "null",
        "3",
        '"text"',
        json.dumps({"height_m": 1.7}),
        json.dumps({"points_m": POINTS}),
        make_template(height_m="tall"),
        make_template(height_m=None),
        make_template(height_m=0),
        make_template(height_m=-1.7),
        make_template(height_m=float("nan")),
        make_template(floor_m=None),
        make_template(floor_m=float("inf")),
        make_template(points_m=None),
        make_template(points_m=7),
        make_template(points_m=[]),
        make_template(points_m=POINTS[:9]),
        make_template(points_m=[[1.0, 2.0]] * 10),
        make_template(points_m=[*POINTS, [1.0]]),
        make_template(points_m=[*POINTS, [1.0, 2.0, "x"]]),
        make_template(points_m=[*POINTS, [1, 2, float("nan")]]),
        make_template(points_m=[*POINTS, [10**400, 0, 0]]),
        make_template(height_m=10**400),
        make_template(floor_m=10**400),
        make_template(points_m=[*POINTS, [1e300, 0, 0]]),
        make_template(points_m=[*POINTS, [1e30, 0, 0]]),
        make_template(height_m=1e30),
        make_template(floor_m=-1e30),
        make_template(height_m="9" * 5000),
        "9" * 5000,
        "[" * 100_000,
        '{"points_m": ' + "[" * 100_000,
        " " * 10_000_001,
    ],
    ids=lambda text: text[-30:],
)
def test_error_of_a_bad_template_names_the_file(tmp_path, text):
    path = tmp_path / "bad.json"
    path.write_text(text)
    with pytest.raises(InputError, match=r"bad\.json") as error:
        load_seed(path)
    assert "\n" not in str(error.value) and len(str(error.value)) < 1000


def test_named_pipe_as_template_is_rejected(tmp_path):
    os.mkfifo(tmp_path / "pipe.json")
    with pytest.raises(InputError, match=r"pipe\.json is not a regular file"):
        load_seed(tmp_path / "pipe.json")


def test_error_of_an_unreadable_template_names_the_file(tmp_path):
    binary = tmp_path / "binary.json"
    binary.write_bytes(b"\xff\xfe\x00\x81")
    for path in (tmp_path / "missing.json", tmp_path, binary):
        with pytest.raises(InputError, match=path.name):
            load_seed(path)


def test_packaged_template_is_a_pedestrian():
    seed = load_seed()
    assert 1.4 < seed.height < 2.1
    pixels = to_pixels(seed.draw_silhouette())
    assert pixels[0].any() and pixels[-1].any() and pixels[:, 0].any() and pixels[:, -1].any()
