"""KITTI's protocol: hand-computed cases, invariants, and an independent implementation."""

from __future__ import annotations

import dataclasses
import json

import kitti_reference as reference
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from samples import CALIBRATION

from lidar_perception.data.kitti.labels import parse_label, to_ground_truth
from lidar_perception.data.kitti.write import project_boxes
from lidar_perception.scoring.detections import FrameDetections
from lidar_perception.scoring.kitti.camera_objects import to_camera_objects
from lidar_perception.scoring.kitti.protocol import DIFFICULTIES, SCORED, Comparison, compute_precision
from lidar_perception.scoring.kitti.report import ROWS, DetectionReport, average_3d
from lidar_perception.types import CLASSES, Detections, GroundTruth, InputError

pytestmark = pytest.mark.no_cover  # covered by other tests

few = settings(max_examples=15, database=None)
seeds = st.integers(0, 2**32 - 1)


def parse_labels(text):
    return to_ground_truth([parse_label(line) for line in text.splitlines()], CALIBRATION.lidar_to_camera)


def make_report(frames, calibration=CALIBRATION):
    """Return the report of frames, pairs of label text and result text."""
    total = DetectionReport()
    for truth, found in frames:
        total.update(FrameDetections("frame", parse_labels(truth), parse_labels(found), calibration))
    return total


def compute_ap(frames):
    return make_report(frames).compute()["ap"]


def list_numbers(content):
    """Return all numbers in the ap of a report, in order."""
    if isinstance(content, dict):
        return [n for value in content.values() for n in list_numbers(value)]
    return [] if content is None else [content]


# Label of a fully visible car 20 m ahead, 60 pixels high; a result line also has a score.
def format_car(
    kind="Car", left=500, top=150, bottom=210, z=20.0, x=0.0, occluded=0, truncated=0.0, alpha=0.0, score=None, y=1.6
):
    line = f"{kind} {truncated} {occluded} {alpha} {left} {top} {left + 100} {bottom} 1.5 1.6 3.9 {x} {y} {z} 0.3"
    return line if score is None else f"{line} {score}"


REGION = "DontCare -1 -1 -10 {} 100 {} 250 -1 -1 -1 -1000 -1000 -1000 -10"
WRONG = dict(left=900, z=40.0, x=10.0)  # far away in the image and in 3D


def join_lines(*lines):
    return "\n".join(lines)


@pytest.mark.parametrize("seed, count, noise", [(0, 30, 0.12), (1, 60, 0.05), (2, 12, 0.1), (3, 20, 0.3), (4, 2, 0.1)])
def test_scores_equal_those_of_an_independent_implementation(seed, count, noise):
    rng = np.random.default_rng(seed)
    frames = [reference.random_frame(rng, noise=noise) for _ in range(count)]
    compared = Comparison.concatenate(make_report(frames).frames)
    few_objects = 0
    for metric, overlaps in ROWS.values():
        prepared = reference.prepare(frames, metric)
        for name in SCORED:
            for level in DIFFICULTIES:
                found = compute_precision(compared, name, metric, overlaps[name], level)
                expected = reference.evaluate(prepared, name, level, overlaps[name], metric)
                if expected is None:
                    assert found is None
                    continue
                assert dataclasses.astuple(found) == pytest.approx(expected, abs=1e-9)
                few_objects += found.objects <= 40 and found.r40 > 0
    assert few_objects


def test_average_precision_of_four_objects_is_exact():
    # Scores: 0.9 right, 0.8 wrong, 0.7 right, 0.6 wrong, 0.5 right; the fourth car is missed.
    # Recall 1/4, 2/4, 3/4 at precision 1, 2/3, 3/5.
    truth = join_lines(*(format_car(left=120 * i, x=6.0 * i) for i in range(4)))
    found = join_lines(
        format_car(score=0.9, left=0),
        format_car(score=0.8, **WRONG),
        format_car(score=0.7, left=120, x=6.0, alpha=np.pi / 2),
        format_car(score=0.6, left=900, z=50.0, x=20.0),
        format_car(score=0.5, left=240, x=12.0),
    )
    row = compute_ap([(truth, found)])["Car"]["3d"]["easy"]
    assert row["objects"] == 4
    # 40 points: 10 up to 1/4, 10 up to 2/4, 10 up to 3/4, 10 beyond.
    assert row["r40"] == pytest.approx(100 * (10 * 1 + 10 * 2 / 3 + 10 * 3 / 5) / 40)
    # 11 points: 0 .1 .2; .3 .4 .5; .6 .7; .8 .9 1.
    assert row["r11"] == pytest.approx(100 * (3 * 1 + 3 * 2 / 3 + 2 * 3 / 5) / 11)
    # The second hit is rotated by 90 degrees: similarities 1, 1 + 1/2, 2 + 1/2 of 1, 3, 5.
    aos = compute_ap([(truth, found)])["Car"]["aos"]["easy"]
    assert aos["r40"] == pytest.approx(100 * (10 * 1 + 10 * 1.5 / 3 + 10 * 2.5 / 5) / 40)


