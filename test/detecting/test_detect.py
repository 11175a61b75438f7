"""The command detect: results in all formats equal the detections."""

from __future__ import annotations

import csv
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from bag_samples import cloud_frame, scans
from cli_samples import evaluate_detection
from detect_samples import NAME, MadeDetector, detect, detect_with_error, list_objects, make_run, read_json
from recording_samples import MADE
from samples import STAMP, make_scene, write_file

from lidar_perception.camera import FORWARD_CAMERA
from lidar_perception.data.bag import Bag
from lidar_perception.data.frame import Frame, Recording, return_none
from lidar_perception.data.kitti.labels import read_tracking_labels
from lidar_perception.data.kitti.results import choose_calibration, read_results
from lidar_perception.data.open import open_recording
from lidar_perception.data.to_bag import write_bag
from lidar_perception.detecting.bag import BagFormat
from lidar_perception.detecting.formats import Json
from lidar_perception.detecting.run import detect as run_detector
from lidar_perception.detectors.contract import DetectionResult
from lidar_perception.labels.exchange import import_labels
from lidar_perception.scoring.recorded import read_objects_by_stamp
from lidar_perception.scoring.run import fill_report
from lidar_perception.scoring.tracking.report import TrackingReport, make_observation, measure_tracking
from lidar_perception.tracking.params import TrackingParams
from lidar_perception.types import Detections
from lidar_perception.wire.topics import POINTS, TRUTH
from lidar_studio.results import choose_points_topic, read_recorded_results
from msg_utils.detections import from_detection_array

ALL = "kitti,json,csv,mcap,openlabel"


# Output files


@pytest.mark.parametrize("kind", MADE)
def test_every_frame_of_any_recording_has_a_result(kind, tmp_path, monkeypatch, stand_in_calls):
    data, out = MADE[kind][0](tmp_path / "in/bag"), tmp_path / "out"
    assert detect(monkeypatch, data, "--out", out, "--format", "json,csv,kitti") == 0
    names = [frame.name for frame in open_recording(data)]
    content = read_json(out)
    assert [frame["name"] for frame in content["frames"]] == names and len(stand_in_calls) == len(names)
    assert content["detector"] == content["weights"] == NAME and content["skipped"] == []
    assert content["parameters"]["least"] == 0.5 and "metres" in content["units"]["box"]
    rows_by_frame = list_objects(content)
    for frame, entry in zip(open_recording(data), content["frames"]):
        assert {k: entry[k] for k in ("sequence", "index", "stamp_ns", "frame_id")} == {
            "sequence": frame.sequence,
            "index": frame.index,
            "stamp_ns": frame.stamp_ns,
            "frame_id": frame.load().frame_id,
        }
        expected = MadeDetector()(frame.load()).detections
        np.testing.assert_array_equal(
            np.float32(rows_by_frame[frame.name]),
            np.column_stack([expected.class_ids, expected.scores, expected.boxes]).astype(np.float32),
        )
        camera = choose_calibration(frame)[0].lidar_to_camera
        kitti_results = read_results(out / f"kitti/{frame.name}.txt", camera)
        np.testing.assert_allclose(kitti_results.boxes[:, :6], expected.boxes[:, :6], atol=2e-4)
        assert [e["score"] for e in kitti_results.extras] == pytest.approx(expected.scores, abs=1e-4)
    table = [*csv.DictReader((out / "detections.csv").open())]
    assert [(row["frame"], row["class"], row["id"]) for row in table] == [(name, "Pedestrian", "") for name in names]
    for row in table:
        assert [float(row[k]) for k in ("score", "x", "yaw")] == [rows_by_frame[row["frame"]][0][k] for k in (1, 2, 8)]


def test_all_formats_of_a_run_have_the_same_boxes(drives, tmp_path, monkeypatch):
    out = tmp_path / "out"
    assert detect(monkeypatch, drives, "--out", out, "--format", ALL, "--min-score", 0.1) == 0
    rows_by_frame = list_objects(read_json(out))
    assert {len(rows) for rows in rows_by_frame.values()} == {2}
    frames = open_recording(drives).frames
    labels = import_labels(out / "openlabel", "openlabel", frames)
    for frame, frame_labels in zip(frames, labels.frames):
        rows = np.array(rows_by_frame[frame.name])
        np.testing.assert_allclose(frame_labels.boxes, rows[:, 2:], atol=1e-6)
        assert frame_labels.scores.tolist() == rows[:, 1].tolist()
    bag, results = open_as_view(out / "bag")
    for i, frame in enumerate(bag.frames):
        np.testing.assert_array_equal(frame.load().xyz, frames[i].load().xyz)
        boxes = results.make_layers(i, frame, 0.0)["detections"]["made_detector"]
        np.testing.assert_allclose(
            [row[:7] for row in boxes], np.array(rows_by_frame[frames[i].name])[:, 2:], atol=1e-3
        )
        assert [row[8] for row in boxes] == pytest.approx([row[1] for row in rows_by_frame[frames[i].name]])
        assert [row[9] for row in boxes] == [{"a": 0.5}, {}]


