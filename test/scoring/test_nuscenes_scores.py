"""nuScenes' detection task: hand-computed cases, an independent implementation, and nuscenes-
devkit."""

from __future__ import annotations

import copy
import itertools
import json
import math

import numpy as np
import nuscenes_folder as folder
import nuscenes_reference as reference
import pytest

from lidar_perception.data.nuscenes.boxes import CATEGORIES, NAMES, GlobalBoxes
from lidar_perception.data.nuscenes.folder import open_nuscenes
from lidar_perception.data.nuscenes.results import META, read_results
from lidar_perception.scoring.nuscenes.protocol import (
    RANGES,
    compute_errors,
    score_class,
    select_scored_boxes,
    summarize,
)
from lidar_perception.scoring.nuscenes.report import DETECTED_NAMES, NuscenesReport, select_boxes
from lidar_perception.types import InputError

TABLES = folder.make_tables(seed=2, frames=4, objects=60)
ERRORS = dict(zip(("ate", "ase", "aoe", "ave", "aae"), reference.ERRORS))


def make_boxes(*centres, kind="car", scores=0.0, yaw=0.0, **columns):
    """Return boxes of 4 x 2 x 1.5 m at (x, y)."""
    count = len(centres)
    return GlobalBoxes.of(
        [[*c, 0.0] for c in centres],
        [[4, 2, 1.5]] * count,
        [[math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)]] * count,
        NAMES.index(kind),
        scores=scores,
        **columns,
    )


def compute_class_scores(truth, found, kind="car", true_frames=None, found_frames=None):
    def numbers(frames, of):
        return np.zeros(len(of), int) if frames is None else np.array(frames)

    return score_class(kind, truth, numbers(true_frames, truth), found, numbers(found_frames, found))


ROW = [(10.0 * i, 0.0) for i in range(20)]


def test_perfect_detections_score_1():
    s = compute_class_scores(
        make_boxes(*ROW, velocities=1.0, attributes=6),
        make_boxes(*ROW, scores=np.linspace(1, 0.1, 20), velocities=1.0, attributes=6),
    )
    assert s.objects == s.detections == 20 and s.mean_ap == pytest.approx(1)
    assert s.errors == dict.fromkeys(ERRORS, 0.0)
    assert summarize({"car": s})["nds"] == pytest.approx(1)


def test_max_nds_without_velocity_and_attributes_is_0_8():
    s = compute_class_scores(make_boxes(*ROW, velocities=1.0, attributes=6), make_boxes(*ROW, scores=0.5))
    assert (s.errors["ave"], s.errors["aae"]) == (1, 1)
    assert summarize({"car": s})["nds"] == pytest.approx(0.8)


def test_one_of_four_objects_gives_recall_0_25():
    """The first 15 of the 90 recalls above 0.1 are reached, with precision 1."""
    s = compute_class_scores(make_boxes(*ROW[:4]), make_boxes((10.3, 0.4), scores=0.7))
    assert s.ap == pytest.approx({0.5: 0, 1.0: 15 / 90, 2.0: 15 / 90, 4.0: 15 / 90})
    assert s.errors["ate"] == pytest.approx(0.5)


def test_ap_ignores_recall_up_to_0_1():
    s = compute_class_scores(make_boxes(*ROW), make_boxes(ROW[0], ROW[1], scores=[0.9, 0.8]))
    assert s.mean_ap == 0 and set(s.errors.values()) == {1.0}


def test_false_positive_of_higher_score_lowers_precision():
    """Precision is interpolated between (recall 0, 0) and (1, 0.5), so it is r / 2. Above recall 0.1 its mean is
    16.2 / 90, of at most 0.9."""
    s = compute_class_scores(make_boxes((0, 0)), make_boxes((30, 0), (0, 0), scores=[0.9, 0.8]))
    assert s.mean_ap == pytest.approx(0.2)


def test_hit_must_be_closer_than_the_distance():
    s = compute_class_scores(make_boxes(*ROW), make_boxes(*[(x, 1.0) for x, _ in ROW], scores=0.5))
    assert s.ap == pytest.approx({0.5: 0, 1.0: 0, 2.0: 1, 4.0: 1})


def test_object_is_matched_once_to_the_better_score():
    """The second detection is a false positive, so precision at recall 1 is 0.5."""
    truth = make_boxes((0, 0))
    for first, other in ((0.2, 0.0), (0.0, 0.2)):
        s = compute_class_scores(truth, make_boxes((first, 0), (other, 0), scores=[0.9, 0.8]))
        assert s.mean_ap == pytest.approx((89 + 0.4 / 0.9) / 90)
        assert s.errors["ate"] == pytest.approx(first)


def test_detection_matches_the_nearest_unmatched_object():
    """The first detection matches the nearer object; the other matches the farther one, or is a false
    positive."""
    s = compute_class_scores(make_boxes((0, 0), (3, 0)), make_boxes((0.1, 0), (0.5, 0), scores=[0.9, 0.8]))
    assert s.ap == pytest.approx({**dict.fromkeys((0.5, 1.0, 2.0), (39 + 0.4 / 0.9) / 90), 4.0: 1})


