"""Results in `view`: missed and false boxes, and results in bags."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cli_samples import run_main
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st

from lidar_perception.classes import CAR, CLASSES, DETECTED, PEDESTRIAN
from lidar_perception.cli.main import cli
from lidar_perception.data.bag import BagHandle, BagWriter
from lidar_perception.data.bag_poses import BagPoses
from lidar_perception.data.open import open_recording
from lidar_perception.types import Detections, GroundTruth, InputError
from lidar_perception.wire.codec import make_bag_message
from lidar_studio.cli.view import make_short_names
from lidar_studio.drive import segment_frame, select_drive
from lidar_studio.results import (
    Results,
    Source,
    choose_points_topic,
    make_file_source,
    match_detections,
    read_recorded_results,
    read_recorded_scan,
    tracks_to_json,
)
from msg_utils.markers import MarkedObjects, to_marker_array
from msg_utils.stamps import make_header

VAN = CLASSES.index("Van")
CARS = np.array([[10.0, 0, -1, 4, 1.6, 1.5, 0.3], [20.0, 4, -1, 4, 1.6, 1.5, 2.0]])


def make_truth(boxes, class_ids):
    return GroundTruth.of(boxes, class_ids)


def find_errors(*arguments, **more):
    """Return missed and false rows, and check that every row is counted once."""
    truth, found, least, *_ = arguments
    result = match_detections(*arguments, **more)
    hits = len(truth) - len(result["missed"]) - len(result["ignored_labels"])
    assert hits == (found.scores >= least).sum() - len(result["false"]) - len(result["ignored"])
    return {"missed": result["missed"], "false": result["false"]}


def test_exact_detections_have_no_errors():
    ids = [CAR, CAR, PEDESTRIAN]
    boxes = np.vstack([CARS, [[8.0, -3, -1, 0.6, 0.6, 1.7, 0]]])
    found = Detections.of(boxes, ids, [0.9, 0.4, 0.7])
    for order in ([0, 1, 2], [2, 0, 1]):
        assert find_errors(make_truth(boxes[order], np.array(ids)[order]), found, 0.0) == {"missed": [], "false": []}


def test_detection_below_the_minimum_score_is_ignored():
    found = Detections.of(CARS, CAR, [0.9, 0.4])
    assert find_errors(make_truth(CARS, [CAR, CAR]), found, 0.5) == {"missed": [1], "false": []}
    assert find_errors(make_truth(CARS[:1], [CAR]), found, 0.0) == {"missed": [], "false": [1]}


def test_duplicate_and_wrong_class_are_false_positives():
    found = Detections.of(np.vstack([CARS[:1], CARS[:1]]), CAR, [0.9, 0.8])
    assert find_errors(make_truth(CARS[:1], [CAR]), found, 0.0)["false"] in ([0], [1])
    other = Detections.of(CARS[:1], PEDESTRIAN, 0.9)
    assert find_errors(make_truth(CARS[:1], [CAR]), other, 0.0) == {"missed": [0], "false": [0]}


def test_detected_van_is_not_an_error():
    assert find_errors(make_truth(CARS[:1], [VAN]), Detections.none(), 0.0) == {"missed": [], "false": []}
    found = Detections.of(CARS[:1], CAR, 0.9)
    assert find_errors(make_truth(CARS[:1], [VAN]), found, 0.0) == {"missed": [], "false": []}
    result = match_detections(make_truth(CARS, [CAR, VAN]), Detections.of(CARS, CAR, 0.9), 0.0)
    assert (result["ignored_labels"], result["ignored"]) == ([1], [1])


@given(
    st.lists(st.tuples(st.integers(0, 8), st.integers(0, 3)), max_size=6),
    st.lists(st.tuples(st.integers(0, 8), st.integers(0, 3), st.integers(0, 4)), max_size=6),
    st.sampled_from([frozenset(DETECTED), frozenset(["Pedestrian"]), frozenset(["Car", "Van"])]),
)
def test_every_label_and_detection_is_counted_once(labels, detections, classes):
    def boxes(rows):
        return np.array([[3.0 * place, 2, -1, 4, 1.6, 1.5, 0] for place, *_ in rows]).reshape(-1, 7)

    kinds = CAR, VAN, PEDESTRIAN, CLASSES.index("Tram")
    find_errors(
        make_truth(boxes(labels), [kinds[k] for _, k in labels]),
        Detections.of(boxes(detections), [kinds[k] for _, k, _ in detections], [score / 4 for *_, score in detections]),
        0.5,
        classes=classes,
    )


def test_classes_unknown_to_a_source_are_not_missed(drive_bag):
    frame = next(iter(open_recording(drive_bag)))
    blind = Source(lambda i, frame: Detections.none(), frozenset(["Pedestrian"]))
    layers = Results({"blind": blind}).make_layers(0, frame, 0.3)
    names = {layers["labels"][k][7] for k in layers["matches"]["blind"]["missed"]}
    assert names == {"Pedestrian"} and layers["detections"] == {"blind": []}


def test_bag_without_ground_and_clusters_is_segmented(drive_bag):
    assert choose_points_topic(drive_bag) == "/points"
    drive = select_drive(open_recording(drive_bag))
    ours, theirs = segment_frame(drive.frames[1]), read_recorded_scan(drive.frames[1])
    for name in ("xyz", "ground", "cluster_ids"):
        assert np.array_equal(getattr(ours, name), getattr(theirs, name))


NUMBERS = st.lists(st.integers(-(2**31), 2**31 - 1), min_size=1, max_size=6, unique=True)


@given(st.lists(NUMBERS, min_size=2, max_size=4), st.integers(1, 10**6))
def test_tracks_of_different_trackers_have_distinct_ids(trackers, far):
    trackers[1] = [*{*trackers[1], *(n + far for n in trackers[0] if n + far < 2**31)}]
    sources = [
        [t["id"] for t in tracks_to_json({0: make_marked_objects(numbers)}, "/a/output/tracks", k)]
        for k, numbers in enumerate(trackers)
    ]
    all_ids = [number for each in sources for number in each]
    assert len(set(all_ids)) == len(all_ids) == sum(map(len, trackers))
    assert all(0 <= number < 2**53 for number in all_ids)  # integers that JavaScript represents exactly
    assert set(sources[0]) >= {n for n in trackers[0] if n >= 0}


def test_track_has_the_last_class_of_its_tracker():
    first, then = make_marked_objects([7]), replace(make_marked_objects([7]), labels=["Cyclist"])
    (track,) = tracks_to_json({0: first, 1: then}, "/a/output/tracks", 0)
    assert track["class"] == "Cyclist" and len(track["boxes"]) == 2


def make_marked_objects(numbers):
    count = len(numbers)
    return MarkedObjects(
        np.tile([5.0, 0, 0, 1, 1, 1, 0], (count, 1)),
        ["Car"] * count,
        np.full(count, 0.5),
        np.array(numbers),
        [{}] * count,
    )


def test_tracks_of_all_trackers_in_a_bag_are_distinct(tmp_path):
    numbers = {"/a/tracker/output/tracks": [1, 7], "/b/tracker/output/tracks": [1, 5]}
    with BagWriter(tmp_path / "bag") as writer:
        for topic, ids in numbers.items():
            writer.add_topic(topic, "visualization_msgs/msg/MarkerArray")
            writer.write(
                topic,
                10,
                to_marker_array(
                    np.tile([5.0, 0, 0, 1, 1, 1, 0], (2, 1)),
                    ["Car"] * 2,
                    ids=ids,
                    header=make_header(10, "velodyne", make_bag_message),
                    make=make_bag_message,
                ),
            )
    found = read_recorded_results(BagPoses(BagHandle(tmp_path / "bag"), ""), [10]).tracks
    assert len({t["id"] for t in found}) == len(found) == 4
    assert {t["source"] for t in found} == {"a", "b"}


def test_sources_have_unique_short_names():
    paths = [
        Path(name)
        for name in (
            "fused",
            "robot/fused.json",
            "a/v4/best.safetensors",
            "b/v4/best.safetensors",
            "/out/data",
            "x/y.json",
            "x/y.onnx",
        )
    ]
    assert make_short_names(paths, ["data"]) == [
        "fused",
        "robot/fused",
        "a/v4/best",
        "b/v4/best",
        "out/data",
        "x/y.json",
        "x/y.onnx",
    ]


def test_missing_result_folder_is_named(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        make_file_source(tmp_path / "none")


def test_missing_frame_is_reported(drive_bag):
    result = CliRunner().invoke(cli, ["view", str(drive_bag), "--frame", "99", "--no-open"])
    assert isinstance(result.exception, InputError) and "no frame 99" in str(result.exception)


@pytest.mark.parametrize("verb", ["view", "label"])
@pytest.mark.parametrize("content", [b"no cloud\n", b"", b"# .PCD v0.7\nDATA ascii\n"])
def test_file_without_a_cloud_is_rejected_before_serving(verb, content, tmp_path, monkeypatch, capsys):
    file = tmp_path / "text.pcd"
    file.write_bytes(content)
    monkeypatch.chdir(tmp_path)
    assert run_main(monkeypatch, verb, file, "--no-open") == 2
    output = capsys.readouterr()
    assert str(file) in output.err.splitlines()[-1] and "http" not in output.out
    assert not (tmp_path / "out").exists()