def open_as_view(path):
    """Open a bag as `view` does: the recording and its results."""
    recording = open_recording(path, points=choose_points_topic(path))
    return recording, read_recorded_results(recording.frames.poses, [frame.stamp_ns for frame in recording.frames[:]])


@pytest.mark.parametrize("clouds", [True, False])
def test_output_bag_has_the_messages_of_the_nodes(drives, tmp_path, monkeypatch, clouds):
    out = tmp_path / "out"
    assert (
        detect(
            monkeypatch,
            drives,
            "--out",
            out,
            "--format",
            "mcap",
            "--track",
            "--ego",
            "none",
            *["--no-clouds"] * (not clouds),
        )
        == 0
    )
    frames = open_recording(drives).frames
    stamps = [frame.stamp_ns for frame in frames]
    with Bag(out / "bag") as bag:
        assert bag.counts.get(POINTS, 0) == clouds * len(frames)
        for topic in "/made_detector/output/detections", "/tracker/output/tracks":
            marker_objects = read_objects_by_stamp(bag, [topic])[topic]
            messages = [message for _, _, message in bag.messages([f"{topic}_3d"])]
            arrays = [from_detection_array(message) for message in messages]
            assert sorted(marker_objects) == stamps == [array.stamp_ns for array in arrays]
            for array in arrays:
                np.testing.assert_allclose(array.boxes, marker_objects[array.stamp_ns].boxes, atol=1e-9)
                assert array.labels == marker_objects[array.stamp_ns].labels
                assert array.ids.tolist() == marker_objects[array.stamp_ns].ids.tolist()
            for detection in (d for message in messages for d in message.detections):
                variances = np.diag(detection.results[0].pose.covariance.reshape(6, 6))
                assert (variances[[0, 1, 2, 5]] > 0).all() and (variances[[3, 4]] == 0).all()
        assert sum(map(len, marker_objects.values())) > 0


def test_bag_with_duplicate_stamps_is_written_without_labels(tmp_path, monkeypatch, capsys):
    """Labels are assigned by stamp, which would be ambiguous."""
    frames = [replace(frame, stamp_ns=STAMP) for frame in scans(3)]
    recording = Recording(tmp_path, "", frames)
    run = make_run(recording, tmp_path / "out")
    run_detector(run, MadeDetector, [partial(BagFormat, with_clouds=True, with_tracks=False)])
    with Bag(tmp_path / "out/bag") as bag:
        assert bag.counts[POINTS] == 3 and bag.counts[TRUTH] == 1


@pytest.mark.parametrize("camera", [True, False], ids=["camera", "nominal"])
def test_written_results_score_like_the_detector(kitti, tmp_path, monkeypatch, camera, capsys):
    write_file(kitti / "training/velodyne/000002.bin", b"123")  # skipped by both commands
    if not camera:
        frames = [replace(frame, calibration=return_none) for frame in open_recording(kitti)]
        kitti = tmp_path / "bag"
        write_bag(kitti, frames, skipped=[])
    out, options = tmp_path / "out", ("--min-score", 0.001)
    assert detect(monkeypatch, kitti, "--out", out, "--format", "kitti", *options) == camera
    output = capsys.readouterr().out
    assert ("nominal camera" in " ".join(output.split())) == (not camera)
    detector_scores, _ = evaluate_detection(tmp_path, "--data", kitti, "--weights", NAME, *options)
    assert detector_scores["frames"] == 3 and detector_scores["ap"]["Pedestrian"]["bev"]["easy"]["r40"] == 100
    for folder in out, out / "kitti":
        result_scores, _ = evaluate_detection(tmp_path, "--data", kitti, "--results", folder)
        assert collect_numbers(result_scores["ap"]) == pytest.approx(collect_numbers(detector_scores["ap"]), abs=1e-3)
        assert result_scores["skipped"] == detector_scores["skipped"]


def collect_numbers(content):
    """Return all numbers in nested dicts, in their order."""
    inner = content.values() if isinstance(content, dict) else [content]
    return [
        number
        for value in inner
        for number in (collect_numbers(value) if isinstance(value, dict) else [value] * (value is not None))
    ]


# Tracks


