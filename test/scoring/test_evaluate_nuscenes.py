"""The command evaluate nuscenes: result files, checkpoints, scenes, and invalid input."""

from __future__ import annotations

import json
import types

import detection_samples
import numpy as np
import nuscenes_folder as folder
import pointnet_samples
import pytest
from cli_samples import read_error_line, run_main
from click.testing import CliRunner

from lidar_perception.cli.main import cli
from lidar_perception.data.nuscenes.boxes import NAMES, GlobalBoxes
from lidar_perception.data.nuscenes.folder import open_nuscenes
from lidar_perception.data.nuscenes.results import MAX_BOXES, NAME_BY_CLASS, read_results, to_results, write_results
from lidar_perception.detectors.checkpoint import Header, save_checkpoint
from lidar_perception.detectors.contract import DetectionResult
from lidar_perception.detectors.open import open_detector
from lidar_perception.detectors.params import MIN_SCORE
from lidar_perception.scoring.nuscenes.report import DETECTED_NAMES
from lidar_perception.types import CLASSES, Detections, InputError

TABLES = folder.make_tables(seed=2, frames=4, objects=60)


@pytest.fixture
def root(tmp_path):
    return folder.save(tmp_path / "nuscenes", TABLES)


def make_detections(frame, seed=0):
    """Labelled objects of the detected classes, slightly displaced, and a Van."""
    truth, rng = frame.truth(), np.random.default_rng(seed)
    is_kept = np.isin(truth.class_ids, [CLASSES.index(name) for name in NAME_BY_CLASS])
    is_kept &= np.array([extras["points"] > 0 for extras in truth.extras])
    near = truth.boxes[is_kept] + rng.normal(0, 0.05, 7)
    ids = truth.class_ids[is_kept]
    return Detections.of(np.vstack([near, near[:1]]), [*ids, CLASSES.index("Van")], rng.uniform(0.1, 1, len(near) + 1))


@pytest.fixture
def detector(monkeypatch):
    """Stand-in for the detector of a checkpoint."""
    stand_in = types.SimpleNamespace(asked=[], find=lambda scan: Detections.none())

    def opened(path, device, *, min_score, sensor_height, range, settings):
        stand_in.asked.append((path, device, min_score, sensor_height))
        return lambda scan: DetectionResult(stand_in.find(scan))

    monkeypatch.setattr("lidar_perception.detectors.open.open_detector", opened)
    return stand_in


def evaluate(tmp_path, *arguments):
    path = tmp_path / "made/scores.json"
    result = CliRunner().invoke(
        cli, ["evaluate", "nuscenes", "--json", str(path), *map(str, arguments)], catch_exceptions=False
    )
    assert result.exit_code == 0, result.output
    return json.loads(path.read_text()), result.stdout


def get_error(monkeypatch, capsys, *arguments):
    assert run_main(monkeypatch, "evaluate", "nuscenes", *arguments) == 2
    return read_error_line(capsys)


def get_frames_by_stamp(root):
    return {frame.stamp_ns: frame for frame in open_nuscenes(root)}