def test_no_detections_or_labels_give_ap_0_and_errors_1():
    for truth, found in (
        (make_boxes((0, 0)), make_boxes()),
        (make_boxes(), make_boxes((0, 0), scores=1.0)),
        (make_boxes(), make_boxes()),
    ):
        s = compute_class_scores(truth, found)
        assert s.mean_ap == 0 and set(s.errors.values()) == {1.0}
    cone = compute_class_scores(make_boxes(), make_boxes(), "traffic_cone")
    assert [k for k, v in cone.errors.items() if math.isnan(v)] == ["aoe", "ave", "aae"]


def test_errors_of_a_match_equal_hand_computed_values():
    truth = make_boxes((0, 0), velocities=[3.0, 0.0], attributes=5)
    found = make_boxes((0.3, 0.4), yaw=math.pi - 0.1, velocities=[0.0, 4.0], attributes=6)
    larger = GlobalBoxes.of(found.centres, 2 * found.sizes, found.rotations, found.class_ids)
    e = compute_errors(truth, found, False)
    assert {k: v[0] for k, v in e.items()} == pytest.approx(dict(ate=0.5, ase=0, aoe=math.pi - 0.1, ave=5, aae=1))
    assert compute_errors(truth, found, True)["aoe"] == pytest.approx(0.1)
    assert compute_errors(truth, larger, False)["ase"] == pytest.approx(7 / 8)
    for true, other in ((make_boxes((0, 0)), found), (truth, make_boxes((0, 0)))):
        assert np.isnan(compute_errors(true, other, False)["ave"])
    assert np.isnan(compute_errors(make_boxes((0, 0)), found, False)["aae"])


def test_error_is_averaged_over_recall_levels():
    """Two objects have errors 0 and 1, in order of score. The error is 0 at recalls 0.11 to 0.5 and rises in 50
    steps to the mean of both, 0.5, at recall 1."""
    s = compute_class_scores(make_boxes((0, 0), (20, 0)), make_boxes((0, 0), (21, 0), scores=[0.9, 0.8]))
    assert s.errors["ate"] == pytest.approx(sum(0.01 * k for k in range(1, 51)) / 90)


@pytest.mark.parametrize("kind", NAMES)
def test_objects_beyond_the_range_of_their_class_do_not_count(kind):
    there = np.array([100.0, 50.0])
    away = RANGES[kind]
    is_selected = select_scored_boxes(
        make_boxes(*(there + [away * s, 0] for s in (0.999, 1, -0.999, 1.2)), kind=kind),
        np.array([100, 50, 7]),
        make_boxes(),
    )
    assert is_selected.tolist() == [True, False, True, False]
    assert (RANGES["car"], RANGES["pedestrian"], RANGES["barrier"]) == (50, 40, 30)


def test_empty_labels_and_bicycles_in_racks_do_not_count():
    rack = make_boxes((0, 0), yaw=math.pi / 2)  # 2 m along x, 4 m along y
    for kind, inside in ("bicycle", False), ("motorcycle", False), ("pedestrian", True):
        is_selected = select_scored_boxes(make_boxes((0.9, 1.9), (1.9, 0.9), kind=kind), np.zeros(3), rack)
        assert is_selected.tolist() == [inside, True]
    assert select_scored_boxes(
        make_boxes((0, 0), (1, 0), (2, 0), points=[0, 3, -1]), np.zeros(3), make_boxes()
    ).tolist() == [False, True, True]
    none = GlobalBoxes.of(np.zeros((1, 3)), np.ones((1, 3)), [[1, 0, 0, 0]], -1)
    assert not select_scored_boxes(none, np.zeros(3), make_boxes()).any()


def compute_report(root, results):
    path = root / "results.json"
    path.write_text(json.dumps({"meta": META, "results": results}))
    frames, report = open_nuscenes(root), NuscenesReport()
    boxes = read_results(path, frames)
    for frame in frames:
        report.update(select_boxes(frame, boxes[frame.name]))
    return report.compute()


def assert_close_to_reference(content, by_class, over):
    for name, (objects, ap, errors) in by_class.items():
        row = content["classes"][name]
        assert row["objects"] == objects
        assert row["ap"] == pytest.approx({f"{d:g}": 100 * v for d, v in ap.items()}, abs=1e-9)
        for key, kind in ERRORS.items():
            assert (row[key] is None) == (kind not in errors)
            assert row[key] is None or row[key] == pytest.approx(errors[kind], abs=1e-5)
    for key, (mean_ap, errors, nds) in over.items():
        row = content[key]
        assert row["map"] == pytest.approx(100 * mean_ap, abs=1e-9)
        assert row["nds"] == pytest.approx(100 * nds, abs=1e-3)
        assert [row[e] for e in ERRORS] == pytest.approx([errors[k] for k in ERRORS.values()], abs=1e-5)