def test_tracks_of_different_drives_have_different_ids(drives, tmp_path, monkeypatch):
    out = tmp_path / "out"
    assert detect(monkeypatch, drives, "--out", out, "--format", ALL, "--track", "--ego", "none") == 0
    content = read_json(out)
    assert content["ego"] == "none" and content["tracking"]["min_score"] == 0.05
    ids = {}
    for frame in content["frames"]:
        for row in frame["objects"]:
            ids.setdefault(frame["sequence"], set()).add(row["id"])
            assert len(row["velocity"]) == 2 and all(map(np.isfinite, row["velocity"]))
    assert ids["0000"] and ids["0007"] and not ids["0000"] & ids["0007"]
    frames = open_recording(drives).frames
    labels = import_labels(out / "openlabel", "openlabel", frames)
    for frame, frame_labels, entry in zip(frames, labels.frames, content["frames"]):
        assert frame_labels.track_ids.tolist() == [row["id"] for row in entry["objects"]]
        assert [e["velocity"] for e in frame_labels.extra] == [row["velocity"] for row in entry["objects"]]
        camera = frame.calibration().lidar_to_camera
        tracks = read_tracking_labels(out / f"kitti/{frame.sequence}.txt", camera)[frame.index]
        np.testing.assert_allclose(tracks.boxes[:, :3], np.array(list_objects(content)[frame.name])[:, 2:5], atol=2e-4)
        assert [e["track_id"] for e in tracks.extras] == frame_labels.track_ids.tolist()


def test_written_tracks_score_like_the_tracker(drives, tmp_path, monkeypatch):
    assert (
        detect(monkeypatch, drives, "--out", tmp_path, "--format", "kitti", "--track", "--ego", "none", "--force") == 0
    )
    recording, tracker_report, file_report = open_recording(drives), TrackingReport(), TrackingReport()
    fill_report(
        tracker_report,
        recording,
        partial(measure_tracking, lambda: MadeDetector().with_min_score(0.05), TrackingParams(), "none"),
    )
    for frame in recording:
        if (truth := frame.truth()) is not None:
            tracks = read_tracking_labels(tmp_path / f"kitti/{frame.sequence}.txt", frame.calibration().lidar_to_camera)
            file_report.update(
                make_observation(frame.sequence, frame.index, truth, tracks[frame.index], frame.calibration())
            )
    scores = [report.compute()["classes"] for report in (file_report, tracker_report)]
    assert scores[0].keys() == scores[1].keys() and scores[0]["Pedestrian"]["boxes"] > 0
    assert collect_numbers(scores[0]) == pytest.approx(collect_numbers(scores[1]), abs=1e-3)


def test_each_drive_of_a_bag_is_tracked_separately(tmp_path, monkeypatch):
    """Drives of a bag have no names, so their files are numbered."""
    stamps = [STAMP + s * 10**8 for s in (0, 1, 100, 101)]
    write_bag(tmp_path / "bag", [Frame.of(str(i), cloud_frame(make_scene(i), stamp)) for i, stamp in enumerate(stamps)])
    out = tmp_path / "out"
    assert detect(monkeypatch, tmp_path / "bag", "--out", out, "--format", "json,kitti", "--track") == 0
    ids = [{row["id"] for row in frame["objects"]} for frame in read_json(out)["frames"]]
    assert ids[0] & ids[1] and ids[2] & ids[3] and not (ids[0] | ids[1]) & (ids[2] | ids[3])
    assert sorted(path.name for path in (out / "kitti").iterdir()) == ["0000.txt", "0001.txt"]
    for name in "0000", "0001":
        assert [*read_tracking_labels(out / f"kitti/{name}.txt", FORWARD_CAMERA.lidar_to_camera)] == [0, 1]


# Interrupted runs, and other runs in the same folder


class StoppedRun(Exception):
    """Stop a run in the middle."""


def test_stopped_run_is_resumed(drives, tmp_path, stand_in_calls):
    def stop(scan):
        if len(stand_in_calls) == 3:
            raise StoppedRun

    recording = open_recording(drives)
    full_run, stopped_run = (make_run(recording, tmp_path / name) for name in ("whole", "parts"))
    run_detector(full_run, MadeDetector, [Json], tracking=TrackingParams(), ego="none")
    stand_in_calls.clear()
    with pytest.raises(StoppedRun):
        run_detector(stopped_run, partial(MadeDetector, fails=stop), [Json], ego="none", tracking=TrackingParams())
    assert len(stand_in_calls) == 3 and not (tmp_path / "parts/detections.json").exists()
    run_detector(stopped_run, MadeDetector, [Json], tracking=TrackingParams(), ego="none")
    assert len(stand_in_calls) == len(recording)  # no frame was written twice
    assert read_json(tmp_path / "parts") == read_json(tmp_path / "whole")


