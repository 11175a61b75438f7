"""The command evaluate detection: result files, checkpoints, splits, and invalid input."""

from __future__ import annotations

import types

import numpy as np
import pytest
from cli_samples import evaluate_detection as evaluate
from cli_samples import read_error_line, run_main
from samples import CALIBRATION, LABELS, write_file, write_object_folder

from lidar_perception.data.kitti.results import read_results, write_results
from lidar_perception.data.open import open_recording
from lidar_perception.data.to_bag import write_bag
from lidar_perception.detectors.contract import DetectionResult
from lidar_perception.detectors.params import MIN_SCORE
from lidar_perception.scoring.detections import thin_scan
from lidar_perception.scoring.kitti.protocol import DIFFICULTIES, SCORED
from lidar_perception.scoring.kitti.report import INTERVALS
from lidar_perception.types import CLASSES, SENSOR_HEIGHT, Detections, InputError

PERSON, CAR, REGION = LABELS.splitlines()
WHOLE = CAR.replace("0.35 2", "0.00 0")
ROWS = ("image", "aos", "bev", "3d", "bev_relaxed", "3d_relaxed")


def get_error(monkeypatch, capsys, *arguments):
    assert run_main(monkeypatch, "evaluate", "detection", *arguments) == 2
    return read_error_line(capsys)


def list_cells(content):
    return {
        (name, row, level): cell
        for name in SCORED
        for row in ROWS
        for level in DIFFICULTIES
        if (cell := content["ap"][name][row][level])
    }


def write_result_files(folder, text, count=2):
    for i in range(count):
        write_file(folder / f"{i:06}.txt", text)
    return folder


@pytest.fixture
def kitti(tmp_path):
    """Two frames with a pedestrian and a car in full view."""
    return write_object_folder(tmp_path / "kitti", f"{PERSON}\n{WHOLE}\n{REGION}\n")


@pytest.fixture
def result_folder(tmp_path):
    """Result files with the labelled objects."""
    return write_result_files(tmp_path / "found", f"{PERSON} 0.9\n{WHOLE} 0.8\n")


@pytest.fixture
def detector(monkeypatch):
    """Replace the detector of a checkpoint by made.find and record the calls in made.asked."""
    stand_in = types.SimpleNamespace(asked=[], scans=[], find=lambda frame: Detections.none())

    def open_detector(path, device="auto", *, min_score=None, sensor_height=None, range="auto", settings=None):
        stand_in.asked.append((str(path), device, min_score, sensor_height))

        def detect(frame):
            stand_in.scans.append(frame)
            return DetectionResult(stand_in.find(frame))

        return detect

    monkeypatch.setattr("lidar_perception.detectors.open.open_detector", open_detector)
    return stand_in


def read_truth(kitti):
    truth = open_recording(kitti).frames[0].truth()
    return Detections.of(truth.boxes, truth.class_ids, [0.9, 0.8])