def test_average_precision_equals_hand_computed_value():
    # 50 hits, 50 false positives, 50 hits: precision is 1 up to recall 1/2. At recall 1 it is 100 / 150, the
    # maximum beyond 1/2.
    frames = [
        (format_car(), join_lines(format_car(score=0.9 - i * 1e-3), format_car(score=0.5 + i * 1e-4, **WRONG)))
        for i in range(50)
    ]
    frames += [(format_car(), format_car(score=0.4 - i * 1e-3)) for i in range(50)]
    row = compute_ap(frames)["Car"]["bev"]["moderate"]
    assert row["r40"] == pytest.approx(100 * (20 * 1 + 20 * 2 / 3) / 40)
    assert row["r11"] == pytest.approx(100 * (6 * 1 + 5 * 2 / 3) / 11)


# A car detected with 0.9 and another detection with 0.95: AP is 100 if the latter is ignored, otherwise 50,
# because the only precision is 1 / 2. By metric and difficulty.
@pytest.mark.parametrize(
    "case, other_truth, other_found, level, image, space",
    [
        ("nothing there", None, format_car(**WRONG, score=0.95), "easy", 50, 50),
        ("a van", format_car("Van", **WRONG), format_car(**WRONG, score=0.95), "easy", 100, 100),
        ("a truck", format_car("Truck", **WRONG), format_car(**WRONG, score=0.95), "easy", 50, 50),
        ("someone sitting", format_car("Person_sitting", **WRONG), format_car(**WRONG, score=0.95), "easy", 50, 50),
        ("a region", REGION.format(880, 1010), format_car(**WRONG, score=0.95), "easy", 100, 50),
        ("half a region", REGION.format(880, 950), format_car(**WRONG, score=0.95), "easy", 50, 50),
        ("hidden, easy", format_car(occluded=1, **WRONG), format_car(**WRONG, score=0.95), "easy", 100, 100),
        ("hidden, not told", format_car(occluded=3, **WRONG), format_car(**WRONG, score=0.95), "hard", 100, 100),
        ("cut off", format_car(truncated=0.16, **WRONG), format_car(**WRONG, score=0.95), "easy", 100, 100),
        ("cut off more", format_car(truncated=0.51, **WRONG), format_car(**WRONG, score=0.95), "hard", 100, 100),
        ("39 pixels, easy", None, format_car(**WRONG, bottom=189, score=0.95), "easy", 100, 100),
        ("39 pixels, moderate", None, format_car(**WRONG, bottom=189, score=0.95), "moderate", 50, 50),
        ("24 pixels", None, format_car(**WRONG, bottom=174, score=0.95), "hard", 100, 100),
        ("25 pixels", None, format_car(**WRONG, bottom=175, score=0.95), "hard", 50, 50),
        ("another class", None, format_car("Pedestrian", **WRONG, score=0.95), "easy", 100, 100),
        # A detection of less than 25 pixels is ignored, but it is matched with the car.
        ("24 pixels, another class", None, format_car("Pedestrian", bottom=174, score=0.95), "hard", 100, 0),
        # The higher score is the only threshold, and it has no false positives.
        ("found twice", None, format_car(score=0.95), "easy", 100, 100),
    ],
)
def test_false_positives_follow_the_kitti_rules(case, other_truth, other_found, level, image, space):
    truth = join_lines(format_car(), *([other_truth] if other_truth else []))
    rows = compute_ap([(truth, join_lines(format_car(score=0.9), other_found))])["Car"]
    assert rows["3d"][level]["objects"] == 1
    found = [rows[metric][level]["r40"] for metric in ("image", "bev", "3d")]
    assert found == [image, space, space]