def test_number_of_processes_does_not_change_the_result(drives, tmp_path):
    recording = open_recording(drives)
    for name, jobs in ("one", 1), ("two", 2):
        run_detector(
            make_run(recording, tmp_path / name), MadeDetector, [Json], tracking=TrackingParams(), ego="none", jobs=jobs
        )
    assert read_json(tmp_path / "one") == read_json(tmp_path / "two")


def test_folder_of_another_run_needs_force(kitti, tmp_path, monkeypatch, capsys, stand_in_calls):
    out = tmp_path / "out"
    assert detect(monkeypatch, kitti, "--out", out, "--format", "kitti,csv", "--limit", 2) == 0
    assert detect(monkeypatch, kitti, "--out", out) == 0  # all frames, another format
    assert len(stand_in_calls) == 4 and len(read_json(out)["frames"]) == 4
    capsys.readouterr()
    line = detect_with_error(monkeypatch, capsys, kitti, "--out", out, "--min-score", 0.1)
    assert f"{out} has a run with other settings (min_scores" in line and "--force" in line
    assert detect(monkeypatch, kitti, "--out", out, "--min-score", 0.1, "--force") == 0
    assert len(stand_in_calls) == 8 and not (out / "detections.csv").exists()
    assert not [*out.glob("kitti/*")] and len(list_objects(read_json(out))["000000"]) == 2
    write_file(tmp_path / "mine/letter.txt", "dear")
    error = detect_with_error(monkeypatch, capsys, kitti, "--out", tmp_path / "mine")
    assert "has no run of this command" in error


# Invalid options


def test_unreadable_frames_are_reported_and_skipped(kitti, tmp_path, monkeypatch, capsys, stand_in_calls):
    scan_path, out = kitti / "training/velodyne/000001.bin", tmp_path / "out"
    content_bytes = scan_path.read_bytes()
    write_file(scan_path, b"123")
    for _ in range(2):  # an earlier failure has no effect
        assert detect(monkeypatch, kitti, "--out", out, "--format", ALL) == 1
        assert "000001.bin" in (output := capsys.readouterr().out) and "3 frames" in output
    assert len(stand_in_calls) == 3
    content = read_json(out)
    assert [frame["name"] for frame in content["frames"]] == ["000000", "000002", "000003"]
    assert "000001.bin" in content["skipped"][0]
    assert {path.stem for path in (out / "kitti").iterdir()} == {"000000", "000002", "000003"}
    write_file(scan_path, content_bytes)
    assert detect(monkeypatch, kitti, "--out", out) == 0 and len(stand_in_calls) == 4


def test_unreadable_labels_and_cameras_are_optional(kitti, tmp_path, monkeypatch, capsys):
    write_file(kitti / "training/label_2/000001.txt", "Car")
    for i in 0, 2, 3:
        (kitti / f"training/calib/{i:06}.txt").unlink()
    assert detect(monkeypatch, kitti, "--out", tmp_path / "out", "--format", ALL) == 0
    output = " ".join(capsys.readouterr().out.split())
    assert "labels left out: " in output and "000001.txt" in output
    assert output.count("calibration left out: ") == 1 and "(2 more such frames)" in output
    assert output.count("nominal camera") == 1
    assert "calibration left out: " in output and "nominal camera" in output
    assert len(read_json(tmp_path / "out")["frames"]) == 4


def test_repeated_problem_is_reported_once_with_count(kitti, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(
        MadeDetector,
        "__call__",
        lambda self, frame: DetectionResult(Detections.none(), problem=f"{np.ptp(frame.xyz)} m are not much"),
    )
    assert detect(monkeypatch, kitti, "--out", tmp_path / "out") == 0
    output = " ".join(capsys.readouterr().out.split())
    assert output.count("are not much") == 1 and "in 4 frames" in output


def test_non_finite_numbers_are_not_written(kitti, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(
        MadeDetector, "__call__", lambda self, frame: DetectionResult(Detections.of(np.full((1, 7), np.nan)))
    )
    assert detect(monkeypatch, kitti, "--out", tmp_path / "out", "--format", ALL) == 1
    assert "not finite" in capsys.readouterr().out


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--format", "kiti"], "unknown value 'kiti'; did you mean 'kitti'"),
        (["--ego", "none"], "require --track"),
        (["--track"], "unrelated frames"),
        (["--min-score", 2], "2"),
    ],
)
def test_unusable_options_are_rejected(arguments, message, kitti, tmp_path, monkeypatch, capsys, stand_in_calls):
    assert detect(monkeypatch, kitti, "--out", tmp_path / "out", *arguments) == 2
    assert message in capsys.readouterr().err and stand_in_calls == [] and not (tmp_path / "out").exists()