@pytest.mark.parametrize(
    "seed, frames, objects, noise", [(0, 2, 20, 0.1), (1, 3, 60, 0.4), (2, 5, 150, 0.4), (3, 4, 90, 1.0)]
)
@pytest.mark.no_cover
def test_scores_equal_those_of_an_independent_implementation(tmp_path, seed, frames, objects, noise):
    tables = folder.make_tables(seed, frames, objects)
    results = folder.make_results(tables, CATEGORIES, seed + 10, noise)
    by_class, over = reference.evaluate(tables, results, CATEGORIES)
    content = compute_report(folder.save(tmp_path, tables, sweeps=False), results)
    assert content["frames"] == 2 * frames and 0 < content["all"]["map"] < 100
    assert_close_to_reference(content, by_class, {"all": over, "ours": reference.over(by_class, DETECTED_NAMES)})


@pytest.mark.parametrize("seed, ties", [(4, False), (5, False), (4, True)])
def test_scores_equal_the_nuscenes_devkit(tmp_path, seed, ties):
    module = pytest.importorskip("nuscenes.eval.detection.evaluate", reason="needs nuscenes-devkit")
    from nuscenes import NuScenes
    from nuscenes.eval.common.config import config_factory

    tables = folder.make_tables(seed, 8, 100)
    results = folder.make_results(tables, CATEGORIES, seed)
    for box in itertools.chain(*results.values()) if ties else ():
        box["detection_score"] = round(box["detection_score"], 1)
    content = compute_report(folder.save(tmp_path, tables, sweeps=False), results)
    devkit = module.DetectionEval(
        NuScenes(folder.VERSION, str(tmp_path), verbose=False),
        config_factory("detection_cvpr_2019"),
        str(tmp_path / "results.json"),
        "mini_val",
        str(tmp_path / "out"),
        verbose=False,
    )
    figures = devkit.evaluate()[0].serialize()
    names = dict(zip(ERRORS, ("trans_err", "scale_err", "orient_err", "vel_err", "attr_err")))
    assert content["all"] == pytest.approx(
        {
            "map": 100 * figures["mean_ap"],
            "nds": 100 * figures["nd_score"],
            **{key: figures["tp_errors"][name] for key, name in names.items()},
        },
        abs=1e-9,
    )
    for kind, row in content["classes"].items():
        assert row["ap"] == pytest.approx(
            {f"{d:g}": 100 * ap for d, ap in figures["label_aps"][kind].items()}, abs=1e-9
        )
        assert [math.nan if row[key] is None else row[key] for key in names] == pytest.approx(
            [figures["label_tp_errors"][kind][name] for name in names.values()], abs=1e-9, nan_ok=True
        )


def test_scores_do_not_depend_on_the_global_frame(tmp_path):
    results = folder.make_results(TABLES, CATEGORIES)
    before = compute_report(folder.save(tmp_path / "a", TABLES, sweeps=False), results)
    tables, turn = copy.deepcopy(TABLES), folder.Rotation.from_euler("z", 1.1)
    moved_results = copy.deepcopy(results)
    for row in [*tables["ego_pose"], *tables["sample_annotation"], *itertools.chain(*moved_results.values())]:
        row["rotation"] = folder.to_wxyz(turn * folder.to_rotation(row))
        row["translation"] = (turn.apply(row["translation"]) + [30, -200, 0]).tolist()
        if "velocity" in row:
            row["velocity"] = turn.apply([*row["velocity"], 0])[:2].tolist()
    after = compute_report(folder.save(tmp_path / "b", tables, sweeps=False), moved_results)
    for key in "all", "ours":
        assert after[key] == pytest.approx(before[key], abs=1e-6)


def set_in_first_result(**values):
    def change(results):
        next(rows for rows in results.values() if rows)[0].update(values)

    return change


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda r: r.pop("s0k1"), "no boxes for scene-0103/01, sample s0k1 (missing: 1 of 8 frames)"),
        (lambda r: r.update(s0k0=r["s0k0"] * 100), "at most 500 boxes"),
        (lambda r: r.update(s0k0={}), "is not a list"),
        (lambda r: r["s0k0"][0].pop("size"), "a box has no 'size'"),
        (set_in_first_result(detection_name="van"), "the class 'van' is not one of"),
        (set_in_first_result(attribute_name="red"), "is malformed"),
        (set_in_first_result(size=[1, 2, 0]), "sizes must be positive"),
        (set_in_first_result(rotation=[0, 0, 0, 0]), "a quaternion"),
        (set_in_first_result(translation=[1, 2, math.nan]), "must be finite"),
        (set_in_first_result(size=[1]), "is malformed"),
        (set_in_first_result(velocity=[math.inf, 0]), "velocity finite or NaN"),
        (set_in_first_result(velocity=[0]), "is malformed"),
        (set_in_first_result(detection_score="high"), "is malformed"),
        (set_in_first_result(translation=[10**400, 0, 0]), "is malformed"),
        (set_in_first_result(rotation=[1e308, 0, 0, 0]), "a quaternion"),
    ],
)
def test_invalid_results_are_reported(tmp_path, change, words):
    results = folder.make_results(TABLES, CATEGORIES)
    change(results)
    with pytest.raises(InputError) as caught:
        compute_report(folder.save(tmp_path, TABLES, sweeps=False), results)
    assert words in str(caught.value) and "\n" not in str(caught.value)
