"""The EG-PointPillars experiment: tables from known records, and a tiny complete run."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from experiments.__main__ import cli
from experiments.eg_pointpillars import paper, tables
from experiments.eg_pointpillars.diagonals import count_classes, make_diagonal_section
from experiments.eg_pointpillars.experiment import SHIPPED
from experiments.eg_pointpillars.measure import NO_CLASS, measure_diagonals
from experiments.eg_pointpillars.models import choose_models
from experiments.eg_pointpillars.pictures import count_errors
from experiments.framework.experiment import Cell
from experiments.framework.precision import (
    CELLS,
    compare_records,
    compute_cells,
    from_record,
    resample_cells,
    to_record,
)
from experiments.framework.statistics import compute_sampled_p, estimate
from experiments.framework.trained_models import TrainedModel
from lidar_perception.camera import Calibration
from lidar_perception.detectors.pointpillars import config as config_module
from lidar_perception.scoring.kitti.camera_objects import to_camera_objects, to_scored_labels
from lidar_perception.simulation.camera import FORWARD_CAMERA
from lidar_perception.training.params import PointPillarsTraining
from lidar_perception.types import CLASSES, Detections, GroundTruth, PointCloud

pytestmark = pytest.mark.no_cover
CAR = CLASSES.index("Car")
BOXES = np.array([[10, 2, -0.9, 3.9, 1.6, 1.6, 0.1], [15, -4, -0.9, 4.2, 1.7, 1.5, 0.0]], np.float32)


def make_record(
    boxes: np.ndarray, scores: np.ndarray | None = None, calibration: Calibration | None = FORWARD_CAMERA
) -> dict:
    """Return the record of cars: labels, or detections with scores."""
    ids = np.full(len(boxes), CAR, np.int32)
    objects = (
        GroundTruth.of(boxes, ids)
        if scores is None
        else to_scored_labels(Detections(boxes, ids, scores.astype(np.float32)))
    )
    return json.loads(json.dumps(to_record(to_camera_objects(objects, calibration)), allow_nan=False))


@pytest.mark.parametrize("calibration", [FORWARD_CAMERA, None])
def test_objects_survive_conversion_to_a_record(calibration):
    objects = to_camera_objects(
        to_scored_labels(Detections(BOXES, np.full(2, CAR, np.int32), np.array([0.9, 0.2], np.float32))), calibration
    )
    found = from_record(json.loads(json.dumps(to_record(objects))))
    for name in ("class_ids", "boxes", "image_boxes", "occluded", "scores", "truncated"):
        np.testing.assert_allclose(getattr(found, name), getattr(objects, name), atol=0.01)
    assert len(from_record(make_record(np.zeros((0, 7), np.float32), np.zeros(0)))) == 0


def test_table_cells_equal_scores_of_paired_samples():
    true = [make_record(BOXES)] * 12
    perfect = [make_record(BOXES, np.array([0.9, 0.8]))] * 12
    half = [make_record(BOXES[:1], np.array([0.9]))] * 12
    frames = compare_records(true, perfect)
    cells = compute_cells(frames)
    car = [i for i, (name, _) in enumerate(CELLS) if name == "Car"]
    np.testing.assert_allclose(cells[:, car[1:]], 100)
    assert np.isnan(np.delete(cells[:, :-1], car, axis=1)).all()  # no objects of these classes
    draws = resample_cells([f"{i}" for i in range(12)], {"a": frames, "b": compare_records(true, half)}, replicates=20)
    gain = (draws["a"] - draws["b"])[:, 0, -1]
    assert gain[0] > 30 and compute_sampled_p(gain) == pytest.approx(2 / 21)
    assert compute_sampled_p(np.zeros(21)) == 1.0
    assert np.isnan(compute_sampled_p(gain[:1]))
    value, low, high = estimate(draws["a"])[:, 0, -1]
    assert low == value == high
    errors = [count_errors(compare_records(true, found)[0]) for found in (perfect, half)]
    assert errors == [0, 1]


def make_models() -> dict[str, TrainedModel]:
    return {
        model.name: TrainedModel(model, Path("w"), 10, 60.0, 5, 8, 1000)
        for seed in range(2)
        for model in choose_models(PointPillarsTraining(), seed)
    }


def test_report_has_paper_values_and_every_label_fraction():
    models = make_models()
    boxes = {name: BOXES if name.startswith("V4") else BOXES[:1] for name in models}
    record = {
        "true": make_record(BOXES),
        "boxes": [[CAR, 4.2]],
        "clusters": [[CAR, 3.9], [-1, 1]],
        "ms": {name: {"total": 10.0 + ("V4" in name), "cpu": 9.0, "experts": 1.0, "network": 8.0} for name in models},
        "found": {name: make_record(b, np.linspace(0.9, 0.8, len(b))) for name, b in boxes.items()},
    }
    records = [{"frame": f"{i}", **record} for i in range(3)] + [{"frame": "x", "skipped": "bad"}]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tables, "resample_cells", partial(resample_cells, replicates=4))
        sections = tables.make_sections(records, models)
        tables.make_sections([], models)  # an unfinished run has no records
        some = {name: m for name, m in models.items() if m.model.label_share == 1.0}
        tables.make_sections(records, some)
    assert "long enough" not in sections[1].text
    by_name = {table.name: table for section in sections for table in section.tables}
    assert len(by_name["models"].rows) == 22
    first, *_, last = by_name["table_5"].rows
    mean = len(CELLS) + 1
    assert first[1].paper == 84.0 and first[mean].paper == paper.MAP["v0"]
    assert last[mean + 1].value > 30 and last[mean + 1].paper == 3.88 and last[-1].value < 1
    assert [row[0] for row in by_name["labels"].rows] == ["10 %", "25 %", "50 %", "100 %"]
    assert by_name["labels"].rows[0][3].value > 30
    assert by_name["table_6"].rows[-1][3].value == 1.0  # overhead
    assert by_name["seeds"].rows[0][-1].value == 0.0
    assert all(len(row) == len(table.header) for table in by_name.values() for row in table.rows)


def test_shipped_weights_are_compared_without_label_study():
    models = SHIPPED.measure.keywords["models"]
    assert [*models] == ["V0", "V1", "V2", "V3", "V4"] and all(m.weights.is_file() for m in models.values())
    assert len({m.parameters for m in models.values()}) == 4  # V2 and V3 have the same inputs
    record = {
        "frame": "0",
        "true": make_record(BOXES),
        "boxes": [[CAR, 4.2]],
        "clusters": [],
        "ms": {name: {"total": 10.0, "cpu": 9.0, "experts": 1.0, "network": 8.0} for name in models},
        "found": {name: make_record(BOXES, np.array([0.9, 0.8])) for name in models},
    }
    sections = SHIPPED.make_sections([record])
    names = [table.name for section in sections for table in section.tables]
    assert names == ["table_5", "table_5_bev", "table_6", "table_2_boxes", "table_2_clusters"]
    assert "Car 2, Pedestrian 0, Cyclist 0 labels" in sections[1].text
    assert "too few labels to compare versions by the AP of Car, Pedestrian, Cyclist or by the mean" in sections[1].text


def test_clusters_get_the_class_of_their_label():
    rng = np.random.default_rng(0)
    ground = rng.uniform([2, -10, -1.75], [30, 10, -1.71], (6000, 3))
    car = np.array([10, 2, -0.85]) + rng.uniform(-0.5, 0.5, (400, 3)) * [3.8, 1.5, 1.3]
    post = np.array([15, -4, -0.8]) + rng.uniform(-0.5, 0.5, (100, 3)) * [0.3, 0.3, 1.5]
    xyz = np.concatenate([ground, car, post]).astype(np.float32)
    truth = GroundTruth.of(BOXES[:1] * [1, 1, 1, 1, 1, 1, 0], np.array([CAR]))
    found = measure_diagonals(PointCloud(xyz, np.full(len(xyz), 0.3, np.float32)), truth, 1.73)
    assert found["boxes"] == [[CAR, pytest.approx(np.hypot(3.9, 1.6), abs=0.01)]]
    by_class = {c: d for c, d in found["clusters"]}
    assert 3.5 < by_class[CAR] < 4.3 and by_class[NO_CLASS] < 0.6
    none = measure_diagonals(PointCloud(xyz), GroundTruth.of(np.zeros((0, 7)), np.zeros(0, int)), 1.73)
    assert none["boxes"] == [] and {c for c, _ in none["clusters"]} == {NO_CLASS}


def test_classes_by_diagonal_are_counted():
    counts = np.array(count_classes([[CAR, 4.0], [CAR, 2.0], [NO_CLASS, 9.0]]))
    assert counts.sum() == 3 and counts[0, 0] == counts[0, 1] == counts[3, 3] == 1
    section = make_diagonal_section([{"boxes": [[CAR, 4.0]], "clusters": [[CAR, 2.0]]}])
    row = section.tables[1].rows[0]
    assert row[:2] == ("Car", "1") and [c.value for c in row if isinstance(c, Cell)][3:] == [0.0, 100.0, 0.0, 0.0]


@pytest.mark.usefixtures("one_thread", "streets")
def test_tiny_run_from_training_to_pictures(tmp_path, monkeypatch):
    monkeypatch.setitem(
        config_module.SIZES,
        "compact",
        dict(
            cell=0.64,
            low=(0.0, -20.48, -3.0),
            high=(40.96, 20.48, 1.0),
            pillar_channels=4,
            map_channels=(4,),
            block_channels=(4, 4, 4),
            block_layers=(0, 0, 0),
            deconv_channels=4,
            fpn_channels=4,
        ),
    )
    monkeypatch.setattr(tables, "resample_cells", partial(resample_cells, replicates=2))
    sets = {
        "sensor": "generic:16,-20,5,2,10",
        "data.scans": 4,
        "data.val_scans": 1,
        "steps": 1,
        "batch": 1,
        "augment.crowded": 0.0,
    }
    out = tmp_path / "out"
    result = CliRunner().invoke(
        cli,
        [
            "reproduce",
            "eg-pointpillars",
            "--data",
            "sim",
            "--out",
            str(out),
            "--limit",
            "2",
            "--jobs",
            "1",
            *(word for pair in sets.items() for word in ("--set", "{}={}".format(*pair))),
        ],
        catch_exceptions=False,
    )
    assert result.exit_code == 0, result.output
    report = json.loads((out / "report.json").read_text())
    assert report["measured"] == 2
    assert "No version was trained long enough" in report["sections"][1]["text"]
    names = {t["name"] for section in report["sections"] for t in section["tables"]}
    assert names >= {"models", "table_5", "table_6", "table_2_clusters", "labels"}
    assert {p.name for p in (out / "figures").iterdir()} >= {"figure_13.png", "figure_20_1.png"}
    assert "data:image/png" in (out / "report.html").read_text()