@pytest.mark.parametrize(
    "change, counted",
    [
        ({}, (1, 1, 1)),
        (dict(occluded=1), (0, 1, 1)),
        (dict(occluded=2), (0, 0, 1)),
        (dict(occluded=3), (0, 0, 0)),
        (dict(truncated=0.15), (1, 1, 1)),
        (dict(truncated=0.16), (0, 1, 1)),
        (dict(truncated=0.3), (0, 1, 1)),
        (dict(truncated=0.31), (0, 0, 1)),
        (dict(truncated=0.5), (0, 0, 1)),
        (dict(truncated=0.51), (0, 0, 0)),
        (dict(bottom=190), (1, 1, 1)),
        (dict(bottom=189.9), (0, 1, 1)),
        (dict(bottom=175), (0, 1, 1)),
        (dict(bottom=174.9), (0, 0, 0)),
        (dict(kind="Van"), (0, 0, 0)),
        (dict(kind="Truck"), (0, 0, 0)),
    ],
)
def test_required_objects_follow_the_kitti_rules(change, counted):
    rows = compute_ap([(format_car(**change), "")])["Car"]["3d"]
    assert tuple(rows[level]["objects"] if rows[level] else 0 for level in DIFFICULTIES) == counted


def test_truncation_level_of_tracks_is_not_a_fraction():
    inside = np.array([20.0, 0, -0.9, 3.9, 1.6, 1.5, 0.2])
    across = np.array([7.0, 6.3, -0.9, 3.9, 1.6, 1.5, 0.2])
    share = project_boxes(across[None], CALIBRATION)[1][0]
    assert 0.3 < share < 0.95
    extras = [
        {"track_id": 1, "truncated": 0.0},
        {"track_id": 2, "truncated": 1.0},
        {"track_id": 3, "truncated": 0.0},
        {"track_id": 4, "truncated": 2.0},
        {"truncated": 0.21},
        {},
    ]
    boxes = [inside, inside, across, inside, across, across]
    truth = GroundTruth.of(boxes, [0] * 6, extras)
    objects = to_camera_objects(truth, CALIBRATION)
    assert objects.truncated == pytest.approx([0, 0, share, 1, 0.21, share])


def test_missing_label_fields_are_computed_from_the_box():
    text = "\n".join(format_car(left=100 * i, x=i - 3.0, z=15.0 + i, alpha=-10) for i in range(6))
    labels, bare = parse_labels(text), parse_labels(text)
    bare = GroundTruth.of(bare.boxes, bare.class_ids)
    labels, bare = to_camera_objects(labels, CALIBRATION), to_camera_objects(bare, CALIBRATION)
    np.testing.assert_allclose(bare.boxes[:, :6], labels.boxes[:, :6], atol=1e-6)
    np.testing.assert_allclose(np.cos(bare.boxes[:, 6] - labels.boxes[:, 6]), 1, atol=1e-6)
    x, z = np.arange(6) - 3.0, 15.0 + np.arange(6)
    np.testing.assert_allclose(labels.alpha, 0.3 - np.arctan2(x, z), atol=1e-9)
    np.testing.assert_allclose(bare.alpha, labels.alpha, atol=1e-3)  # the camera is tilted
    np.testing.assert_allclose(bare.image_boxes, project_boxes(parse_labels(text).boxes, CALIBRATION)[0], atol=1e-9)


@few
@given(seeds)
def test_labels_as_detections_score_100(seed):
    rng = np.random.default_rng(seed)
    # Objects are far apart; overlapping labels could match the detection of their neighbour.
    truths = [
        parse_labels(
            join_lines(
                *(
                    reference.line(reference.with_pixels({**reference.some_object(rng), "x": 8.0 * k - 8, "z": 20.0}))
                    for k in range(3)
                )
            )
        )
        for _ in range(rng.integers(1, 40))
    ]
    total = DetectionReport()
    for truth in truths:
        scores = rng.uniform(0, 1, len(truth))
        found = GroundTruth.of(truth.boxes, truth.class_ids, [{**e, "score": s} for e, s in zip(truth.extras, scores)])
        total.update(FrameDetections("frame", truth, found, CALIBRATION))
    content = total.compute()
    for name in SCORED:
        for row in ("image", "aos", "bev", "3d", "bev_relaxed", "3d_relaxed"):
            for level in DIFFICULTIES:
                if cell := content["ap"][name][row][level]:
                    assert (cell["r11"], cell["r40"]) == pytest.approx((100, 100))
    assert content["diagnosis"] == []


@few
@given(seeds)
def test_order_of_detections_does_not_matter(seed):
    rng = np.random.default_rng(seed)
    frames, shuffled = [], []
    for _ in range(20):
        truth, found = reference.random_frame(rng)
        lines = [
            f"{line.rsplit(' ', 1)[0]} {rng.integers(1, 4) / 4}"  # many equal scores
            for line in found.splitlines()
        ]
        frames.append((truth, join_lines(*lines)))
        shuffled.append((truth, join_lines(*rng.permutation(lines))))
    assert make_report(frames).compute() == make_report(shuffled).compute()