def test_checkpoint_and_its_result_file_score_equally(root, detector, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    frames, out = get_frames_by_stamp(root), tmp_path / "out/results.json"
    detector.find = lambda scan: make_detections(frames[scan.stamp_ns])
    direct, text = evaluate(
        tmp_path, "--data", root, "--weights", "w.safetensors", "--device", "cpu", "--write-results", out
    )
    ((path, *settings),) = detector.asked
    assert (str(path), *settings) == ("w.safetensors", "cpu", MIN_SCORE, folder.SENSOR[2])
    assert direct["frames"] == 8 and direct["ms"] >= 0 and direct["version"] == "v1.0-mini"
    car, person = (direct["classes"][n] for n in ("car", "pedestrian"))
    assert car["mean_ap"] > 99 and car["ate"] < 0.3 and person["mean_ap"] > 99
    assert all(
        direct["classes"][n]["mean_ap"] == 0 and direct["classes"][n]["ate"] == 1
        for n in NAMES
        if n not in DETECTED_NAMES
    )
    assert direct["ours"]["ave"] == direct["ours"]["aae"] == 1
    assert direct["all"]["map"] == pytest.approx(0.3 * direct["ours"]["map"])
    read, _ = evaluate(tmp_path, "--data", root, "--results", out)
    assert {**read, "source": None, "ms": None} == {**direct, "source": None, "ms": None}
    for words in ("92.68", "83.45", "our three ", "all ten", "result file", "ms per frame"):
        assert words in text
    assert max(len(line) for line in text.splitlines() if str(out) not in line) <= 80


def test_scenes_are_selected_by_a_file(root, tmp_path):
    scenes, path = tmp_path / "val.txt", tmp_path / "r.json"
    scenes.write_text("scene-0916\nscene-0916\n")
    write_results(path, {f.native.token: GlobalBoxes.none() for f in open_nuscenes(root)})
    content, _ = evaluate(tmp_path, "--data", root, "--results", path, "--split", scenes)
    assert content["frames"] == 4 and content["all"]["map"] == content["all"]["nds"] == 0


def test_result_file_survives_writing_and_reading(root, tmp_path):
    frames, rng = open_nuscenes(root), np.random.default_rng(0)
    written = {}
    for frame in frames:
        found = make_detections(frame)
        boxes = to_results(found, frame)
        assert len(boxes) == len(found) - 1 and (np.diff(boxes.scores) <= 0).all()
        boxes.velocities[::2] = rng.normal(0, 1, (len(boxes[::2]), 2))
        boxes.attributes[::3] = 4
        written[frame.native.token] = boxes
    write_results(tmp_path / "r.json", written)
    read = read_results(tmp_path / "r.json", frames)
    assert [*read] == [frame.name for frame in frames]
    for frame in frames:
        for name, column in vars(written[frame.native.token]).items():
            np.testing.assert_array_equal(getattr(read[frame.name], name), column, err_msg=name)


def test_only_the_best_boxes_of_a_frame_are_written(root):
    frame, rng = open_nuscenes(root)[0], np.random.default_rng(0)
    scores = rng.uniform(0, 1, MAX_BOXES + 50)
    results = to_results(Detections.of(np.ones((len(scores), 7)), 0, scores), frame)
    assert len(results) == MAX_BOXES and results.scores.min() > np.sort(scores)[49]
    nan_detections = Detections.of(np.full((1, 7), np.nan), 0)
    with pytest.raises(InputError, match=r"scene-0103/00: a box or score .* not finite"):
        to_results(nan_detections, frame)


def test_unreadable_and_rejected_scans_are_reported(root, detector, tmp_path):
    frames = open_nuscenes(root)
    frames[0].points.unlink()
    frames[1].points.write_bytes(bytes(30))

    def find(scan):
        if scan.stamp_ns == frames[2].stamp_ns:
            raise InputError("too dark")
        return make_detections(get_frames_by_stamp(root)[scan.stamp_ns])

    detector.find = find
    out = tmp_path / "r.json"
    content, text = evaluate(tmp_path, "--data", root, "--weights", "w", "--write-results", out)
    assert content["frames"] == 6 and len(content["skipped"]) == 3
    assert "cannot read" in content["skipped"][0] and "30 bytes" in content["skipped"][1]
    assert content["skipped"][2] == "scene-0103/02: too dark" and "skipped" in text
    results = json.loads(out.read_text())["results"]
    assert results[frames[2].native.token] == [] and frames[0].native.token not in results


def test_version_without_labels_is_written_and_not_scored(tmp_path, detector, monkeypatch, capsys):
    tables = {name: rows for name, rows in TABLES.items() if name != "sample_annotation"}
    root = tmp_path / "test"
    folder.save(root, TABLES)
    folder.save(root, tables, "v1.0-test", sweeps=False)
    detector.find = lambda scan: Detections.of(np.ones((1, 7)), 0, 0.5)
    out = tmp_path / "r.json"
    content, _ = evaluate(tmp_path, "--data", root / "v1.0-test", "--weights", "w", "--write-results", out)
    assert content["frames"] == 0 and content["all"] is None
    assert [len(rows) for rows in json.loads(out.read_text())["results"].values()] == [1] * 8
    assert content["version"] == "v1.0-test"
    assert "v1.0-test: no frame with labels" in get_error(
        monkeypatch, capsys, "--data", root / "v1.0-test", "--results", out
    )
    line = get_error(monkeypatch, capsys, "--data", root, "--results", out)
    assert "several versions" in line and str(root / "v1.0-test") in line


@pytest.mark.parametrize(
    "text, words",
    [
        (None, "cannot read the results"),
        ("{", "is not a JSON file"),
        ("[" * 100_000, "is not a JSON file"),
        ("[]", "has no 'results'"),
        ('{"results": []}', "has no 'results'"),
    ],
)
def test_files_without_results_are_reported(root, tmp_path, monkeypatch, capsys, text, words):
    path = tmp_path / "r.json"
    if text is not None:
        path.write_text(text)
    assert words in get_error(monkeypatch, capsys, "--data", root, "--results", path)


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["--data", "a"], "give either --results JSON or --weights FILE"),
        (["--data", "a", "--results", "b", "--weights", "c"], "give either"),
        (["--results", "b"], "DATA is missing"),
        (["--data", "a", "--results", "b", "--write-results", "c"], "already is a result file"),
    ],
)
def test_contradictory_options_are_rejected(arguments, words, monkeypatch, capsys):
    assert run_main(monkeypatch, "evaluate", "nuscenes", *arguments) == 2
    assert words in capsys.readouterr().err


def test_invalid_scene_files_are_reported(root, tmp_path, monkeypatch, capsys):
    def error(path):
        return get_error(monkeypatch, capsys, "--data", root, "--weights", "w", "--split", path)

    scenes = tmp_path / "scenes.txt"
    assert "cannot read the split" in error(scenes)
    scenes.write_text("\n")
    assert "is empty" in error(scenes)
    scenes.write_text("scene-0103\nscene-9999\n")
    assert "such as scene-9999 (1 in all)" in error(scenes)


@pytest.mark.parametrize(
    "samples, config",
    [
        (detection_samples, detection_samples.make_tiny_config()),
        (pointnet_samples, pointnet_samples.make_small_config()),
    ],
)
def test_detector_gets_the_sensor_height(samples, config, tmp_path, one_thread):
    save_checkpoint(tmp_path / "w", samples.make_random_network(config), Header(config))
    detector = open_detector(tmp_path / "w", "cpu", sensor_height=1.84)
    assert detector.networks[0].config == config
    assert detector.params.ground.sensor_pose.height == 1.84