def test_labels_as_results_score_100_and_are_printed(kitti, result_folder, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    content, text = evaluate(tmp_path, "--data", kitti, "--results", result_folder, "--intervals", 10)
    assert content["intervals"]["Car"] == {row: [100, 100] for row in INTERVALS}
    assert content["intervals"]["Cyclist"]["3d"] is None and "100-100" in text
    assert content["frames"] == 2 and content["source"] == str(result_folder)
    assert len(list_cells(content)) == 2 * len(ROWS) * len(DIFFICULTIES)
    assert {(c["objects"], c["r11"], c["r40"]) for c in list_cells(content).values()} == {(2, 100, 100)}
    assert content["map_3d"] == {"r11": 100, "r40": 100} and content["ap"]["Cyclist"]["3d"]["easy"] is None
    assert content["pedestrian_centres"]["of_all"]["all"]["f1"] == 1
    for words in ("R40 100.00, R11 100.00", "Pedestrians within 1.0 m", "BEV"):
        assert words in text
    assert max(map(len, text.splitlines())) <= 80


def test_single_second_of_a_drive_has_no_interval(kitti, detector, tmp_path):
    """One second of a drive is a single block, so there is nothing to resample."""
    detector.find = lambda frame: read_truth(kitti)
    write_bag(tmp_path / "bag", open_recording(kitti))
    arguments = "--weights", "any", "--intervals", 10
    assert evaluate(tmp_path, "--data", kitti, *arguments)[0]["intervals"]["Car"]["bev"]
    content, _ = evaluate(tmp_path, "--data", tmp_path / "bag", *arguments)
    assert content["intervals"]["Car"] == dict.fromkeys(INTERVALS)


def test_label_without_scan_is_skipped_by_name(kitti, detector, result_folder, tmp_path):
    (kitti / "training/velodyne/000001.bin").unlink()
    content, text = evaluate(tmp_path, "--data", kitti, "--weights", "any")
    assert content["frames"] == 1 and "000001.txt has no scan" in content["skipped"][0]
    assert "has no scan" in " ".join(text.split())
    assert (
        evaluate(tmp_path, "--data", kitti, "--weights", "any", "--limit", 1)[0]["skipped"]
        == evaluate(tmp_path, "--data", kitti, "--results", result_folder)[0]["skipped"]
        == []
    )


def test_scans_are_not_needed_for_result_files(kitti, result_folder, tmp_path):
    before, _ = evaluate(tmp_path, "--data", kitti, "--results", result_folder)
    for path in (kitti / "training/velodyne").iterdir():
        path.unlink()
    (kitti / "training/velodyne").rmdir()
    after, _ = evaluate(tmp_path, "--data", kitti / "training", "--results", result_folder)
    assert after == before
    with pytest.raises(InputError, match="no KITTI scans"):
        open_recording(kitti)


def test_checkpoint_is_evaluated_on_every_scan(kitti, detector, tmp_path):
    detector.find = lambda frame: read_truth(kitti)
    content, text = evaluate(tmp_path, "--data", kitti, "--weights", "v4.onnx", "--device", "cpu")
    assert detector.asked == [("v4.onnx", "cpu", MIN_SCORE, SENSOR_HEIGHT)]
    assert len(detector.scans) == 2
    assert len(detector.scans[0]) == len(open_recording(kitti).frames[0].load())
    assert content["ms"] >= 0 and "ms per frame" in text
    for (_, row, _), cell in list_cells(content).items():
        if row not in ("image", "aos"):  # 2D boxes of these labels are not projections
            assert cell["r40"] == 100


def test_thinning_to_a_fraction_is_repeatable(kitti, detector, tmp_path):
    thinned_scans = {}
    for share in (1, 0.1, 0.1):
        detector.scans.clear()
        content, _ = evaluate(tmp_path, "--data", kitti, "--weights", "w", "--keep", share)
        assert content["keep"] == share
        points = [np.column_stack([scan.xyz, scan.intensity]) for scan in detector.scans]
        for now, before in zip(points, thinned_scans.get(share, points), strict=True):
            np.testing.assert_array_equal(now, before)
        thinned_scans[share] = points
    for frame, whole, tenth in zip(open_recording(kitti).frames, thinned_scans[1], thinned_scans[0.1], strict=True):
        np.testing.assert_array_equal(whole[:, :3], frame.load().xyz)
        assert abs(len(tenth) / len(whole) - 0.1) < 0.03
        assert set(map(tuple, tenth)) < set(map(tuple, whole))
    assert len(thinned_scans[0.1][0]) != len(thinned_scans[0.1][1])  # each frame has its own random numbers


def test_smaller_fraction_is_a_subset_of_a_larger_one(kitti):
    frame = open_recording(kitti).frames[0].load()
    before = frame
    for share in (1.0, 0.5, 0.2, 0.1, 0.0):
        now = thin_scan(frame, share, "000000")
        assert set(map(bytes, now.xyz)) <= set(map(bytes, before.xyz))
        assert abs(len(now) - share * len(frame)) <= 3 * np.sqrt(len(frame))
        before = now
    assert thin_scan(frame, 1.0, "a") is frame and len(before) == 0


def test_written_results_score_like_the_detections(kitti, detector, tmp_path):
    noise = np.random.default_rng(0)
    detector.find = lambda frame: Detections.of(
        read_truth(kitti).boxes + noise.normal(0, 0.02, 7), read_truth(kitti).class_ids, [0.123456, 3]
    )
    out = tmp_path / "out/data"
    direct, text = evaluate(tmp_path, "--data", kitti, "--weights", "w", "--write-results", out)
    assert "result files" in text and sorted(p.name for p in out.iterdir()) == ["000000.txt", "000001.txt"]
    read, _ = evaluate(tmp_path, "--data", kitti, "--results", out)
    for key, cell in list_cells(direct).items():
        assert list_cells(read)[key] == pytest.approx(cell, abs=1e-3)


def test_result_files_have_the_detections(tmp_path):
    rng = np.random.default_rng(3)
    boxes = np.column_stack(
        [
            rng.uniform(8, 40, 20),
            rng.uniform(-9, 9, 20),
            rng.uniform(-2, 0, 20),
            rng.uniform(0.5, 4, (20, 3)),
            rng.uniform(-3, 3, 20),
        ]
    )
    boxes[0, 0] = -30  # behind the camera: no 2D box
    detections = Detections.of(boxes, rng.integers(0, 6, 20), rng.uniform(-2, 1, 20))
    path = tmp_path / "000000.txt"
    write_results(path, detections, CALIBRATION)
    back = read_results(path, CALIBRATION.lidar_to_camera)
    np.testing.assert_array_equal(back.class_ids, detections.class_ids)
    # LiDAR and camera are tilted by one degree to each other, and files have upright boxes only.
    np.testing.assert_allclose(back.boxes[:, :6], detections.boxes[:, :6], atol=2e-4)
    np.testing.assert_allclose(np.cos(back.boxes[:, 6] - detections.boxes[:, 6]), 1, atol=1e-4)
    np.testing.assert_allclose([e["score"] for e in back.extras], detections.scores, atol=1e-4)
    assert back.extras[0]["bbox"] == [0] * 4 and max(back.extras[1]["bbox"]) > 0
    assert {(e["truncated"], e["occluded"]) for e in back.extras} == {(-1, -1)}
    write_results(path, Detections.none(), CALIBRATION)
    assert len(read_results(path, CALIBRATION.lidar_to_camera)) == 0


def test_result_files_keep_the_order_of_weak_scores(tmp_path):
    """Many boxes have scores just above the minimum, and average precision depends on their order."""
    scores = np.float32(0.001 + 3e-6 * np.arange(100))
    write_results(
        tmp_path / "a.txt", Detections.of(np.tile([20.0, 0, -1, 4, 2, 1.5, 0], (100, 1)), 0, scores), CALIBRATION
    )
    back = read_results(tmp_path / "a.txt", CALIBRATION.lidar_to_camera)
    assert (np.diff([e["score"] for e in back.extras]) > 0).all()


def test_frames_without_labels_are_written_and_not_scored(kitti, detector, tmp_path, monkeypatch, capsys):
    (kitti / "training/label_2/000001.txt").unlink()
    out = tmp_path / "out"
    content, _ = evaluate(tmp_path, "--data", kitti, "--weights", "w", "--write-results", out)
    assert content["frames"] == 1 and (out / "000001.txt").exists()
    line = get_error(
        monkeypatch, capsys, "--data", kitti, "--weights", "w", "--write-results", kitti / "training/label_2"
    )
    assert "label_2 already contains files" in line
    (kitti / "training/label_2/000000.txt").unlink()
    content, _ = evaluate(tmp_path, "--data", kitti, "--weights", "w", "--write-results", tmp_path / "others")
    assert content["frames"] == 0
    line = get_error(monkeypatch, capsys, "--data", kitti, "--weights", "w")
    assert line == f"Error: {kitti}: no frame with labels"


def test_truncated_and_rejected_scans_are_listed_as_skipped(kitti, detector, tmp_path):
    write_file(kitti / "training/velodyne/000001.bin", b"123")
    content, text = evaluate(tmp_path, "--data", kitti, "--weights", "w")
    (line,) = content["skipped"]
    assert "000001.bin" in line and "is truncated" in line and "skipped" in text
    assert content["frames"] == 1

    def refuse(frame):
        raise InputError("the cloud has no intensity")

    detector.find = refuse
    content, _ = evaluate(tmp_path, "--data", kitti, "--weights", "w")
    assert content["skipped"][0] == "000000: the cloud has no intensity"
    assert content["frames"] == 1 and content["ap"]["Car"]["3d"]["hard"]["r40"] == 0


def test_results_that_cannot_be_written_end_the_run(kitti, detector, monkeypatch, capsys):
    line = get_error(
        monkeypatch,
        capsys,
        "--data",
        kitti,
        "--weights",
        "w",
        "--write-results",
        kitti / "training/calib/000000.txt/out",
    )
    assert line.startswith("Error: cannot write") and not detector.scans


def test_split_selects_the_scored_frames(kitti, result_folder, tmp_path):
    (result_folder / "000000.txt").unlink()
    split = write_file(tmp_path / "val.txt", "000001\n000001\n")
    content, _ = evaluate(tmp_path, "--data", kitti, "--results", result_folder, "--split", split)
    assert content["frames"] == 1


BAD = {
    "columns": (f"{PERSON} 0.9\n\n{WHOLE} 0.8 7\n", "000000.txt:3 is not a KITTI label"),
    "words": (PERSON.replace("1.80", "tall") + " 0.9", "000000.txt:1 is not a KITTI label"),
    "score": (f"{PERSON} 0.9\n{WHOLE}", "000000.txt:2 has no score"),
    "too large": (f"{PERSON} 1e308", "000000.txt:1 is not a KITTI label"),
    "nan": (f"{PERSON} nan", "000000.txt:1 is not a KITTI label"),
    "class": (f"{PERSON} 0.9".replace("Pedestrian", "Walker"), "000000.txt:1 has the unknown class 'Walker'"),
    "bytes": (b"\xff\xfe\x00", "cannot read the labels"),
}


@pytest.mark.parametrize("case", BAD)
def test_error_names_the_bad_result_file_and_line(case, kitti, result_folder, monkeypatch, capsys):
    content, words = BAD[case]
    write_file(result_folder / "000000.txt", content)
    line = get_error(monkeypatch, capsys, "--data", kitti, "--results", result_folder)
    assert line.startswith("Error: ") and words in line and str(result_folder) in line


def test_missing_files_and_labels_are_reported(kitti, result_folder, tmp_path, monkeypatch, capsys):
    def error(*arguments):
        return get_error(monkeypatch, capsys, "--data", kitti, *arguments)

    assert "none is not a folder" in error("--results", tmp_path / "none")
    assert "cannot read the split" in error("--results", result_folder, "--split", tmp_path / "none")
    split = write_file(tmp_path / "split.txt", "000001 000007 000008")
    line = error("--results", result_folder, "--split", split)
    assert "such as 000007 (2 in all)" in line and str(kitti) in line
    assert "is empty" in error("--results", result_folder, "--split", write_file(split, "\n"))
    (result_folder / "000001.txt").unlink()
    assert f"result file {result_folder / '000001.txt'} does not exist" in error("--results", result_folder)
    write_file(kitti / "training/label_2/000000.txt", "Car 1 2 3")
    write_file(kitti / "training/label_2/000001.txt", "Car 1 2 3")
    assert "no frame with labels" in (line := error("--results", result_folder)) and "000000.txt:1" in line


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["--data", "a", "--results", "b", "--weights", "c"], "give either --results DIR, or"),
        (["--data", "a", "--results", "b", "--keep", "0.1"], "--keep requires --weights"),
        (["--data", "a", "--weights", "b", "--keep", "1.1"], "1.1 is not in the range"),
        (["--results", "b"], "DATA is missing"),
        (["--data", "a", "--results", "b", "--write-results", "c"], "already contains result files"),
    ],
)
def test_contradictory_options_are_rejected(arguments, words, monkeypatch, capsys):
    assert run_main(monkeypatch, "evaluate", "detection", *arguments) == 2
    assert words in capsys.readouterr().err


