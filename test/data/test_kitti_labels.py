"""KITTI labels survive conversion between text, boxes and markers."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from kitti_samples import (
    LAYOUTS,
    are_equal_truths,
    each_layout,
    format_truth,
    pass_through_markers,
    write_raw_folder,
    write_tracking_folder,
)
from samples import AXES, LABELS, LIDAR_TO_CAMERA, write_file, write_object_folder

from lidar_perception.data.kitti.labels import parse_label, to_ground_truth, to_labels
from lidar_perception.data.open import open_recording
from lidar_perception.geometry import box_corners
from lidar_perception.types import CLASSES, GroundTruth


def draw_decimals(low: int, high: int):
    return st.integers(low, high).map(lambda n: f"{n / 100:.2f}")


@st.composite
def draw_label_line(draw) -> str:
    if draw(st.booleans()):
        bbox = [draw(draw_decimals(0, 120000)) for _ in range(4)]
        return f"DontCare -1 -1 -10 {' '.join(bbox)} -1 -1 -1 -1000 -1000 -1000 -10"
    return " ".join(
        [
            draw(st.sampled_from([*CLASSES[:-1], "Unicorn"])),
            draw(draw_decimals(0, 100)),
            str(draw(st.integers(0, 3))),
            draw(draw_decimals(-314, 314)),
            *(draw(draw_decimals(0, 120000)) for _ in range(4)),
            *(draw(draw_decimals(30, 2000)) for _ in range(3)),
            draw(draw_decimals(-5000, 5000)),
            draw(draw_decimals(-300, 500)),
            draw(draw_decimals(100, 8000)),
            draw(draw_decimals(-314, 314)),
        ]
    )


@given(st.lists(draw_label_line(), max_size=6))
def test_labels_survive_conversion_to_markers_and_back(lines):
    truth = to_ground_truth([parse_label(line) for line in lines], LIDAR_TO_CAMERA)
    received = pass_through_markers(truth)
    assert are_equal_truths(received, truth)
    expected = sorted(lines, key=lambda line: line.startswith("DontCare"))  # regions come last
    assert format_truth(truth) == format_truth(received) == expected


@given(draw_label_line().filter(lambda line: not line.startswith(("DontCare", "Unicorn"))))
def test_computed_label_matches_its_box(line):
    label = parse_label(line)
    truth = to_ground_truth([label], LIDAR_TO_CAMERA)
    (computed_label,) = to_labels(GroundTruth.of(truth.boxes, truth.class_ids), LIDAR_TO_CAMERA)
    assert computed_label["class"] == label["class"]
    np.testing.assert_allclose(computed_label["dimensions"], label["dimensions"], atol=1e-9)
    np.testing.assert_allclose(computed_label["location"], label["location"], atol=1e-9)
    assert abs(np.sin((computed_label["rotation_y"] - label["rotation_y"]) / 2)) < 0.0025
    x, _, z = label["location"]  # alpha: heading relative to the ray to the object
    assert abs(np.sin((computed_label["alpha"] - (computed_label["rotation_y"] - np.arctan2(x, z))) / 2)) < 1e-9
    assert -np.pi <= computed_label["alpha"] <= np.pi


@given(draw_label_line().filter(lambda line: not line.startswith("DontCare")))
def test_box_corners_match_the_development_kit(line):
    """Compare with computeBox3D.m, for a level camera."""
    label = parse_label(line)
    level = np.eye(4)
    level[:3] = np.column_stack([AXES, [0.1, -0.2, -0.3]])
    h, w, length = label["dimensions"]
    cos, sin = np.cos(label["rotation_y"]), np.sin(label["rotation_y"])
    x = length / 2 * np.array([1, 1, -1, -1, 1, 1, -1, -1])
    y = h * np.array([0, 0, 0, 0, -1, -1, -1, -1])
    z = w / 2 * np.array([1, -1, -1, 1, 1, -1, -1, 1])
    camera = np.stack([cos * x + sin * z, y, cos * z - sin * x]).T + label["location"]
    lidar = (camera - level[:3, 3]) @ level[:3, :3]
    ours = box_corners(to_ground_truth([label], level).boxes)[0]
    distance = np.linalg.norm(ours[:, None] - lidar, axis=2)
    assert distance.min(axis=0).max() < 1e-9 and distance.min(axis=1).max() < 1e-9


def test_object_labels_belong_to_their_frame(tmp_path):
    root = write_object_folder(tmp_path)
    write_file(root / "training/label_2/000001.txt", "")
    first, second = open_recording(root).frames
    assert format_truth(first.truth()) == LABELS.splitlines()
    assert len(second.truth()) == 0 and second.truth().notes == ()


def test_tracking_labels_belong_to_sequence_and_frame(tmp_path):
    first, second, third, *other = [f.truth() for f in open_recording(write_tracking_folder(tmp_path))]
    assert first.labels == ["Pedestrian"] and first.extras[0]["track_id"] == 3
    assert [name for name, _ in first.notes] == ["DontCare"]
    assert len(second) == 0
    assert third.labels == ["Person_sitting"] and third.extras[0]["track_id"] == 4
    assert other == [None, None]  # this sequence has no label file
    assert all(are_equal_truths(pass_through_markers(t), t) for t in (first, second, third))


def test_tracklets_are_placed_by_their_bottom_face(tmp_path):
    first, second, third = [f.truth() for f in open_recording(write_raw_folder(tmp_path))]
    assert len(first) == 0
    np.testing.assert_allclose(second.boxes, [[8, -1, -0.8, 0.9, 0.5, 1.8, 0.5]])
    assert second.extras[0] == {"track_id": 0, "occluded": 1, "truncated": 0.0}
    assert third.labels == ["Pedestrian", "Person_sitting"]
    np.testing.assert_allclose(third.boxes, [[9, -1, -0.8, 0.9, 0.5, 1.8, 0.6], [5, 2, -1.0, 0.8, 0.6, 1.2, -3]])
    assert [e["track_id"] for e in third.extras] == [0, 1]
    assert are_equal_truths(pass_through_markers(third), third)


@each_layout
def test_folder_without_labels_has_no_truth(tmp_path, layout):
    root = LAYOUTS[layout](tmp_path)
    for path in [*root.rglob("label_*/*.txt"), *root.rglob("tracklet_labels.xml")]:
        path.unlink()
    assert [f.truth() for f in open_recording(root)] == [None] * len(open_recording(root))
