"""The STM-CPA experiment: counts agree with the pipeline and add up."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from samples import DATA, write_crowd_folder

from experiments.framework.experiment import Cell
from experiments.framework.runner import run_experiment
from experiments.stm_cpa import paper
from experiments.stm_cpa.experiment import (
    NUMBERS,
    STM_CPA,
    count_stage,
    extend_cpa,
    measure_frame,
    measure_overlaps,
    search_clustering,
)
from experiments.stm_cpa.frames import load_labelled_frame, make_nearest_seed
from experiments.stm_cpa.params import READINGS
from lidar_perception.candidates.configurations import PAPER
from lidar_perception.candidates.params import StmParams
from lidar_perception.candidates.pipeline import segment_cloud
from lidar_perception.candidates.refine import STAGES, refine_clusters
from lidar_perception.clustering.params import DbscanParams
from lidar_perception.data.frame import Frame
from lidar_perception.data.open import open_recording
from lidar_perception.param_fields import with_values
from lidar_perception.scoring.centres.matching import (
    RANGE_LIMITS,
    RANGE_NAMES,
    count_by_range,
    find_range_bins,
    match_centres,
)
from lidar_perception.scoring.centres.report import CandidateReport, measure_candidates
from lidar_perception.scoring.centres.report import measure_frame as score_frame
from lidar_perception.scoring.centres.tables import PAPER_TABLE_6
from lidar_perception.scoring.run import fill_report
from lidar_perception.types import SENSOR_HEIGHT, GroundTruth, InputError

COUNT = 7
DIGEST = DATA.parent / "papers" / "DIGEST.md"


@pytest.fixture(scope="module")
def kitti(tmp_path_factory):
    return write_crowd_folder(tmp_path_factory.mktemp("kitti"), COUNT)


@pytest.fixture(scope="module")
def records(kitti, tmp_path_factory):
    return run_experiment(STM_CPA, open_recording(kitti), tmp_path_factory.mktemp("run") / "out")


@pytest.fixture(scope="module")
def paper_records(records):
    return [record for record in records if "skipped" not in record]


@pytest.fixture(scope="module")
def refined_frames(kitti):
    """Labelled frame, segments, seed and candidates of each frame with pedestrians."""
    found = []
    for frame in open_recording(kitti).frames[:-1]:
        labelled = load_labelled_frame(frame)
        segmented = segment_cloud(labelled.cloud, labelled.camera, PAPER)
        seed = make_nearest_seed(segmented, labelled)
        found.append((labelled, segmented, seed, refine_frame(segmented, seed, PAPER)))
    return found


def refine_frame(segmented, seed, params):
    return refine_clusters(segmented.xyz, segmented.cluster_ids, segmented.boxes, [seed], params)


def add_up(measured, *keys):
    """Sum record[key1][key2]... over the records."""
    values = measured
    for key in keys:
        values = [value[key] for value in values]
    return np.sum(values, axis=0)


def drop_times(record):
    return {key: value for key, value in record.items() if key != "ms"}


def test_sample_frames_have_hits_and_misses(paper_records):
    for stage in STAGES:
        counts = {k: add_up(paper_records, "stages", stage, k).sum() for k in ("tp", "fp", "fn")}
        assert min(counts.values()) > 0 or (stage == "stage1" and counts["fn"] == 0)
    assert (add_up(paper_records, "pedestrians")[:3] > 0).all()


def test_frames_are_in_order_and_empty_one_is_skipped(kitti, records):
    assert [r["frame"] for r in records] == [frame.name for frame in open_recording(kitti)]
    assert ["skipped" in r for r in records] == [False] * (COUNT - 1) + [True]
    assert "no Pedestrian" in records[-1]["skipped"]


def test_hits_and_misses_add_up_to_labels(kitti, paper_records):
    for frame, record in zip(open_recording(kitti).frames, paper_records):
        truth = load_labelled_frame(frame).pedestrians
        assert record["pedestrians"] == np.bincount(find_range_bins(truth), minlength=5).tolist()
        for counts in (*record["stages"].values(), *record["cpa"]):
            assert np.add(counts["tp"], counts["fn"]).tolist() == record["pedestrians"]
            assert (np.array(counts["kept"]) <= counts["tp"]).all()
        for stage, (hits, *shares, space, bev) in record["overlap"].items():
            assert hits == sum(record["stages"][stage]["tp"])
            assert hits >= shares[0] >= shares[1] and hits >= shares[2] >= shares[3]
            assert shares[0] <= shares[2] and 0 < space <= bev <= hits
        for tp, _ in record["search"]:
            assert (np.array(tp) <= record["pedestrians"]).all()


def test_stages_agree_with_evaluate_candidates(kitti, paper_records):
    report = CandidateReport()
    fill_report(report, open_recording(kitti), partial(measure_candidates, PAPER))
    assert report.frames == len(paper_records)
    for stage, score in report.scores.items():
        for key in ("tp", "fp", "fn"):
            assert add_up(paper_records, "stages", stage, key).tolist() == getattr(score, key).tolist()
        np.testing.assert_allclose(add_up(paper_records, "stages", stage, "error"), score.error, atol=1e-4)


def lower_the_sensor(frame, height):
    """Return the frame as seen by a sensor at another height, metres."""
    up = np.array([0, 0, SENSOR_HEIGHT - height], np.float32)
    scan, truth, calibration = frame.load(), frame.truth(), frame.calibration()
    lower = np.eye(4)
    lower[2, 3] = -up[2]
    return Frame.of(
        frame.name,
        replace(scan, xyz=scan.xyz + up),
        GroundTruth.of(truth.boxes + [*up[[0, 0, 2]], 0, 0, 0, 0], truth.class_ids, truth.extras),
        replace(calibration, lidar_to_camera=calibration.lidar_to_camera @ lower),
        sensor_height=height,
    )


def test_low_sensor_agrees_with_evaluate_candidates(kitti):
    frames = [lower_the_sensor(frame, 0.7) for frame in open_recording(kitti).frames[:2]]
    params, report = with_values(PAPER, {"ground.sensor_pose.height": 0.7}), CandidateReport()
    for frame in frames:
        report.update(score_frame(frame, params))
    records = [measure_frame(frames, i) for i in range(len(frames))]
    assert report.scores["stage1"].tp.sum() > 3
    for stage, score in report.scores.items():
        for key in ("tp", "fp", "fn"):
            assert add_up(records, "stages", stage, key).tolist() == getattr(score, key).tolist()


def test_zero_cpa_steps_equal_stage_2(paper_records):
    for record in paper_records:
        assert record["cpa"][0] == record["stages"]["stage2"]
        assert len(record["cpa"]) == NUMBERS.cpa_steps + 1
    for k in range(1, NUMBERS.cpa_steps + 1):
        assert add_up(paper_records, "cpa", k, "tp")[0] == add_up(paper_records, "cpa", 0, "tp")[0]
    without, much = (add_up(paper_records, "cpa", k, "tp") for k in (0, NUMBERS.cpa_steps))
    assert much[2] > without[2]  # includes pedestrians beyond the 30 m of the final stage


def test_two_cpa_steps_equal_final_stage_at_15_to_30_m(refined_frames):
    compared = 0
    for _, segmented, seed, found in refined_frames:
        sweep = refine_frame(segmented, seed, extend_cpa(2)).final.boxes
        inside = [boxes[find_range_bins(boxes) == 1] for boxes in (sweep, found.final.boxes)]
        np.testing.assert_array_equal(*inside)
        compared += len(inside[0])
    assert compared > 3


def test_readings_and_detector_count_the_same_pedestrians(paper_records):
    for record in paper_records:
        assert record["readings"]["window stretched, yaw"] == record["stages"]["final"]
        for counts in (*record["readings"].values(), record["pointpillars"]):
            assert np.add(counts["tp"], counts["fn"]).tolist() == record["pedestrians"]
    totals = [add_up(paper_records, "readings", name, "fp").sum() for name in READINGS]
    assert len(set(totals)) > 1  # the readings differ
    tables = {t.name: t for s in STM_CPA.make_sections(paper_records) for t in s.tables}
    assert [row[0] for row in tables["readings"].rows] == [*READINGS]
    ours = next(row for row in tables["table_7"].rows if row[0] == "PointPillars V0, ours")
    tp, fp, fn = (add_up(paper_records, "pointpillars", k).sum() for k in ("tp", "fp", "fn"))
    assert ours[-3:] == (str(tp), str(fp), str(fn)) and ours[3].paper == 52.0


def test_search_at_paper_setting_equals_stage_1(refined_frames, paper_records):
    """Only ranges without objects near their limits are compared, because clusters are split at range limits."""
    compared = 0
    for (labelled, _, _, found), record in zip(refined_frames, paper_records):
        boxes, truth = found.stage1.boxes, labelled.pedestrians
        pairs = match_centres(boxes, truth, NUMBERS.search_distance)
        tp, fp, *_ = count_by_range(boxes, truth, pairs)
        away = np.hypot(*np.concatenate([boxes, truth])[:, :2].T)
        for i, name in enumerate(RANGE_NAMES[:3]):
            limits = RANGE_LIMITS[max(i - 1, 0) : i + 1]
            if (np.abs(away[:, None] - limits) < 1.0).any():
                continue
            eps = NUMBERS.search_eps.index(DbscanParams().eps[i])
            setting = eps * len(NUMBERS.search_min_samples) + NUMBERS.search_min_samples.index(
                DbscanParams().min_samples
            )
            assert [counts[i] for counts in record["search"][setting]] == [tp[i], fp[i]], name
            compared += tp[i]
    assert compared >= 4


@pytest.mark.parametrize("moved, hits", [(0.3, True), (0.7, False)])
def test_search_counts_only_closer_hits(refined_frames, moved, hits):
    labelled, segmented, seed, _ = refined_frames[0]
    counts = search_clustering(segmented, seed, labelled.pedestrians + [0, 0, moved, 0, 0, 0, 0])
    assert (np.sum(counts, axis=(0, 2))[0] > 0) == hits


def test_kept_counts_pedestrians_found_in_both_stages():
    truth = np.zeros((3, 7))
    truth[:, 0], truth[:, 3:6] = [5, 20, 40], 1
    counts = count_stage(truth[[1, 2]], truth, truth[[0, 1]])
    assert counts["tp"] == [0, 1, 1, 0, 0] and counts["kept"] == [0, 1, 0, 0, 0]
    assert counts["fn"] == [1, 0, 0, 0, 0] and counts["fp"] == [0] * 5


def test_overlaps_of_boxes_equal_hand_computed_values():
    truth = np.array([[5, 0, 0, 1, 1, 2, 0], [20, 0, 0, 1, 1, 2, np.pi / 2.0]])
    half = truth + [0, 0, 0.5, 0, 0, -1, 0]  # upper halves of the boxes
    hits, *shares, space, bev = measure_overlaps(half, truth)
    assert (hits, shares) == (2, [2, 2, 2, 2]) and bev == pytest.approx(2, abs=1e-5)
    assert space == pytest.approx(1.0, abs=1e-5)
    assert measure_overlaps(truth[:0], truth) == [0, 0, 0, 0, 0, 0, 0]
    low = truth + [0, 0, -0.8, 0, 0, -1.6, 0]  # lowest fifth of each box
    assert measure_overlaps(low, truth)[1:5] == [2, 0, 2, 2]
    away = truth + [0.8, 0, 0, 0, 0, 0, 0]  # overlap of one ninth
    hits, *shares, _, _ = measure_overlaps(away, truth)
    assert (hits, shares) == (2, [2, 0, 2, 0])


@pytest.mark.parametrize(
    "change, words",
    [
        (
            lambda label: re.sub(r"(Pedestrian .*) \S+ \S+ \S+ (\S+)$", r"\1 4.00 -1.00 9.00 \2", label, flags=re.M),
            "has only 0 points",
        ),
        (
            lambda label: label + "Car 0.00 0 0.00 0.00 0.00 0.00 0.00 9.00 90.00 90.00 0.00 3.00 20.00 0.00\n",
            "is inside a labelled Car",
        ),
    ],
)
def test_frame_with_a_bad_seed_has_misses_and_a_reason(kitti, tmp_path, change, words):
    shutil.copytree(kitti, tmp_path / "kitti")
    label = tmp_path / "kitti/training/label_2/000002.txt"
    label.write_text(change(label.read_text()))
    frames = open_recording(tmp_path / "kitti").frames
    record = measure_frame(frames, 2)
    assert words in record["no_seed"] and record["ms"] is None
    assert sum(record["pedestrians"]) == 4
    for counts in (*record["stages"].values(), *record["cpa"]):
        assert sum(counts["tp"]) == sum(counts["fp"]) == 0
        assert counts["fn"] == record["pedestrians"]
    assert not np.any(record["search"])
    sections = STM_CPA.make_sections([measure_frame(frames, 1), record])
    tables = {t.name: t for s in sections for t in s.tables}
    (row,) = tables["no_seed"].rows
    assert row == ("000002", "4", record["no_seed"])


def test_record_does_not_depend_on_earlier_frames(kitti, paper_records):
    frames = open_recording(kitti).frames
    for number in (3, 1):
        assert drop_times(measure_frame(frames, number)) == drop_times(paper_records[number])


def test_tables_agree_with_records(paper_records):
    tables = {t.name: t for s in STM_CPA.make_sections(paper_records) for t in s.tables}
    for row, stage in zip(tables["table_3_6"].rows, STAGES, strict=True):
        tp, fp, fn = (add_up(paper_records, "stages", stage, k).sum() for k in ("tp", "fp", "fn"))
        _, recall, precision, f1, kept, error, *counts = row
        assert counts == [str(tp), str(fp), str(fn)]
        assert recall.value == pytest.approx(100 * tp / (tp + fn))
        assert precision.value == pytest.approx(100 * tp / (tp + fp))
        assert f1.value == pytest.approx(200 * tp / (2 * tp + fp + fn))
        before = add_up(paper_records, "stages", "stage1", "tp").sum()
        assert kept.value == pytest.approx(100 * add_up(paper_records, "stages", stage, "kept").sum() / before)
        assert error.value == pytest.approx(add_up(paper_records, "stages", stage, "error").sum() / tp)
        assert [c.paper for c in (recall, precision, f1, kept, error)] == [*PAPER_TABLE_6[stage]]
        for cell in (recall, precision, f1):
            assert cell.low <= cell.value <= cell.high
    assert tables["table_5"].rows[0][6:] == tables["table_3_6"].rows[1][6:]
    final = dict(zip(tables["table_9"].header[1:], tables["table_9"].rows[2][1:]))
    steps = [cell.value for name, cell in final.items() if "total" not in name]
    assert final["total [ms]"].value == pytest.approx(sum(steps))
    assert sum(steps) == pytest.approx(
        np.mean([sum(r["ms"].values()) - r["ms"]["stm_all"] - r["ms"]["confidence"] for r in paper_records])
    )
    assert len(tables["table_5"].rows) == 9 and len(tables["table_4"].rows) == 15


def test_tables_without_records_are_empty():
    for section in STM_CPA.make_sections([{"frame": "a", "skipped": "b"}]):
        for table in section.tables:
            assert all(len(row) == len(table.header) for row in table.rows)
            assert not any(cell.value for row in table.rows for cell in row if isinstance(cell, Cell))


def test_protocol_equals_table_2_of_the_paper():
    assert PAPER.clustering.dbscan == DbscanParams((15, 30), (0.15, 0.30, 0.50), 10)
    assert PAPER.stm == StmParams(0.40) and PAPER.height.tolerance == 0.2
    assert (PAPER.cpa.min_range, PAPER.cpa.max_range, PAPER.cpa.steps) == (15, 30, 2)
    assert (PAPER.cpa.decrement, PAPER.cpa.min_scale) == (0.10, 0.20)
    assert PAPER.view.enabled and PAPER.seed.source == "ground_truth"


def test_published_tables_are_consistent():
    assert sum(paper.TABLE_1.values()) == paper.PEDESTRIANS
    assert paper.TABLE_5[0] == PAPER_TABLE_6["stage2"]
    for row in paper.TABLE_9.values():
        assert row[-1] == pytest.approx(sum(row[:-1]), abs=2e-3)
    rows = [
        *PAPER_TABLE_6.values(),
        *paper.TABLE_5,
        *(row for stages in paper.TABLE_4.values() for row in stages.values()),
    ]
    for recall, precision, f1, *_ in rows:
        if recall:
            assert f1 == pytest.approx(2 * recall * precision / (recall + precision), abs=0.15)
    for name, points in paper.FIGURE_8.items():
        assert points[0] == paper.TABLE_4[name]["stage2"][:3]
    stage_1 = [paper.TABLE_4[name]["stage1"][0] * n for name, n in paper.TABLE_1.items()]
    assert sum(stage_1) / paper.PEDESTRIANS == pytest.approx(PAPER_TABLE_6["stage1"][0], abs=0.1)


@pytest.mark.skipif(not DIGEST.is_file(), reason="the papers are not beside the checkout")
def test_published_tables_match_the_digest():
    text = DIGEST.read_text().partition("## B.")[0]
    cells = {
        line.split("|")[1].strip().partition(":")[0]: line.split("|")[2]
        for line in text.splitlines()
        if line.startswith("| ")
    }

    def rows(table):
        """Return the numbers of each part between semicolons, without names before colons."""
        return [
            [float(x) for x in re.findall(r"\d*\.\d+|\b\d+\b", part.rpartition(":")[2])]
            for part in cells[table].split(";")
        ]

    def drop_none(row):
        return [value for value in row if value is not None]

    assert rows("3 / 6") == [drop_none(row) for row in PAPER_TABLE_6.values()]
    assert rows("5") == [list(row[:3]) for row in paper.TABLE_5]
    assert rows("8") == [list(row) for row in paper.TABLE_8.values()]
    for ours, theirs in zip(paper.TABLE_9.values(), rows("9"), strict=True):
        assert list(ours) == pytest.approx(theirs, abs=0.051)  # the digest is rounded
    for name, *stages in re.findall(r"([\d-]+): ([\d. ]+), ([\d. ]+)", cells["4"]):
        for stage, part in zip(("stage1", "stage2"), stages, strict=True):
            recall, precision, f1, *_ = paper.TABLE_4[name][stage]
            assert [f1, precision, recall] == [float(x) for x in part.strip(" .").split()]
    assert " / ".join(map(str, paper.TABLE_1.values())) in text
    assert f"{paper.FRAMES} frames, {paper.PEDESTRIANS} instances" in text


def test_real_frames_have_record_or_reason(data):
    frames = open_recording(data / "kitti_object").frames
    names = [frame.name for frame in frames]
    for number in [names.index("000134"), names.index("000000"), 1]:
        labels = frames[number].points.parents[1] / f"label_2/{names[number]}.txt"
        there = [line for line in labels.read_text().splitlines() if line.startswith("Pedestrian ")]
        if not there:
            with pytest.raises(InputError, match="no Pedestrian"):
                measure_frame(frames, number)
            continue
        record = measure_frame(frames, number)
        assert sum(record["pedestrians"]) == len(there)
        assert (
            record["clusters"][0]
            >= record["clusters"][1]
            == sum(record["stages"]["stage1"]["tp"] + record["stages"]["stage1"]["fp"])
        )