def add_scores(labels):
    lines = [line for line in labels.read_text().splitlines() if not line.startswith("DontCare")]
    return "".join(f"{line} {1 - i / 100}\n" for i, line in enumerate(lines))


def test_real_labels_as_results_score_100(data, tmp_path):
    root = data / "kitti_object"
    for path in root.glob("training/label_2/*.txt"):
        write_file(tmp_path / "found" / path.name, add_scores(path))
    content, _ = evaluate(tmp_path, "--data", root, "--results", tmp_path / "found")
    found = list_cells(content)
    assert content["frames"] == 57 and len(found) == len(SCORED) * len(ROWS) * len(DIFFICULTIES)
    assert {(c["r11"], c["r40"]) for c in found.values()} == {(100, 100)}
    assert found["Car", "3d", "hard"]["objects"] > found["Car", "3d", "easy"]["objects"] > 40
    assert content["pedestrian_centres"]["of_all"]["all"]["f1"] == 1
    assert content["diagnosis"] == [] and content["skipped"] == []


@pytest.mark.no_cover
def test_real_boxes_project_onto_their_2d_labels(data, detector, tmp_path):
    """Boxes score 100 in BEV and 3D. In the image, the label of a person may differ from the projected box because
    of limbs and occlusion."""
    truths = iter([f.truth() for f in open_recording(data / "kitti_object")])

    def find(frame):
        truth = next(truths)
        return Detections.of(truth.boxes, truth.class_ids, np.linspace(1, 0.5, len(truth)))

    detector.find = find
    content, _ = evaluate(tmp_path, "--data", data / "kitti_object", "--weights", "w")
    for (name, row, _), cell in list_cells(content).items():
        assert cell["r40"] > (80 if name == "Pedestrian" and row in ("image", "aos") else 99.99)


def test_real_tracks_use_truncation_at_the_image_border(data, tmp_path):
    root = data / "kitti_tracking"
    frames = open_recording(root).frames
    for frame in frames:
        truth = frame.truth()
        write_results(
            tmp_path / f"found/{frame.name}.txt", Detections.of(truth.boxes, truth.class_ids), frame.calibration()
        )
    content, _ = evaluate(tmp_path, "--data", root, "--results", tmp_path / "found")
    assert content["frames"] == len(frames) == 30
    assert content["ap"]["Cyclist"]["3d"]["easy"]["r40"] == pytest.approx(100)
    levels = [content["ap"]["Car"]["3d"][level]["objects"] for level in DIFFICULTIES]
    tall = sum(c == CLASSES.index("Car") for frame in frames for c in frame.truth().class_ids)
    assert 0 < levels[0] < levels[1] < levels[2] < tall