@few
@given(seeds)
def test_weaker_false_positive_never_raises_ap(seed):
    rng = np.random.default_rng(seed)
    frames = [reference.random_frame(rng) for _ in range(20)]
    worse = [
        (
            truth,
            join_lines(
                *found.splitlines(),
                *(
                    format_car(name, left=2000 + 200 * i, x=300.0, score=-rng.uniform())
                    for i, name in enumerate(SCORED)
                ),
            ),
        )
        for truth, found in frames
    ]
    before, after = list_numbers(compute_ap(frames)), list_numbers(compute_ap(worse))
    assert len(before) == len(after)
    assert all(a <= b for a, b in zip(after, before))


def test_report_is_independent_of_batches_and_empty_frames():
    rng = np.random.default_rng(5)
    frames = [reference.random_frame(rng) for _ in range(30)]
    there, back = (list_numbers(compute_ap(f)) for f in (frames, [*frames[10:], ("", ""), *frames[:10]]))
    assert there == pytest.approx(back, abs=1e-9)


def test_scores_without_objects_or_frames_are_missing():
    content = make_report([]).compute()
    assert content["frames"] == 0 and content["ap"] == {} and content["map_3d"] is None
    content = make_report([("", format_car(score=0.5))]).compute()
    assert average_3d(content["ap"]) is None and content["ap"]["Car"]["3d"]["easy"] is None
    json.dumps(content, allow_nan=False)


def test_detection_without_angle_has_no_orientation_score():
    flat = "Car -1 -1 -10 500 150 600 210 -1 -1 -1 -1000 -1000 -1000 -10 0.9"  # a 2D detector
    rows = compute_ap([(format_car(), flat)])["Car"]
    assert rows["image"]["easy"]["r40"] == 100 and rows["aos"]["easy"] is None
    assert rows["3d"]["easy"]["r40"] == 0
    json.dumps(rows, allow_nan=False)


def test_detections_outside_the_image_do_not_count():
    truth = parse_labels(format_car())
    ahead, behind, beside = np.repeat(truth.boxes, 3, axis=0)
    behind[0], beside[1] = -20, 300
    found = Detections.of([ahead, behind, beside], CLASSES.index("Car"), [0.5, 0.9, 0.8])
    for boxes, expected in ((found, 100), (found[1:], 0)):
        total = DetectionReport()
        total.update(FrameDetections("frame", truth, boxes, CALIBRATION))
        assert total.compute()["ap"]["Car"]["bev"]["hard"]["r40"] == expected
    total = DetectionReport()
    total.update(FrameDetections("frame", truth, found))  # without a camera, objects all around count
    rows = total.compute()["ap"]["Car"]
    assert rows["bev"]["hard"]["r40"] == pytest.approx(100 / 3) and "image" not in rows


@pytest.mark.parametrize("broken", [dict(boxes=[[np.nan] * 7]), dict(scores=np.inf)])
def test_error_about_non_finite_number_names_the_frame(broken):
    found = Detections.of(**{"boxes": parse_labels(format_car()).boxes, "class_ids": 0, "scores": 1, **broken})
    with pytest.raises(InputError, match=r"^000123: .*box 1 of 1 .*not finite"):
        DetectionReport().update(FrameDetections("000123", parse_labels(format_car()), found, CALIBRATION))


@pytest.mark.parametrize(
    "shift, taller, words",
    [
        (0.62, 0, "0.62 m too high (median); check the sensor height"),
        (-0.62, 0, "0.62 m too low (median); check the sensor"),
        (-0.75, 0, "0.75 m too low (median); that is half their height"),
        (0, 0, ""),
        (0.1, 0, ""),
        (0, 4.0, "0.00 m too high or too low, and 4.00 m too tall"),
    ],
)
def test_constant_height_error_is_reported(shift, taller, words):
    total = DetectionReport()
    truth = parse_labels(join_lines(*(format_car(left=100 * i, x=5.0 * i - 10) for i in range(5))))
    found = Detections.of(truth.boxes + [0, 0, shift, 0, 0, taller, 0], 0, np.arange(5) / 5)
    for _ in range(10):
        total.update(FrameDetections("frame", truth, found, CALIBRATION))
    content = total.compute()
    assert content["matched"]["Car"]["pairs"] == 50
    assert content["matched"]["Car"]["z_error_m"] == pytest.approx(shift, abs=0.01)
    assert content["ap"]["Car"]["bev"]["moderate"]["r40"] > 99
    if words:
        (line,) = content["diagnosis"]
        assert line.startswith("Car: AP is 100.0 in BEV but 0.0 in 3D") and words in line
    else:
        assert content["diagnosis"] == []
