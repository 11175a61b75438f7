"""The command compare: scores and missing detectors."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial

import detection_samples
import numpy as np
import pointnet_samples
import pytest
from cli_samples import read_error_line, run_main
from click.testing import CliRunner
from kitti_samples import write_tracking_folder
from samples import make_walker_label, write_crowd_folder, write_file, write_object_folder

from experiments.__main__ import cli, main
from experiments.comparison.contenders import open_contenders
from experiments.comparison.outcomes import ComparisonReport, Contender, rotate, start_comparison
from lidar_perception.data.open import open_recording
from lidar_perception.detectors import weights_file
from lidar_perception.detectors.checkpoint import Header, save_checkpoint
from lidar_perception.detectors.contract import DetectionResult
from lidar_perception.scoring.kitti.protocol import SCORED
from lidar_perception.scoring.run import fill_report
from lidar_perception.types import Detections, InputError

pytestmark = pytest.mark.usefixtures("one_thread")

CANDIDATES = ["STM-CPA paper", "STM-CPA best", "STM-CPA best, auto"]
ROW = {"weights", "classes", "ap", "mean_ap", "pedestrian_centres", "ms", "ms_of_frames", "frames", "failed"}


@pytest.fixture
def package_without_weights(monkeypatch, tmp_path):
    """A copy of the package without weights."""
    monkeypatch.setattr(weights_file, "POINTPILLARS_WEIGHTS", tmp_path / "none")
    monkeypatch.setattr(weights_file, "POINTNET_WEIGHTS", tmp_path / "none.safetensors")


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """Networks with random weights: PointPillars v0 compact twice, and a PointNet."""
    folder = tmp_path_factory.mktemp("weights")
    config = detection_samples.make_tiny_config()
    for name, seed in ("a", 0), ("b", 1):
        save_checkpoint(folder / name, detection_samples.make_random_network(config, seed), Header(config))
    config = pointnet_samples.make_small_config()
    save_checkpoint(folder / "c", pointnet_samples.make_random_network(config), Header(config))
    return folder


def run(tmp_path, *arguments) -> tuple[dict, str]:
    path = tmp_path / "made/scores.json"
    result = CliRunner().invoke(cli, ["compare", "--json", str(path), *map(str, arguments)], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return json.loads(path.read_text()), result.stdout


def compute_report(root, *detectors) -> dict:
    """Return the report of detectors. Each one is given by a function that returns the detector for a frame, or
    None."""
    contenders = [Contender(str(i), each) for i, each in enumerate(detectors)]
    report = ComparisonReport(contenders)
    fill_report(report, open_recording(root), partial(start_comparison, lambda: contenders))
    return report.compute()


def make_fake(detect):
    """Return a function that returns, for a frame, a detector whose result is detect(frame)."""
    return lambda frame: lambda scan: DetectionResult(detect(frame))


def copy_labels(frame, score=0.9) -> Detections:
    truth = frame.truth()
    return Detections.of(truth.boxes, truth.class_ids, score)


def test_all_detectors_run_and_missing_ones_are_listed(package_without_weights, weights, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    root = write_crowd_folder(tmp_path / "kitti", 3)
    options = [word for name in "acb" for word in ("--weights", weights / name)]
    content, text = run(tmp_path, "--data", root, *options, "--device", "cpu")
    assert [*content["rows"]] == [*CANDIDATES, "PointPillars v0 compact", "PointNet", "PointPillars v0 compact #2"]
    assert {each["name"] for each in content["missing"]} == {"fused"} | {
        f"PointPillars v{i} {size}" for i in range(5) for size in ("full", "compact") if (i, size) != (0, "compact")
    }
    assert (content["frames"], content["pedestrians"]) == (3, {"frames": 2, "ground_truth": 8})
    assert content["objects"]["Pedestrian"]["hard"] == 8
    for name, row in content["rows"].items():
        assert row.keys() == ROW and row["ms"] > 0 and row["frames"] == len(row["ms_of_frames"])
        labelled = name.startswith("STM-CPA") and not name.endswith("auto")
        assert row["frames"] + len(row["failed"]) == (2 if labelled else 3)
        operating, best = (row["pedestrian_centres"][key] for key in ("operating", "best"))
        assert operating["tp"] + operating["fn"] == best["tp"] + best["fn"] == 8
        assert operating["f1"] <= best["f1"]
        assert (row["classes"] == ["Pedestrian"]) == name.startswith("STM-CPA")
        assert (row["mean_ap"]["3d"] is None) == name.startswith("STM-CPA")
        assert name in text
    assert content["rows"]["PointPillars v0 compact #2"]["weights"] == str(weights / "b")
    assert "missing" in text and "v4 full" in text and "AVOD" in text
    lines = [line for line in text.splitlines() if str(tmp_path) not in line and not line.startswith("missing: ")]
    assert max(map(len, lines)) <= 100 and "…" not in text


def test_candidates_are_compared_in_any_layout(package_without_weights, tmp_path):
    content, _ = run(tmp_path, "--data", write_tracking_folder(tmp_path / "kitti"), "--limit", 2)
    assert [*content["rows"]] == CANDIDATES and content["frames"] == 2
    reasons = {each["name"]: each["reason"] for each in content["missing"]}
    assert len(reasons) == 12 and "--weights" in reasons["PointNet"]
    frame, _ = open_recording(write_crowd_folder(tmp_path / "crowd", 2))  # like a bag without a camera
    found, _ = open_contenders([], "cpu", 1.73)
    scan, blind = frame.load(), replace(frame, calibration=lambda: None)
    whole, cropped = ([len(each.make_detector(one)(scan).detections) for each in found] for one in (blind, frame))
    assert whole >= cropped > [0, 0, 0]


def test_failing_detector_does_not_end_the_comparison(tmp_path):
    root = write_object_folder(tmp_path, make_walker_label(), count=3)

    def fail(frame):
        if frame.name == "000001":
            raise InputError("too dark")
        return copy_labels(frame)

    def return_nan(frame):
        return Detections.of(np.vstack([frame.truth().boxes, np.full((1, 7), np.nan)]))

    whole, failing, other, nan = compute_report(
        root, make_fake(copy_labels), make_fake(fail), lambda frame: None, make_fake(return_nan)
    )["rows"].values()
    assert whole["ap"]["Pedestrian"]["3d"]["moderate"] == 100 == whole["mean_ap"]["3d"]
    assert whole["pedestrian_centres"]["operating"]["f1"] == 1 and whole["failed"] == []
    assert (failing["frames"], failing["failed"]) == (2, ["000001: too dark"])
    assert failing["pedestrian_centres"]["operating"]["fn"] == 1
    assert (other["frames"], other["failed"], other["ms"]) == (0, [], None)
    assert other["pedestrian_centres"]["best"] == {**other["pedestrian_centres"]["operating"], "score": None}
    assert len(nan["failed"]) == 3 and nan["ap"]["Pedestrian"]["3d"]["moderate"] == 100


def test_pedestrians_below_the_default_threshold_do_not_count(tmp_path):
    root = write_object_folder(tmp_path, make_walker_label(), count=1)

    (row,) = compute_report(root, make_fake(lambda frame: copy_labels(frame, 0.2)))["rows"].values()
    row = row["pedestrian_centres"]
    assert (row["operating"]["tp"], row["best"]["tp"]) == (0, 1)
    assert row["best"]["score"] == pytest.approx(0.2)


def test_detectors_run_in_turn_on_each_frame(tmp_path):
    for count in range(5):
        items = list(range(count))
        orders = [rotate(items, turn) for turn in range(2 * count)]
        assert all(sorted(order) == items for order in orders)
        for place in range(count):
            assert sorted(order[place] for order in orders) == sorted(2 * items)
    calls = []
    compute_report(
        write_object_folder(tmp_path, make_walker_label(), count=3),
        *(lambda frame, i=i: calls.append((frame.name, i)) for i in range(3)),
    )
    first, *rest = (calls[i : i + 3] for i in range(0, len(calls), 3))
    assert first == rest[0] and len(rest) == 3  # the first frame runs twice
    assert [frame[0][1] for frame in rest] == [0, 1, 2]


def test_unreadable_frames_are_skipped(tmp_path):
    root = write_object_folder(tmp_path, make_walker_label(), count=2)
    write_file(root / "training/velodyne/000000.bin", b"123")
    content = compute_report(root, make_fake(lambda frame: Detections.none()))
    (line,) = content["skipped"]
    assert content["frames"] == content["rows"]["0"]["frames"] == 1 and "000000.bin" in line


def test_mean_ignores_classes_without_labels(tmp_path):
    root = write_object_folder(tmp_path, make_walker_label(), count=1)
    (row,) = compute_report(root, make_fake(lambda frame: Detections.none()))["rows"].values()
    assert row["mean_ap"] == dict.fromkeys(row["mean_ap"], 0.0)
    assert [row["ap"][name]["3d"]["moderate"] for name in SCORED] == [None, 0.0, None]


@pytest.mark.parametrize("case", ["labels", "weights", "folder"])
def test_bad_input_is_reported_in_one_line(case, package_without_weights, tmp_path, monkeypatch, capsys):
    root = write_object_folder(tmp_path / "kitti")
    arguments = ["--data", root]
    if case == "labels":
        for path in (root / "training/label_2").iterdir():
            path.unlink()
        expected = "no frame with labels"
    elif case == "weights":
        arguments += ["--weights", tmp_path / "w"]
        expected = f"checkpoint not found: {tmp_path / 'w'}"
    else:
        arguments, expected = ["--data", tmp_path / "none"], f"{tmp_path / 'none'} does not exist"
    assert run_main(monkeypatch, "compare", *arguments, run=main) == 2
    assert expected in read_error_line(capsys)
